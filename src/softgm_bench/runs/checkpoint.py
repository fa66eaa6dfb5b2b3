"""Checkpoints: one file each, written whole or not at all, read without running any code in it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from softgm_bench.errors import UserError
from softgm_bench.storage import archive
from softgm_bench.storage.files import write_atomically
from softgm_bench.storage.run_folder import RunFolder

FORMATS = (1, 2)  # that can be continued from; 1 had no policy of its own, and the simulation in other entries


def save(folder: RunFolder, frames: int, state: Mapping[str, Any], keep: int) -> Path:
    """Write the state after ``frames`` frames and remove all but the newest ``keep`` checkpoints.

    Checkpoints after more frames go too: they are of a continuation that was given up, because they are damaged.

    ``state`` holds tensors and plain Python values only.
    """
    path = folder.checkpoints / f"frames-{frames:012d}.pt"
    write_atomically(path, archive.packed({"format": FORMATS[-1], "frames": frames, **state}))
    newest = [other for other in folder.in_order() if other <= path][-keep:]
    for other in folder.in_order():
        if other not in newest:
            other.unlink()
    return path


def load(path: Path, device: str = "cpu") -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        UserError: the file is missing, damaged or no checkpoint of this program.
    """
    state = archive.load(path, device)
    if state.get("format") not in FORMATS or "algorithm" not in state:
        raise UserError(f"{path}: no checkpoint of this program, or of another version of it")
    return state


def random_state() -> dict[str, Any]:
    """Give the state of torch's global generators, on which exploration and minibatches draw."""
    return {"cpu": torch.get_rng_state(), "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []}


def set_random_state(state: Mapping[str, Any]) -> None:
    """Resume drawing from what ``random_state`` returned."""
    torch.set_rng_state(state["cpu"])
    if state["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["cuda"])
