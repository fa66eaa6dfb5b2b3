"""What is compared: every algorithm on every task with every seed, in both frameworks. Needs no package."""

import argparse
import csv
import itertools
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

HERE = Path(__file__).parent
RESULTS = HERE / "results"
FRAMEWORKS = ("benchmarl", "softgm_bench")
ALGORITHMS = ("ippo", "mappo", "iddpg", "maddpg", "isac", "masac")
TASKS = ("balance", "navigation")
SEEDS = (0, 1, 2)
COLUMNS = ("framework", "algo", "task", "seed", "frames", "return_mean", "wall_time", "frames_per_second")
ON_POLICY = ("ippo", "mappo")


class Cell(NamedTuple):
    """One training run."""

    framework: str
    algo: str
    task: str
    seed: int

    @property
    def path(self) -> Path:
        """Where its results lie."""
        return RESULTS / f"{self.framework}-{self.task}-{self.algo}-seed{self.seed}.csv"

    @property
    def group(self) -> str:
        """Which part of ``settings.yaml`` it obeys, beside ``shared``."""
        return "on_policy" if self.algo in ON_POLICY else "off_policy"


def cells(
    algorithms: Iterable[str] = ALGORITHMS, tasks: Iterable[str] = TASKS, seeds: Iterable[int] = SEEDS
) -> list[Cell]:
    """The two frameworks take turns, so that whatever else the machine does meets both."""
    return [
        Cell(framework, algo, task, seed)
        for seed, task, algo, framework in itertools.product(seeds, tasks, algorithms, FRAMEWORKS)
    ]


def asked_for(framework: str, description: str | None) -> tuple[Cell, int]:
    """The cell that the command line names, and how many threads to use."""
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("algo", choices=ALGORITHMS)
    parser.add_argument("task", choices=TASKS)
    parser.add_argument("seed", type=int)
    parser.add_argument("--threads", type=int, default=1)
    arguments = parser.parse_args()
    return Cell(framework, arguments.algo, arguments.task, arguments.seed), arguments.threads


def write(cell: Cell, rows: Iterable[tuple[int, float, float]]) -> None:
    """Write frames, mean return and seconds of training until then; the file is there when the run has finished."""
    RESULTS.mkdir(exist_ok=True)
    unfinished = cell.path.with_suffix(".tmp")
    with unfinished.open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        for frames, value, seconds in rows:
            writer.writerow([*cell, frames, f"{value:.4f}", f"{seconds:.3f}", f"{frames / seconds:.1f}"])
    unfinished.replace(cell.path)
