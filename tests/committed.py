"""Finds what is committed below ``experiments`` and loads the scripts there, which make tables of it."""

import importlib.util
from pathlib import Path

ROOT = Path(__file__).parents[1]


def script(path):
    specification = importlib.util.spec_from_file_location(path.stem, path)
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module
