"""Checkpoints: one file each, written whole or not at all, read without running any code in it."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from softgm_bench.config import UserError
from softgm_bench.runs.folder import write_atomically

FORMAT = 1


def save(folder: Path, frames: int, state: Mapping[str, Any], keep: int) -> Path:
    """Write the state after ``frames`` frames to ``folder`` and remove all but the newest ``keep`` checkpoints.

    Checkpoints after more frames go too: they are of a continuation that was given up, because they are damaged.

    ``state`` holds tensors and plain Python values only: it is read back with ``weights_only=True``.
    """
    buffer = io.BytesIO()  # a full disk then shows as an OSError, which torch's own file writing hides
    torch.save({"format": FORMAT, "frames": frames, **state}, buffer)
    path = folder / f"frames-{frames:012d}.pt"
    write_atomically(path, buffer.getvalue())
    newest = [other for other in in_order(folder) if other <= path][-keep:]
    for other in in_order(folder):
        if other not in newest:
            other.unlink()
    return path


def load(path: Path, device: str = "cpu") -> dict[str, Any]:
    """Read a checkpoint.

    Raises:
        UserError: the file is missing, damaged or no checkpoint of this program.
    """
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if archive.testzip() is not None:  # torch itself does not look at the checksums
                raise ValueError("a checksum is wrong")
        state = torch.load(io.BytesIO(content), map_location=device, weights_only=True)
    except Exception as error:  # damage shows as a BadZipFile, RuntimeError, EOFError, UnpicklingError and more
        raise UserError(f"{path}: damaged or no checkpoint; use an older one") from error
    if not isinstance(state, dict) or state.get("format") != FORMAT:
        raise UserError(f"{path}: no checkpoint of this program, or of another version of it")
    return state


def latest(folder: Path) -> Path | None:
    """The newest checkpoint in ``folder``."""
    return max(in_order(folder), default=None)


def random_state() -> dict[str, Any]:
    """State of torch's global generators, on which exploration and minibatches draw."""
    return {"cpu": torch.get_rng_state(), "cuda": torch.cuda.get_rng_state_all() if torch.cuda.is_available() else []}


def set_random_state(state: Mapping[str, Any]) -> None:
    """Go on drawing from what ``random_state`` returned."""
    torch.set_rng_state(state["cpu"])
    if state["cuda"] and torch.cuda.is_available():
        torch.cuda.set_rng_state_all(state["cuda"])


def in_order(folder: Path) -> list[Path]:
    """Checkpoints in ``folder``, oldest first."""
    return sorted(folder.glob("frames-*.pt"))
