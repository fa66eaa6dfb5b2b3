"""The folder of a run: where its files lie, when a run may begin in it, how a file is written whole."""

import json
import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from softgm_bench.config import UserError


@dataclass(frozen=True)
class RunFolder:
    """Paths of a run's files under ``path``."""

    path: Path

    @property
    def config(self) -> Path:
        """Every setting, as YAML."""
        return self.path / "config.yaml"

    @property
    def metrics(self) -> Path:
        """One row an iteration."""
        return self.path / "metrics.csv"

    @property
    def evaluations(self) -> Path:
        """One JSON object an evaluation during training."""
        return self.path / "evaluations.jsonl"

    @property
    def episodes(self) -> Path:
        """One row an episode of the final evaluation."""
        return self.path / "episodes.csv"

    @property
    def summary(self) -> Path:
        """The final evaluation; there when the run has finished."""
        return self.path / "summary.json"

    @property
    def checkpoints(self) -> Path:
        """Folder of the newest checkpoints."""
        return self.path / "checkpoints"


def create(run_dir: str, config: Mapping[str, Any], overwrite: bool) -> RunFolder:
    """Make the folder of a new run and write its ``config.yaml``.

    Raises:
        UserError: the folder holds a run already, or cannot be written.
    """
    folder = RunFolder(Path(run_dir))
    held = _held_run(folder)
    if held and not overwrite:
        raise UserError(f"run_dir={run_dir} holds {held}: add overwrite=true to replace it or choose another run_dir")
    try:
        _remove_run(folder)
        folder.checkpoints.mkdir(parents=True, exist_ok=True)
        write_atomically(folder.config, OmegaConf.to_yaml(OmegaConf.create(dict(config))).encode())
    except OSError as error:
        raise UserError(f"run_dir={run_dir}: {error.strerror}; choose a folder that can be written") from error
    return folder


def write_atomically(path: Path, content: bytes) -> None:
    """Write or replace a file so that, whatever happens, ``path`` holds all of the old content or all of the new."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    directory = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(directory)
    finally:
        os.close(directory)


def to_json(value: Mapping[str, Any], indent: int | None = None) -> str:
    """JSON text; numbers that are not finite become null, which JSON has a word for."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _held_run(folder: RunFolder) -> str:
    """What kind of run the folder holds, in words; empty if none."""
    if folder.summary.exists():
        return "a finished run"
    return "an unfinished run" if any(path.exists() for path in _files(folder)) else ""


def _remove_run(folder: RunFolder) -> None:
    """Remove a run's files and nothing else that may lie beside them."""
    for path in _files(folder):
        path.unlink(missing_ok=True)


def _files(folder: RunFolder) -> list[Path]:
    files = [folder.summary, folder.config, folder.metrics, folder.evaluations, folder.episodes]
    return files + list(folder.checkpoints.glob("frames-*.pt"))
