"""Shared fixtures: two cores at most, and task settings as the command line composes them."""

import pytest
import torch

from softgm_bench.config import Config, compose

torch.set_num_threads(2)

TASKS = ("basic", "structured", "wall", "wall_narrow", "wall_fixed")


@pytest.fixture(scope="session")
def settings():
    """Checked configuration from overrides, e.g. ``settings("task=wall")``."""
    known: dict[tuple[str, ...], Config] = {}

    def build(*overrides: str) -> Config:
        if overrides not in known:
            known[overrides] = compose(list(overrides))
        return known[overrides]

    return build
