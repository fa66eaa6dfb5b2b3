"""As many cells of a grid as fit into a given time on one machine, several at once, each ended in time and kept.

What is finished is packed at once (``packing``). A cell gets its share of the time that is left as
``experiment.minutes``; at the end whatever still runs is stopped.
"""

import math
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from softgm_bench.config import available_threads, compose_untyped
from softgm_bench.config.comparison import ABSENT, differences
from softgm_bench.errors import UserError
from softgm_bench.storage.run_folder import RunFolder
from softgm_bench.sweeps import cell as sweep_cell
from softgm_bench.sweeps.launch import cells
from softgm_bench.sweeps.packing import Pack, piece

RUNS, UNFINISHED = "runs", "unfinished"  # folders in the packs
POLICY = "policy.pt"  # in a run folder: what remains of its checkpoints
POLL = 0.2  # seconds between looks at the trainings
TAIL = 12  # lines of a failed cell's output in the log
LEAST_MINUTES = 2.0  # that a cell is worth beginning for
START_UP = 20.0  # seconds from a cell's start to the beginning of its minutes, and from their end to its own

Say = Callable[[str], None]


@dataclass
class Campaign:
    """What is to be done, and where.

    Attributes:
        cells: settings of each cell by its name, ``<task>/<algorithm>/seed<seed>``, in the order in which they begin.
        work: folder of the run folders.
        end: when everything is to be over, on the clock of ``time.monotonic``.
        jobs: cells at once.
        least_minutes: a cell that would get fewer is not begun.
        start_up: seconds of a cell that are not its minutes.
    """

    cells: dict[str, list[str]]
    work: Path
    end: float
    jobs: int
    least_minutes: float = LEAST_MINUTES
    start_up: float = START_UP
    running: dict[str, subprocess.Popen] = field(default_factory=dict)


def planned(overrides: Sequence[str], done: Sequence[str] = ()) -> dict[str, list[str]]:
    """Settings of a grid's cells by name, without those that are done.

    Args:
        overrides: of the command line, lists of values and ``+grids=...`` among them; the last one of a key counts.
        done: names of cells.

    Raises:
        UserError: two cells have the same name, or a setting cannot be composed.
        HydraException, OmegaConfBaseException: likewise.
    """
    last = {one.partition("=")[0]: one for one in overrides}
    found: dict[str, list[str]] = {}
    for cell in cells(list(last.values()))[0]:
        name = "/".join(cell.run_dir.parts[-3:])
        if name in found:
            raise UserError(f"{name}: two cells have this folder; let the grid differ in task, algo, model or seed")
        found[name] = list(cell.overrides)
    return {name: settings for name, settings in found.items() if name not in done}


def share(seconds: float, cells_left: int, jobs: int, least: float) -> float | None:
    """Give the seconds of a cell that begins now, so that the time is used whole.

    Args:
        seconds: that are left.
        cells_left: that have not begun, this one included.
        jobs: cells at once.
        least: seconds that a cell is worth beginning for.

    Returns:
        The time over the number of rounds that there will be; None if that is too little.
    """
    rounds = max(1, min(math.ceil(cells_left / jobs), int(seconds // least)))
    return None if seconds < least else seconds / rounds


def finished(folder: Path) -> list[str]:
    """Names of the finished cells anywhere below a folder, such as an earlier campaign's unpacked archives."""
    found = sorted(path.parent for path in folder.rglob("summary.json") if (path.parent / "config.yaml").exists())
    return ["/".join(path.parts[-3:]) for path in found]


def run(campaign: Campaign, pack: Pack, say: Say) -> None:
    """Do cells until the time is up; whatever ends this early, no training is left running.

    Args:
        campaign: what is to be done.
        pack: receives each cell when it has finished.
        say: takes lines for the log.
    """
    waiting, number = _without_finished(campaign, pack, say), 0
    try:
        while waiting or campaign.running:
            while waiting and len(campaign.running) < campaign.jobs:
                seconds = share(campaign.end - time.monotonic(), len(waiting), campaign.jobs, _least(campaign))
                if seconds is None:
                    say(f"too little time is left for {', '.join(waiting)}")
                    waiting = []
                    break
                _begin(campaign, waiting.pop(0), (seconds - campaign.start_up) / 60.0, number, say)
                number += 1
            for name in [name for name, child in campaign.running.items() if child.poll() is not None]:
                _end(campaign, name, campaign.running.pop(name), pack, say)
            if time.monotonic() > campaign.end:
                say(f"the time is up; stopped: {', '.join(campaign.running)}" if campaign.running else "the time is up")
                break
            time.sleep(POLL)
    finally:
        stop(campaign.running.values())
        for name, child in campaign.running.items():  # some may have just finished
            _end(campaign, name, child, pack, say)
        campaign.running.clear()
        for name in campaign.cells:  # one that a signal came between, or one that has finished while it was stopped
            if name not in pack.names and RunFolder(campaign.work / name).summary.exists():
                _keep(campaign, name, pack, say)


def stop(children: Sequence[subprocess.Popen] | Any, patience: float = 10.0) -> None:
    """Tell processes to stop, all at once, and kill those that have not after ``patience`` seconds."""
    children = list(children)
    for child in children:
        child.terminate()
    end = time.monotonic() + patience
    for child in children:
        try:
            child.wait(max(0.0, end - time.monotonic()))
        except (subprocess.TimeoutExpired, KeyboardInterrupt):
            child.kill()
            child.wait()


def _without_finished(campaign: Campaign, pack: Pack, say: Say) -> list[str]:
    """Pack what this campaign had finished before it was killed; the names of the other cells.

    Finished runs with other settings are another campaign's: they are left alone and not done again.
    """
    waiting = []
    for name, overrides in list(campaign.cells.items()):
        folder = RunFolder(campaign.work / name)
        if not folder.summary.exists():
            waiting.append(name)
            continue
        held: Any = OmegaConf.to_container(OmegaConf.load(folder.config))
        changed = [key for key, pair in differences(_values(overrides), held).items() if ABSENT not in pair]
        if changed:
            say(f"{name}: {folder.path} holds a run with another {changed[0]}; choose another --work")
            del campaign.cells[name]
        else:
            _keep(campaign, name, pack, say)
    return waiting


def _values(overrides: list[str]) -> dict[str, Any]:
    """All settings of a cell as plain values."""
    values: Any = OmegaConf.to_container(compose_untyped(overrides), resolve=True)
    return values


def _least(campaign: Campaign) -> float:
    return 60.0 * campaign.least_minutes + campaign.start_up


def _begin(campaign: Campaign, name: str, minutes: float, number: int, say: Say) -> None:
    composed = _values(campaign.cells[name])
    composed["experiment"]["minutes"] = minutes
    composed |= {"run_dir": str((campaign.work / name).absolute()), "resume": True, "overwrite": False}
    composed["threads"] = composed["threads"] or max(1, available_threads() // campaign.jobs)
    campaign.running[name] = sweep_cell.start(composed, campaign.cells[name], Path.cwd(), number)
    say(f"{name}: begins, {minutes:.2f} min of training and evaluation, {composed['threads']} threads")


def _end(campaign: Campaign, name: str, child: subprocess.Popen, pack: Pack, say: Say) -> None:
    """Say what became of a training, and keep it if it has finished."""
    answer, _ = child.communicate()
    outcome = sweep_cell.outcome(answer, child.returncode, campaign.work / name)
    say(f"{name}: {outcome['outcome']}, {outcome['line']}")
    if outcome["outcome"] == sweep_cell.DONE:
        _keep(campaign, name, pack, say)
    elif outcome["outcome"] == sweep_cell.INTERRUPTED and RunFolder(campaign.work / name).newest():
        _keep(campaign, name, pack, say, UNFINISHED)
    elif outcome["outcome"] == sweep_cell.FAILED:
        for line in _tail(campaign.work / name / sweep_cell.LOG):
            say(f"    {line}")


def _keep(campaign: Campaign, name: str, pack: Pack, say: Say, top: str = RUNS) -> None:
    """Export the policy and pack the cell without its checkpoints; what goes wrong is said and stops no other cell."""
    folder = RunFolder(campaign.work / name)
    policy_file = folder.path / POLICY
    try:
        if folder.newest():
            from softgm_bench.episodes import policy  # late: it brings torch along

            policy.save(policy.load(folder.path), policy_file)
        if top == RUNS:
            shutil.rmtree(folder.checkpoints, ignore_errors=True)
    except Exception as error:
        say(f"{name}: no policy could be exported, {type(error).__name__}: {error}")
    files = [folder.config, folder.metrics, folder.evaluations, folder.episodes, folder.summary, policy_file]
    try:
        pack.add(name, piece({f"{top}/{name}/{path.name}": path for path in files}))
        say(f"{name}: {'no room for it in the packs' if name in pack.left_out else f'packed in {top}'}")
    except OSError as error:
        say(f"{name}: not packed, {type(error).__name__}: {error}")


def _tail(path: Path) -> list[str]:
    try:
        with path.open("rb") as file:
            file.seek(max(0, os.fstat(file.fileno()).st_size - 16_384))
            return file.read().decode(errors="replace").splitlines()[-TAIL:]
    except OSError:
        return []
