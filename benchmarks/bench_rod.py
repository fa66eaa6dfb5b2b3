"""Rod substeps per second: the fused kernel and the PyTorch backend against PyElastica, measured in one run.

``python benchmarks/bench_rod.py`` prints a table and writes the raw figures. Everything runs on ``--threads`` threads
(by default one: rates per core); PyElastica's kernels are single-threaded. The scenes are those of the tasks, the arm
leans sideways in free space; in the last scene it leans on the wall. PyElastica prunes cylinders as it is shipped.
"""

import argparse
from pathlib import Path
from typing import Any

import elastica
import numba
import numpy as np
import record
import torch
from timing import best_rate, kernel_rate, sideways

from softgm_bench.config import compose
from softgm_bench.envs.tasks import make_task
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.pyelastica_oracle import Loads, Post, as_cylinders, build, posts_of

ARM = RodParameters()
BATCHES = (1, 16, 64, 256, 1024)
WARM_UP = 25  # control steps, one second
LEAN = 16.0  # N m per m towards the wall


def task_posts(task: str) -> tuple[Post, ...]:
    """The obstacles of one episode."""
    scene = make_task(compose([f"task={task}"]).task).sample(1, torch.Generator().manual_seed(0))
    return posts_of(scene.cylinders, 0)


def couple(leans: bool, num_envs: int, dtype: torch.dtype) -> torch.Tensor:
    """N m on every element, ``(num_envs, 3, n_elements)``."""
    values = sideways(ARM, num_envs, dtype)
    if leans:
        values = torch.zeros_like(values)
        values[:, 0] = LEAN / ARM.n_elements
    return values


def pyelastica_rate(posts: tuple[Post, ...], leans: bool, rods: int, repetitions: int) -> float:
    """Substeps per second over all rods, all in one simulator; each rod has the obstacles for itself."""
    loads = Loads(couple(leans, 1, torch.float64)[0].numpy())
    simulator, _ = build(ARM, loads, posts, rods=rods)
    simulator.finalize()
    stepper, now, dt = elastica.PositionVerlet(), np.float64(0.0), np.float64(ARM.dt)
    for _ in range(WARM_UP * ARM.substeps if rods == 1 or leans else 1):
        now = stepper.step(simulator, now, dt)
    substeps = ARM.substeps if rods == 1 else 10

    def work() -> None:
        nonlocal now
        for _ in range(substeps):
            now = stepper.step(simulator, now, dt)

    return best_rate(work, rods * substeps, 0.5, repetitions)


def measure_scene(posts: tuple[Post, ...], leans: bool, repetitions: int) -> list[tuple[str, int, float]]:
    """Simulator, number of rods and rate of each row."""
    rows = [("PyElastica", 1, pyelastica_rate(posts, leans, 1, repetitions))]
    if not leans:
        rows.append(("PyElastica", 64, pyelastica_rate(posts, leans, 64, repetitions)))
    for backend, dtype, batches in (
        ("torch", torch.float64, (64,)),
        ("numba", torch.float64, BATCHES),
        ("numba", torch.float32, BATCHES),
    ):
        for num_envs in batches:
            rate = kernel_rate(
                ARM,
                dtype,
                num_envs,
                cylinders=as_cylinders([posts] * num_envs, dtype) if posts else None,
                couple=couple(leans, num_envs, dtype),
                backend=backend,
                seconds=0.5,
                warm_up=1 if backend == "torch" else WARM_UP,
                repetitions=1 if backend == "torch" else repetitions,
            )
            rows.append((f"{backend} {str(dtype).removeprefix('torch.')}", num_envs, rate))
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/rod.json"))
    options = parser.parse_args()
    numba.set_num_threads(options.threads)
    torch.set_num_threads(options.threads)

    rows: list[dict[str, Any]] = []
    print(f"rod substeps per second, {ARM.n_elements} elements, {options.threads} thread(s); ratio to PyElastica's rod")
    print(f"{'scene':<20}{'simulator':<16}{'rods':>5}{'rate':>12}{'us/substep':>12}{'ratio':>8}")
    for task, leans in (("basic", False), ("structured", False), ("wall", False), ("wall", True)):
        scene = f"{task}, leaning" if leans else task
        posts = task_posts(task)
        measured = measure_scene(posts, leans, options.repetitions)
        for simulator, rods, rate in measured:
            ratio = rate / measured[0][2]
            print(f"{scene:<20}{simulator:<16}{rods:>5}{rate:>12.0f}{1e6 / rate:>12.3f}{ratio:>8.1f}", flush=True)
            figures = {"rods": rods, "substeps_per_s": rate, "ratio": ratio}
            rows.append({"scene": scene, "cylinders": len(posts), "simulator": simulator} | figures)
    record.write(options.output, {"threads": options.threads, "elements": ARM.n_elements, "rows": rows})


if __name__ == "__main__":
    main()
