"""Run every cell whose results are missing, one after another. Seeds are the outermost loop: a part is of use too.

A second one with the seeds the other way round, ``--seed 2 1 0``, shares the work: each looks again before it begins
a run.
"""

import argparse
import os
import subprocess
import sys
import time
from pathlib import Path

from cells import ALGORITHMS, HERE, SEEDS, TASKS, Cell, cells


def command(cell: Cell, threads: int) -> list[str]:
    """In the virtual environment of the cell's framework."""
    ours = cell.framework == "softgm_bench"
    python = sys.executable if ours else str(HERE / ".venv" / "bin" / "python")
    script = HERE / ("run_ours.py" if ours else "run_benchmarl.py")
    return [python, str(script), cell.algo, cell.task, str(cell.seed), "--threads", str(threads)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--algo", nargs="+", choices=ALGORITHMS, default=ALGORITHMS)
    parser.add_argument("--task", nargs="+", choices=TASKS, default=TASKS)
    parser.add_argument("--seed", nargs="+", type=int, default=SEEDS)
    arguments = parser.parse_args()
    missing = [cell for cell in cells(arguments.algo, arguments.task, arguments.seed) if not cell.path.exists()]
    environment = os.environ | {"OMP_NUM_THREADS": str(arguments.threads)}
    for number, cell in enumerate(missing, start=1):
        if cell.path.exists():
            continue
        began = time.perf_counter()
        done = subprocess.run(
            command(cell, arguments.threads), env=environment, capture_output=True, text=True, cwd=Path.cwd()
        )
        if done.returncode:
            sys.exit(f"{cell.path.name}: {done.stderr[-2000:]}")
        print(f"{number}/{len(missing)}  {cell.path.stem}  {time.perf_counter() - began:.0f} s", flush=True)


if __name__ == "__main__":
    main()
