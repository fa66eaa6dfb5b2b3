"""Show what has become of a sweep: ``softgm-bench status FOLDER key=value ...``.

FOLDER is where runs lie, such as outputs or outputs/full. Settings, with their defaults:

  grid=null   name of a grid in conf/grids: its cells only, in its order, those that are missing too

One line a run: done (success rate with its 95 % interval), running (process, frames), failed (why), stopped (it was
killed or interrupted; the sweep's command resumes it), missing.
"""

import os
import sys
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from softgm_bench import command
from softgm_bench.config import config_directory
from softgm_bench.errors import UserError


@dataclass
class Options:
    """The command's own settings; meanings above."""

    grid: str | None = None


def main() -> int:
    """Run what the command line says; 0, or 2 after one line about what is wrong."""
    return command.run("status", __doc__, _status)


def _status(arguments: list[str]) -> None:
    folder, options, _ = command.parse(arguments, Options, "folder of runs")
    if options.grid is None and not folder.is_dir():
        raise UserError(f"{folder}: no such folder")
    print(table(folder, _cells(folder, options.grid) if options.grid else _runs(folder)))


def table(folder: Path, runs: Sequence[Path]) -> str:
    """A line for each run folder, and how many there are of each kind."""
    from softgm_bench.sweeps import record as sweep_record

    states = [sweep_record.state(run) for run in runs]
    names = [os.path.relpath(run, folder) for run in runs]
    width = max(map(len, names), default=0)
    lines = [
        f"{name:<{width}}  {state.kind:<7}  {state.detail}".rstrip() for name, state in zip(names, states, strict=True)
    ]
    kinds = Counter(state.kind for state in states)
    order = (sweep_record.DONE, sweep_record.RUNNING, sweep_record.FAILED, sweep_record.STOPPED, sweep_record.MISSING)
    counts = ", ".join(f"{kinds[kind]} {kind}" for kind in order if kinds[kind])
    return "\n".join([*lines, f"{len(runs)} run{'s' * (len(runs) != 1)}{': ' + counts if counts else ''}"])


def _runs(folder: Path) -> list[Path]:
    """Every run folder below ``folder``."""
    signs = {"config.yaml", "running.json", "failure.json"}
    found = []
    for path, folders, files in os.walk(folder):
        folders[:] = sorted(name for name in folders if name != "checkpoints" and not name.startswith("."))
        if signs & set(files):
            found.append(Path(path))
    return found


def _cells(folder: Path, grid: str) -> list[Path]:
    """Run folders of a grid that was launched into ``folder``."""
    from softgm_bench.sweeps import launch as sweep

    known = sorted(path.stem for path in (config_directory() / "grids").glob("*.yaml"))
    if grid not in known:
        raise UserError(f"grid={grid}: no such grid; choose one of {', '.join(known)}")
    cells, top = sweep.cells([f"+grids={grid}"])
    return [folder / cell.run_dir.relative_to(top) for cell in cells]


if __name__ == "__main__":
    sys.exit(main())
