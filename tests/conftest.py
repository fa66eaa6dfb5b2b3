"""Shared fixtures: two cores at most, and task settings as the command line composes them."""

import gc
import io
import os
import signal
import sys
import threading
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import torch
from omegaconf import OmegaConf, grammar_parser

from softgm_bench import compilation, process, progress
from softgm_bench.assembly import configure
from softgm_bench.config import Config

process.prepare()  # this process is an entry point too; nothing has multiplied yet
torch.set_num_threads(1 if "PYTEST_XDIST_WORKER" in os.environ else 2)

# a command's standard error does not depend on how busy the machine is, nor on what is compiled already
progress.SECONDS_BETWEEN_LINES = float("inf")
compilation.told()
# whoever started the tests in the background has them ignore Ctrl-C, and so would every command that they start
if threading.current_thread() is threading.main_thread() and signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# To compose settings, which most tests do, makes objects by the ten thousand, in a process that has half a million.
gc.set_threshold(10_000)


def _parse_texts_once() -> None:
    """Have OmegaConf parse a text of YAML or of its grammar once; it is two fifths of the time that composing takes."""
    load = OmegaConf.load
    known: dict[str, Any] = {}

    def load_known(file: Any) -> Any:
        text = file.read() if hasattr(file, "read") else Path(file).read_text(encoding="utf-8")
        if text not in known:
            known[text] = load(io.StringIO(text))
        return deepcopy(known[text])

    OmegaConf.load = load_known  # type: ignore[method-assign]
    parse, parse_known = grammar_parser.parse, cache(grammar_parser.parse)
    for module in [module for module in sys.modules.values() if vars(module).get("parse") is parse]:
        vars(module)["parse"] = parse_known


_parse_texts_once()


def pytest_collection_finish():
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session")
def settings():
    """Checked configuration from overrides of the paper's, e.g. ``settings("task=wall")``."""
    known: dict[tuple[str, ...], Config] = {}

    def build(*overrides: str) -> Config:
        if overrides not in known:
            known[overrides] = configure(["recipe=paper", *overrides])
        return known[overrides]

    return build


@pytest.fixture
def one_thread():
    """For tests whose tensors are so small that a second thread would only be waited for."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
