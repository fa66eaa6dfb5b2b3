"""What one GPU does: rod steps, and the environment alone, with a policy and with its training.

``python benchmarks/bench_gpu.py`` prints two tables and writes the raw figures after every line. Every figure is the
best of several repetitions after a warm-up; a repetition ends when the GPU has finished. ``--short`` takes about a
minute; ``--device cpu`` with small ``--batches`` is a rehearsal. Without a GPU, and unless the CPU is asked for: one
line, exit status 2.

A rod step is one time step of one rod, as PyElastica-JAX counts (it published 7e5 to 7.7e5 a second, rods of 20
elements, on a GH200); an arm-second is a second of simulated time of one arm of 60 elements.
"""

import argparse
import resource
import sys
import time
from collections.abc import Callable, Iterator
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import torch
from record import write

from softgm_bench.assembly import build_algorithm, build_env, configure
from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, straight_rods
from softgm_bench.upstream.collector import FrameCollector

BATCHES, SHORT_BATCHES = (64, 256, 1024, 4096, 16384), (1024, 4096)
ELEMENTS = (20, 60)
PRECISIONS = (torch.float32, torch.float64)
TASKS = ("basic", "structured", "wall")
Add = Callable[[dict[str, Any]], None]
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


def rod_steps_per_second(
    scene: str,
    n_elements: int,
    num_envs: int,
    dtype: torch.dtype,
    device: torch.device,
    backend: str,
    contact_model: str = "pyelastica",
    repetitions: int = 5,
) -> tuple[float, float]:
    """Of all rods, after a second of motion; and the seconds of the first step, with compilation if it is the first."""
    parameters = RodParameters(contact_model=contact_model, n_elements=n_elements)
    rod = make_backend(backend, parameters)
    couple = torch.zeros(num_envs, 3, n_elements, dtype=dtype, device=device)
    couple[:, 1], couple[:, 0] = (torque * parameters.base_length / n_elements for torque in LEAN[scene])
    cylinders = None if scene == "no obstacle" else wall(num_envs, dtype, device)
    state = straight_rods(parameters, num_envs, dtype, device)

    def work() -> None:
        nonlocal state
        for _ in range(CONTROL_STEPS):
            state = rod.control_step(state, couple, cylinders=cylinders)

    first = best_seconds(lambda: rod.control_step(state, couple, cylinders=cylinders), device, 1)
    for _ in range(3):  # set in motion
        work()
    seconds = best_seconds(work, device, repetitions)
    if not bool(state.position.isfinite().all()):
        raise RuntimeError(f"{scene}, {num_envs} rods, {dtype}: the motion diverged, its rate means nothing")
    return num_envs * CONTROL_STEPS * parameters.substeps / seconds, first


class Training:
    """SoftGM's training on a task with the settings of ``experiment=gpu``, of which every part can be done alone."""

    def __init__(self, task: str, num_envs: int, device: torch.device, backend: str) -> None:
        """Build everything; nothing is written."""
        settings = [f"task={task}", "experiment=gpu", f"device={device}", f"backend={backend}"]
        sizes = [f"experiment.num_envs={num_envs}", f"algo.minibatch_size={min(16384, 16 * num_envs)}"]
        config = configure([*settings, *sizes])
        self.steps = config.experiment.steps_per_batch
        self.env = build_env(config, num_envs, 0, config.experiment.train_horizon, training=True)
        self.algorithm = build_algorithm(config, self.env)
        self.collector = FrameCollector(self.env, self.algorithm.policy, num_envs * self.steps)
        self._batches = iter(self.collector)
        self._current = self.env.reset()

    def simulate(self) -> None:
        """An iteration's steps under random actions, without the end of any episode."""
        for _ in range(self.steps):
            self._current = self.env.step(self.env.rand_action(self._current))["next"]

    def collect(self) -> Any:
        """An iteration's frames under the policy."""
        return next(self._batches)

    def iterate(self) -> None:
        """An iteration: frames and update."""
        self.algorithm.update(self.collect())


def peak_memory(device: torch.device) -> float:
    """Most memory so far, GB: the GPU's that torch has allotted, or the process's."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device) / 1e9
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def rod_cases(short: bool) -> Iterator[tuple[str, str, int]]:
    """Scene, contact model and elements of every case."""
    for n_elements in ELEMENTS:
        yield "no obstacle", "pyelastica", n_elements
    for scene in ("wall, touched",) if short else ("wall, not touched", "wall, touched"):
        for model in ("pyelastica",) if short else ("pyelastica", "exact"):
            yield scene, model, ELEMENTS[-1]


def rods(options: argparse.Namespace, device: torch.device, backend: str, add: Add) -> None:
    print("\nrod steps per second of all rods, and simulated seconds of all arms (60 elements) per second")
    print(f"{'scene':<19}{'contact':<12}{'elements':>8} {'dtype':<9}{'rods':>7}", end="")
    print(f"{'steps/s':>11}{'arm-s/s':>9}{'first, s':>10}")
    for (scene, model, n_elements), dtype, batch in product(rod_cases(options.short), PRECISIONS, options.batches):
        rate, first = rod_steps_per_second(scene, n_elements, batch, dtype, device, backend, model, options.repetitions)
        name = str(dtype).removeprefix("torch.")
        arms = rate * RodParameters().dt if n_elements == ELEMENTS[-1] else None
        print(f"{scene:<19}{model:<12}{n_elements:>8} {name:<9}{batch:>7}", end="")
        print(f"{rate:>11.3g}{'' if arms is None else f'{arms:.3g}':>9}{first:>10.2f}", flush=True)
        row = {"scene": scene, "contact_model": model, "elements": n_elements, "dtype": name, "rods": batch}
        add(row | {"rod_steps_per_s": rate, "arm_seconds_per_s": arms, "first_step_s": first})


def trainings(options: argparse.Namespace, device: torch.device, backend: str, add: Add) -> None:
    print("environment steps per second, float32, SoftGM with the settings of experiment=gpu")
    print(f"{'task':<12}{'environments':>13}{'simulate':>11}{'+ policy':>11}{'+ update':>11}{'peak, GB':>10}")
    for task in TASKS:
        for batch in options.batches:
            if device.type == "cuda":
                torch.cuda.empty_cache()
                torch.cuda.reset_peak_memory_stats(device)
            training = Training(task, batch, device, backend)
            rates = []
            for work in (training.simulate, training.collect, training.iterate):
                work()  # compile
                rates.append(batch * training.steps / best_seconds(work, device, options.repetitions))
            training.collector.shutdown()
            peak = peak_memory(device)
            print(f"{task:<12}{batch:>13}{''.join(f'{rate:>11.3g}' for rate in rates)}{peak:>10.2f}", flush=True)
            names = ("simulate_per_s", "with_policy_per_s", "with_update_per_s")
            row = {"task": task, "environments": batch, "dtype": "float32", **dict(zip(names, rates, strict=True))}
            add(row | {"peak_memory_gb": peak})


def described(device: torch.device) -> dict[str, Any]:
    """What the figures are of."""
    if device.type != "cuda":
        return {"name": "none: a rehearsal on the CPU"}
    properties = torch.cuda.get_device_properties(device)
    return {
        "name": properties.name,
        "compute_capability": f"{properties.major}.{properties.minor}",
        "multiprocessors": properties.multi_processor_count,
        "memory_gb": round(properties.total_memory / 1e9, 1),
        "cuda_of_torch": torch.version.cuda,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--batches", type=int, nargs="+", help="rods, and environments, at once")
    parser.add_argument("--device", default="cuda")
    parser.add_argument("--short", action="store_true", help="two sizes, two scenes, fewer repetitions")
    parser.add_argument("--repetitions", type=int, help="of which the best counts")
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/gpu.json"))
    options = parser.parse_args()
    options.batches = options.batches or (SHORT_BATCHES if options.short else BATCHES)
    options.repetitions = options.repetitions or (2 if options.short else 5)
    device = torch.device(options.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        print("bench_gpu: no CUDA GPU here, nothing to measure", file=sys.stderr)
        return 2
    if device.type == "cuda" and device.index is None:
        device = torch.device("cuda", torch.cuda.current_device())
    backend = "cuda" if device.type == "cuda" else "numba"
    result: dict[str, Any] = {"gpu": described(device), "rods": [], "training": []}

    def keep(part: str, row: dict[str, Any]) -> None:
        result[part].append(row)
        write(options.output, result, silently=True)  # a benchmark that is stopped leaves what it has

    # training first: it is what a short time should not cut off
    trainings(options, device, backend, lambda row: keep("training", row))
    rods(options, device, backend, lambda row: keep("rods", row))
    write(options.output, result)
    return 0


if __name__ == "__main__":
    sys.exit(main())
