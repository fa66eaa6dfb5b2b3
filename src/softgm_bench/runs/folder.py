"""The folder of a run: where its files lie, when a run may begin in it, how a file is written whole."""

import os
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from softgm_bench.errors import UserError
from softgm_bench.storage.files import to_json, wait_for_disk, write_atomically
from softgm_bench.storage.run_folder import RunFolder

ANEW = "to begin anew, give overwrite=true instead of resume=true"


def create(run_dir: str, config: Mapping[str, Any], overwrite: bool) -> RunFolder:
    """Make the folder of a new run and write its ``config.yaml``.

    Raises:
        UserError: the folder holds a run already, or cannot be written.
    """
    folder = RunFolder(Path(run_dir))
    held = _held_run(folder)
    if held and not overwrite:
        going_on = "" if folder.summary.exists() else "resume=true to resume it, "
        advice = f"add {going_on}overwrite=true to replace it or choose another run_dir"
        raise UserError(f"run_dir={run_dir} holds {held}: {advice}")
    try:
        _remove_run(folder)
        folder.checkpoints.mkdir(parents=True, exist_ok=True)
        write_atomically(folder.config, _yaml(config))
    except OSError as error:
        raise _unwritable(run_dir, error) from error
    return folder


def cut_back(folder: RunFolder, config: Mapping[str, Any], iterations: int, evaluations: int) -> None:
    """Bring the files of a run back to where a checkpoint left them.

    Args:
        folder: of the run.
        config: its settings, of which some may be others than when it began.
        iterations: that ``metrics.csv`` tells of when the checkpoint is written.
        evaluations: that ``evaluations.jsonl`` does.

    Raises:
        UserError: one of the two tells of fewer.
        OSError: the folder cannot be written.
    """
    _keep_lines(folder.metrics, 1 + iterations if iterations else 0)
    _keep_lines(folder.evaluations, evaluations)
    for path in (folder.summary, folder.episodes, folder.failure, *_left_over(folder)):
        path.unlink(missing_ok=True)
    write_atomically(folder.config, _yaml(config))


@contextmanager
def exclusive(run_dir: str) -> Iterator[None]:
    """Keep other processes out of a run's folder; the system lets them in again however this one ends.

    Raises:
        UserError: another process is in it, or the folder cannot be made.
    """
    try:
        Path(run_dir).mkdir(parents=True, exist_ok=True)
        descriptor = os.open(run_dir, os.O_RDONLY)
    except OSError as error:
        raise _unwritable(run_dir, error) from error
    try:
        with suppress(ImportError):  # on Windows there is no such lock
            _lock(descriptor, run_dir)
        yield
    finally:
        os.close(descriptor)


def write_failure(folder: RunFolder, line: str) -> None:
    """Leave the reason of a failure, unless the folder holds a finished run or cannot be written."""
    if folder.summary.exists():
        return
    record = {"error": line, "host": socket.gethostname(), "time": time.time()}
    with suppress(OSError):
        folder.path.mkdir(parents=True, exist_ok=True)
        write_atomically(folder.failure, to_json(record).encode())


def to_disk(folder: RunFolder) -> None:
    """Wait until the rows and lines written so far would survive a power failure."""
    for path in (folder.metrics, folder.evaluations, folder.path):
        if path.exists():
            wait_for_disk(path)


def _yaml(config: Mapping[str, Any]) -> bytes:
    return OmegaConf.to_yaml(OmegaConf.create(dict(config))).encode()


def _lock(descriptor: int, run_dir: str) -> None:
    import fcntl

    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        raise UserError(f"run_dir={run_dir}: another process is at work on this run; wait for it or end it") from error
    except OSError:
        pass  # a file system without locks


def _unwritable(run_dir: str, error: OSError) -> UserError:
    return UserError(f"run_dir={run_dir}: {error.strerror}; choose a folder that can be written")


def _keep_lines(path: Path, count: int) -> None:
    """Cut a text file back to its first ``count`` lines; a file without lines is removed."""
    if not count:
        path.unlink(missing_ok=True)
        return
    path.touch()
    with path.open("r+b") as file:
        if not all(file.readline().endswith(b"\n") for _ in range(count)):
            raise UserError(f"{path}: what stood there before the checkpoint is missing; {ANEW}")
        file.truncate(file.tell())


def _held_run(folder: RunFolder) -> str:
    """Say in words what kind of run the folder holds; empty if none."""
    if folder.summary.exists():
        return "a finished run"
    return "an unfinished run" if any(path.exists() for path in _files(folder)) else ""


def _remove_run(folder: RunFolder) -> None:
    """Remove a run's files and nothing else that may lie beside them."""
    for path in _files(folder):
        path.unlink(missing_ok=True)


def _files(folder: RunFolder) -> list[Path]:
    files = [folder.summary, folder.config, folder.metrics, folder.evaluations, folder.episodes, folder.failure]
    return files + list(folder.checkpoints.glob("frames-*.pt")) + _left_over(folder)


def _left_over(folder: RunFolder) -> list[Path]:
    """List the files that a process left when it was killed while writing."""
    names = [path.name for path in (folder.summary, folder.config)]
    files = [folder.path / f".{name}.tmp" for name in names] + list(folder.checkpoints.glob(".frames-*.pt.tmp"))
    return [path for path in files if path.exists()]
