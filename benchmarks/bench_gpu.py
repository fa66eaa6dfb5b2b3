"""What one GPU does: rod substeps per second, environment steps per second, and a short training.

``python benchmarks/bench_gpu.py`` prints three tables and writes the raw figures. Every figure is the best of several
repetitions after a warm-up; a repetition ends when the GPU has finished. Without a GPU: one line, exit status 2.
"""

import argparse
import csv
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from record import write

from softgm_bench.config import compose
from softgm_bench.envs import make_env
from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, straight_rods
from softgm_bench.runs.loop import train

ARM = RodParameters()
BATCHES = (64, 256, 1024, 4096, 16384)
PRECISIONS = (torch.float32, torch.float64)
TASKS = ("basic", "structured", "wall")
CONTROL_STEPS = 10  # of a repetition
COLUMNS = np.linspace(-0.6, 0.6, 16)  # y of the wall's columns, m
# N m per m about d2 and d1: sideways in free space, or into the wall
LEAN = {"no obstacle": (4.0, 0.0), "wall, not touched": (4.0, 0.0), "wall, touched": (2.0, 16.0)}


def finish(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


def best_seconds(work: Callable[[], object], device: torch.device, repetitions: int) -> float:
    """Shortest time of ``work``, from an idle device to an idle device."""
    shortest = float("inf")
    for _ in range(repetitions):
        finish(device)
        start = time.perf_counter()
        work()
        finish(device)
        shortest = min(shortest, time.perf_counter() - start)
    return shortest


def wall(num_envs: int, dtype: torch.dtype, device: torch.device) -> Cylinders:
    """The same 16 upright columns for every rod."""
    start = torch.tensor([[0.4, y, -0.2] for y in COLUMNS], dtype=dtype, device=device).repeat(num_envs, 1, 1)
    one = torch.ones(start.shape[:2], dtype=dtype, device=device)
    return Cylinders(
        start=start,
        axis=torch.tensor([0.0, 0.0, 1.0], dtype=dtype, device=device).repeat(num_envs, len(COLUMNS), 1),
        length=1.4 * one,
        radius=0.04 * one,
        mask=one.bool(),
        batch_size=[num_envs],
    )


def substeps_per_second(
    scene: str,
    num_envs: int,
    dtype: torch.dtype,
    device: torch.device,
    backend: str = "cuda",
    contact_model: str = "pyelastica",
    repetitions: int = 5,
) -> float:
    """Of all rods, after a second of motion."""
    parameters = RodParameters(contact_model=contact_model)
    rod = make_backend(backend, parameters)
    couple = torch.zeros(num_envs, 3, ARM.n_elements, dtype=dtype, device=device)
    couple[:, 1], couple[:, 0] = (torque * ARM.base_length / ARM.n_elements for torque in LEAN[scene])
    cylinders = None if scene == "no obstacle" else wall(num_envs, dtype, device)
    state = straight_rods(parameters, num_envs, dtype, device)

    def work() -> None:
        nonlocal state
        for _ in range(CONTROL_STEPS):
            state = rod.control_step(state, couple, cylinders=cylinders)

    for _ in range(3):  # compile, and set in motion
        work()
    seconds = best_seconds(work, device, repetitions)
    if not bool(state.position.isfinite().all()):
        raise RuntimeError(f"{scene}, {num_envs} rods, {dtype}: the motion diverged, its rate means nothing")
    return num_envs * CONTROL_STEPS * parameters.substeps / seconds


def environment_steps_per_second(
    task: str, num_envs: int, dtype: torch.dtype, device: torch.device, backend: str = "cuda", repetitions: int = 3
) -> float:
    """Of all environments under random actions, before their episodes end."""
    config = compose([f"task={task}"])
    env = make_env(config.task, config.rod, num_envs, 0, device=device, backend=backend, dtype=dtype)
    current = env.reset()

    def work() -> None:
        nonlocal current
        for _ in range(CONTROL_STEPS):
            current = env.step(env.rand_action(current))["next"]

    work()
    return num_envs * CONTROL_STEPS / best_seconds(work, device, repetitions)


def training_frames_per_second(task: str, num_envs: int, overrides: list[str]) -> float:
    """Of the last of four iterations of PPO with the paper's recipe: collection and update together."""
    steps = 10
    with tempfile.TemporaryDirectory() as folder:
        config = compose(
            [
                f"task={task}",
                "algo=softgm",
                "recipe=paper",
                "experiment=smoke",
                f"experiment.num_envs={num_envs}",
                f"experiment.steps_per_batch={steps}",
                f"experiment.total_frames={4 * num_envs * steps}",
                f"experiment.evaluation.interval={100 * num_envs * steps}",
                f"experiment.checkpoint.interval={100 * num_envs * steps}",
                f"run_dir={folder}/run",
                *overrides,
            ]
        )
        train(config)
        with (Path(folder) / "run" / "metrics.csv").open() as file:
            return float(list(csv.DictReader(file))[-1]["frames_per_second"])


def rods(batches: tuple[int, ...], device: torch.device, backend: str = "cuda") -> list[dict[str, Any]]:
    rows = []
    print(f"rod substeps per second, {ARM.n_elements} elements\n{'scene':<20}{'contact':<12}{'dtype':<10}", end="")
    print("".join(f"{f'{batch} rods':>14}" for batch in batches))
    for scene in LEAN:
        for model in ("pyelastica",) if scene == "no obstacle" else ("pyelastica", "exact"):
            for dtype in PRECISIONS:
                name = str(dtype).removeprefix("torch.")
                print(f"{scene:<20}{'' if scene == 'no obstacle' else model:<12}{name:<10}", end="")
                for batch in batches:
                    rate = substeps_per_second(scene, batch, dtype, device, backend, model)
                    print(f"{rate:>14.3g}", end="", flush=True)
                    row = {"scene": scene, "contact_model": model, "dtype": name, "rods": batch}
                    rows.append(row | {"substeps_per_s": rate})
                print()
    return rows


def environments(batches: tuple[int, ...], device: torch.device, backend: str = "cuda") -> list[dict[str, Any]]:
    rows = []
    print(f"environment steps per second\n{'task':<14}{'dtype':<10}{'environments':>14}{'rate':>12}")
    for task in TASKS:
        for dtype in PRECISIONS:
            for batch in batches:
                rate = environment_steps_per_second(task, batch, dtype, device, backend)
                name = str(dtype).removeprefix("torch.")
                print(f"{task:<14}{name:<10}{batch:>14}{rate:>12.3g}", flush=True)
                rows.append({"task": task, "dtype": name, "environments": batch, "steps_per_s": rate})
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--batches", type=int, nargs="+", default=BATCHES)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/gpu.json"))
    options = parser.parse_args()
    if not torch.cuda.is_available():
        print("bench_gpu: no CUDA GPU here, nothing to measure", file=sys.stderr)
        return 2
    device = torch.device("cuda", torch.cuda.current_device())
    properties = torch.cuda.get_device_properties(device)
    description = {
        "name": properties.name,
        "compute_capability": f"{properties.major}.{properties.minor}",
        "multiprocessors": properties.multi_processor_count,
        "memory_gb": round(properties.total_memory / 1e9, 1),
        "cuda_of_torch": torch.version.cuda,
    }
    result = {
        "gpu": description,
        "rods": rods(tuple(options.batches), device),
        "environments": environments(tuple(options.batches), device),
        "training": [],
    }
    for batch in (128, 2048):
        rate = training_frames_per_second("basic", batch, ["device=cuda", "backend=cuda", "dtype=float32"])
        print(f"training on basic, {batch} environments, float32: {rate:.0f} frames per second")
        result["training"].append({"task": "basic", "environments": batch, "dtype": "float32", "frames_per_s": rate})
    write(options.output, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
