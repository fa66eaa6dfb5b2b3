"""One cell of a sweep: skipped if it has finished, else trained in a process of its own and written down.

``run`` is what launchers call, in whatever process; it returns only strings and raises nothing, so that no cell can
stop another. The training itself is ``python -m softgm_bench.sweeps.cell`` with the job on its standard
input: it has the number of threads that it was given from its beginning, its memory goes when it ends, and a crash is
its own. A process whose parent is gone stops as on SIGTERM, so that nothing outlives a sweep that was killed.
"""

import json
import os
import signal
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from softgm_bench import output, process
from softgm_bench.config import typed
from softgm_bench.config.comparison import ABSENT, differences
from softgm_bench.config.explain import USER_ERRORS, explain
from softgm_bench.config.upgrade import upgraded
from softgm_bench.storage.files import to_json, write_atomically
from softgm_bench.storage.run_folder import RunFolder
from softgm_bench.sweeps import devices
from softgm_bench.sweeps import record as sweep_record

RECORDS = "SOFTGM_SWEEP"  # environment variable: the folder where outcomes go
CWD = "SOFTGM_SWEEP_CWD"  # and what relative run folders are relative to
MAIN = "SOFTGM_SWEEP_PID"  # and the process that the user started
PARENT = os.getppid()  # of a launcher's worker, while whoever launched it is alive
LOG = "output.log"  # in the run folder: what the training printed
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
DONE, SKIPPED, FAILED, INTERRUPTED = "done", "skipped", "failed", "interrupted"
PATIENCE = 30.0  # seconds that a training has to save a checkpoint when it is stopped
POLL = 0.5  # seconds between looks at whether the parent is still there


def run(composed: DictConfig) -> str:
    """Do one cell; returns its outcome, which it also leaves where the sweep looks for it."""
    _leave_if_orphaned(None)
    hydra = HydraConfig.get()
    overrides = list(hydra.overrides.task)
    cwd = Path(os.environ.get(CWD, "."))
    run_dir = ""
    try:
        values: Any = OmegaConf.to_container(composed, resolve=True)
        run_dir = values["run_dir"]
        outcome = _do(values, overrides, cwd, hydra.job.num)
    except KeyboardInterrupt:
        _leave(hydra.job.num, run_dir, overrides, {"outcome": INTERRUPTED, "line": "interrupted"})
        raise
    except USER_ERRORS as error:
        outcome = {"outcome": FAILED, "line": explain(error, overrides)}
    if run_dir and outcome["outcome"] == FAILED:
        sweep_record.write_failure(cwd / run_dir, outcome["line"])
    _leave(hydra.job.num, run_dir, overrides, outcome)
    return outcome["outcome"]


def finished(values: Mapping[str, Any], run_dir: Path) -> str:
    """Read what a finished run with these settings achieved; empty if the folder holds none.

    Settings are compared as far as both have them, without building anything: what differs is left to ``resume``.
    """
    folder = RunFolder(run_dir)
    try:
        summary = json.loads(folder.summary.read_text())
        held: Any = OmegaConf.to_container(OmegaConf.load(folder.config))
        differ = any(ABSENT not in pair for pair in differences(values, upgraded(held)).values())
        if differ or summary["frames"] < values["experiment"]["total_frames"]:
            return ""
        return sweep_record.achieved(summary)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OmegaConfBaseException, YAMLError):
        return ""


def _do(values: dict[str, Any], overrides: list[str], cwd: Path, number: int) -> dict[str, str]:
    run_dir = cwd / values["run_dir"]
    state = sweep_record.state(run_dir)
    if state.kind == sweep_record.RUNNING:
        return {"outcome": FAILED, "line": f"{state.detail or 'another process'}: at work in it already"}
    if not values["overwrite"]:
        if achieved := finished(values, run_dir):
            sweep_record.forget_failure(run_dir)
            return {"outcome": SKIPPED, "line": f"finished before, {achieved}"}
        values["resume"] = True
    began = time.monotonic()
    outcome = _train_apart(values, overrides, cwd, number)
    if outcome["outcome"] == DONE:
        outcome["line"] += f", {(time.monotonic() - began) / 60:.1f} min"
    return outcome


def _train_apart(values: Mapping[str, Any], overrides: list[str], cwd: Path, number: int) -> dict[str, str]:
    """Start the training and wait for it; it stops with this process or with the one that this is a worker of."""
    child = start(values, overrides, cwd, number)
    try:
        while True:
            try:
                answer, _ = child.communicate(timeout=POLL)
                break
            except subprocess.TimeoutExpired:
                pass
            _leave_if_orphaned(child)
    except BaseException:
        _stop(child)
        raise
    return outcome(answer, child.returncode, Path(values["run_dir"]))


def start(values: Mapping[str, Any], overrides: list[str], cwd: Path, number: int) -> subprocess.Popen:
    """Start a training in a process of its own, which stops with this one.

    Args:
        values: of all settings, plain.
        overrides: that led to them, for messages.
        cwd: what relative run folders are relative to.
        number: of the job, by which GPUs are dealt out.

    Returns:
        The process; what it prints is for ``outcome``.
    """
    device, visible = devices.dealt(values["device"], number, os.environ)
    environment = dict(os.environ) | visible
    if values["threads"]:
        environment |= dict.fromkeys(THREADS, str(values["threads"]))
    child = subprocess.Popen(
        [sys.executable, "-m", "softgm_bench.sweeps.cell"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        cwd=cwd,
        env=environment,
        start_new_session=True,  # Ctrl-C in a terminal reaches this process, which passes it on
    )
    assert child.stdin is not None
    job = {"config": values, "overrides": overrides, "parent": os.getpid(), "device": device}
    with suppress(BrokenPipeError), child.stdin as pipe:  # it may have died already, which its status tells
        pipe.write(json.dumps(job))
    child.stdin = None
    return child


def outcome(answer: str, status: int, run_dir: Path) -> dict[str, str]:
    """Give what the training said last; if it said nothing, what became of its process."""
    try:
        return json.loads(answer.splitlines()[-1])
    except (IndexError, ValueError):
        pass
    if status >= 0:
        line = f"ended with exit status {status}; see {run_dir / LOG}"
    else:
        hint = " (memory?)" if -status == signal.SIGKILL else f"; see {run_dir / LOG}"
        line = f"killed by {signal.Signals(-status).name}{hint}"
    return {"outcome": FAILED, "line": line}


def _leave_if_orphaned(child: subprocess.Popen | None) -> None:
    """End this worker and its training if nobody is left to launch or to listen; the user's own process stays."""
    if os.getppid() != PARENT and os.environ.get(MAIN) != str(os.getpid()):
        if child is not None:
            _stop(child)
        os._exit(1)


def _stop(child: subprocess.Popen) -> None:
    child.terminate()
    try:
        child.wait(PATIENCE)
    except (subprocess.TimeoutExpired, KeyboardInterrupt):
        child.kill()
        child.wait()


def _leave(number: int, run_dir: str, overrides: list[str], outcome: Mapping[str, str]) -> None:
    folder = os.environ.get(RECORDS)
    if folder:
        record = {"number": number, "run_dir": run_dir, "overrides": overrides, **outcome}
        with suppress(OSError):  # a full disk; failure.json could not be written either
            write_atomically(Path(folder) / f"{number:06d}.json", to_json(record).encode())


def main() -> int:
    """Train the job on standard input; the last line on standard output says what came of it."""
    process.prepare()
    process.quieten()
    job = json.loads(sys.stdin.read())
    _stop_with(job["parent"])
    answers = os.fdopen(os.dup(sys.stdout.fileno()), "w")
    with output.unbreakable():
        answer = _train(job["config"], job["overrides"], job["device"])
    with suppress(OSError):  # nobody may be left to listen
        print(json.dumps(answer), file=answers, flush=True)
    return 0


def _train(values: Mapping[str, Any], overrides: list[str], device: str) -> dict[str, str]:
    try:
        config = typed(OmegaConf.create(dict(values)))
        from softgm_bench.assembly import check  # late, as all that brings torch along

        check(config)
        from softgm_bench.runs.loop import train

        run_dir = Path(config.run_dir)
        with sweep_record.running(run_dir, device), _logged(run_dir / LOG):
            try:
                return {"outcome": DONE, "line": sweep_record.achieved(train(config))}
            except Exception as error:  # a sweep goes on, whatever happened to one cell
                traceback.print_exc()
                line = explain(error, overrides) if isinstance(error, USER_ERRORS) else _unexpected(error, run_dir)
                return {"outcome": FAILED, "line": line}
    except USER_ERRORS as error:
        return {"outcome": FAILED, "line": explain(error, overrides)}
    except KeyboardInterrupt as interruption:
        return {"outcome": INTERRUPTED, "line": str(interruption) or "interrupted; nothing was saved"}


def _unexpected(error: Exception, run_dir: Path) -> str:
    lines = str(error).splitlines()
    return f"{type(error).__name__}: {lines[0] if lines else ''}; see {run_dir / LOG}"


@contextmanager
def _logged(path: Path) -> Iterator[None]:
    """Send everything that is printed, also by compiled code, to the end of a file."""
    with path.open("ab") as log:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
            os.dup2(log.fileno(), stream.fileno())
    try:
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


def _stop_with(parent: int) -> None:
    """Send this process SIGTERM once its parent is another."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(POLL)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=watch, daemon=True).start()


if __name__ == "__main__":
    sys.exit(main())
