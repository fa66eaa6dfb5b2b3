"""Records that the jobs of a sweep leave in their run folders, and what a folder says about its run.

``running.json``: which process is at work, on which device. ``failure.json``: why the last attempt came to nothing.
Both are gone when a run has finished.
"""

import csv
import json
import os
import socket
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from softgm_bench.runs import folder as run_folder
from softgm_bench.storage.files import to_json, write_atomically
from softgm_bench.storage.run_folder import RunFolder

DONE, RUNNING, FAILED, STOPPED, MISSING = "done", "running", "failed", "stopped", "missing"
TAIL = 16_384  # bytes of metrics.csv that hold its last whole row


@dataclass(frozen=True)
class State:
    """One of the five words above, and what there is to say about it."""

    kind: str
    detail: str = ""


@contextmanager
def running(run_dir: Path, device: str) -> Iterator[None]:
    """Around a job: ``running.json`` says that this process is at work, and an earlier failure is forgotten.

    Raises:
        OSError: the folder cannot be written.
    """
    run_dir.mkdir(parents=True, exist_ok=True)
    record = {"pid": os.getpid(), "host": socket.gethostname(), "device": device, "started": time.time()}
    write_atomically(_running(run_dir), to_json(record).encode())
    RunFolder(run_dir).failure.unlink(missing_ok=True)
    try:
        yield
    finally:
        _running(run_dir).unlink(missing_ok=True)


def write_failure(run_dir: Path, line: str) -> None:
    """Leave the reason of a failure, unless a finished run or one at work has the folder, or it cannot be written."""
    if RunFolder(run_dir).summary.exists() or _locked(run_dir):
        return
    run_folder.write_failure(RunFolder(run_dir), line)
    with suppress(OSError):
        _running(run_dir).unlink(missing_ok=True)


def forget_failure(run_dir: Path) -> None:
    """Remove what an earlier attempt left."""
    with suppress(OSError):
        RunFolder(run_dir).failure.unlink(missing_ok=True)
        _running(run_dir).unlink(missing_ok=True)


def state(run_dir: Path) -> State:
    """Read a run's state from its folder; a lock tells a run at work from one that was killed."""
    folder = RunFolder(run_dir)
    if _locked(run_dir):
        return State(RUNNING, ", ".join(filter(None, [_process(run_dir), _progress(folder)])))
    if folder.summary.exists():
        try:
            summary = json.loads(folder.summary.read_text())
            if summary["final_evaluation"]["undiscounted_return"]["mean"] is None:  # JSON's word for NaN
                return State(FAILED, "its returns are no numbers: the policy had diverged")
            return State(DONE, achieved(summary))
        except (ValueError, KeyError, TypeError, OSError):
            return State(FAILED, "summary.json is damaged")
    if folder.failure.exists():
        return State(FAILED, str(_read(folder.failure).get("error", "failure.json is damaged")))
    if folder.config.exists() or _running(run_dir).exists():
        return State(STOPPED, _progress(folder) or "before the first iteration ended")
    return State(MISSING)


def achieved(summary: Mapping[str, Any]) -> str:
    """A finished run in a few words: its success rate with Wilson's 95 % interval, or its return."""
    metrics = summary["final_evaluation"]
    if (success := metrics.get("success_rate")) is not None:
        return f"success {success['mean']:.3f} [{success['low']:.3f}, {success['high']:.3f}]"
    return f"return {metrics['undiscounted_return']['mean']:.2f}"


def _running(run_dir: Path) -> Path:
    return run_dir / "running.json"


def _read(path: Path) -> Mapping[str, Any]:
    """A record; empty if it is missing or damaged."""
    try:
        record = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return record if isinstance(record, dict) else {}


def _locked(run_dir: Path) -> bool:
    """Tell whether a process trains in the folder: ``run_folder.exclusive`` locks it, the system unlocks it."""
    try:
        import fcntl

        descriptor = os.open(run_dir, os.O_RDONLY)
    except (ImportError, OSError):
        return False
    try:
        fcntl.flock(descriptor, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False


def _process(run_dir: Path) -> str:
    record = _read(_running(run_dir))
    at = [str(record[key]) for key in ("host", "device") if key in record]
    return f"process {record['pid']} on {' '.join(at)}" if "pid" in record else ""


def _progress(folder: RunFolder) -> str:
    """Frames so far and their share of all; empty before the first iteration's end."""
    frames = _frames(folder.metrics)
    if frames is None:
        return ""
    try:
        total = int(OmegaConf.select(OmegaConf.load(folder.config), "experiment.total_frames"))
    except (OSError, OmegaConfBaseException, YAMLError, ValueError, TypeError):
        return f"{frames:,} frames"
    return f"{frames:,} frames, {min(1.0, frames / total):.0%}"


def _frames(path: Path) -> int | None:
    """Frames in the last whole row of ``metrics.csv``."""
    try:
        with path.open("rb") as file:
            header = file.readline().decode()
            file.seek(max(file.tell(), path.stat().st_size - TAIL))
            rows = file.read().decode().rpartition("\n")[0].splitlines()
        return int(next(csv.DictReader([header, rows[-1]]))["frames"])
    except (OSError, IndexError, KeyError, ValueError, TypeError, UnicodeDecodeError, StopIteration):
        return None
