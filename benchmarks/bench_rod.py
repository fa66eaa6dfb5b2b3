"""Rod substeps per second: the fused kernel and the PyTorch backend against PyElastica, measured in one run.

``python benchmarks/bench_rod.py`` prints a table and writes the raw figures. Everything runs on ``--threads`` threads
(by default one: rates per core); PyElastica's kernels are single-threaded. Each figure is the best of several
repetitions, so that other load on the machine spoils as little as possible.
"""

import argparse
import json
import os
import platform
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path

import elastica
import numba
import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "rod"))
from pyelastica_oracle import UP, Loads, Post, as_cylinders, build

from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import straight_rods

ARM = RodParameters()
SCENES = {
    "no obstacle": (),
    "two posts": tuple(Post((0.35, y, -0.2), UP, 1.2, 0.05) for y in (-0.16, 0.16)),
    "wall, 16 columns": tuple(Post((0.4, y, -0.2), UP, 1.4, 0.04) for y in np.linspace(-0.6, 0.6, 16)),
}
COUPLE = np.zeros((3, ARM.n_elements))
COUPLE[1] = 4.0 / ARM.n_elements  # leans sideways, in free space


def pyelastica_rate(posts: tuple[Post, ...], control_steps: int) -> float:
    """Substeps per second of one rod, with PyElastica's own pruning of cylinders."""
    simulator, _ = build(ARM, Loads(COUPLE), posts)
    simulator.finalize()
    stepper, dt = elastica.PositionVerlet(), np.float64(ARM.dt)
    now = stepper.step(simulator, np.float64(0.0), dt)  # compile
    start = time.perf_counter()
    for _ in range(control_steps * ARM.substeps):
        now = stepper.step(simulator, now, dt)
    return control_steps * ARM.substeps / (time.perf_counter() - start)


def our_rate(backend: str, posts: tuple[Post, ...], num_envs: int, dtype: torch.dtype, control_steps: int) -> float:
    """Substeps per second over all rods."""
    rod = make_backend(backend, ARM)
    couple = torch.as_tensor(COUPLE, dtype=dtype).expand(num_envs, -1, -1).contiguous()
    obstacles = as_cylinders([posts] * num_envs, dtype) if posts else None
    state = rod.control_step(straight_rods(ARM, num_envs, dtype), couple, cylinders=obstacles, substeps=2)
    start = time.perf_counter()
    for _ in range(control_steps):
        state = rod.control_step(state, couple, cylinders=obstacles)
    return num_envs * control_steps * ARM.substeps / (time.perf_counter() - start)


def best(measure: Callable[[], float], repetitions: int) -> float:
    return max(measure() for _ in range(repetitions))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/rod.json"))
    options = parser.parse_args()
    numba.set_num_threads(options.threads)
    torch.set_num_threads(options.threads)

    rows = []
    print(f"substeps per second, {ARM.n_elements} elements, {options.threads} thread(s)")
    print(f"{'scene':<18}{'simulator':<26}{'rods':>5}{'rate':>12}{'us/substep':>12}{'ratio':>8}")
    for scene, posts in SCENES.items():
        reference = best(lambda posts=posts: pyelastica_rate(posts, 10), options.repetitions)
        measured = [("PyElastica " + version("pyelastica"), 1, reference)]
        for backend, dtype, num_envs, steps in (
            ("numba", torch.float64, options.num_envs, 5),
            ("numba", torch.float32, options.num_envs, 5),
            ("torch", torch.float64, options.num_envs, 1),
        ):
            rate = best(
                lambda a=(backend, posts, num_envs, dtype, steps): our_rate(*a),
                options.repetitions if backend == "numba" else 1,
            )
            measured.append((f"softgm_bench {backend} {str(dtype).removeprefix('torch.')}", num_envs, rate))
        for simulator, rods, rate in measured:
            ratio = rate / reference
            print(f"{scene:<18}{simulator:<26}{rods:>5}{rate:>12.0f}{1e6 / rate:>12.2f}{ratio:>8.1f}", flush=True)
            rows.append({"scene": scene, "simulator": simulator, "rods": rods, "substeps_per_s": rate, "ratio": ratio})
    result = {
        "threads": options.threads,
        "elements": ARM.n_elements,
        "machine": {"processor": _processor(), "cores": os.cpu_count()},
        "versions": {name: version(name) for name in ("softgm-bench", "pyelastica", "numba", "torch", "numpy")}
        | {"python": platform.python_version()},
        "rows": rows,
    }
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(result, indent=2) + "\n")
    print(f"written to {options.output}")


def _processor() -> str:
    for line in Path("/proc/cpuinfo").read_text().splitlines() if Path("/proc/cpuinfo").exists() else ():
        if line.startswith("model name"):
            return line.split(":", 1)[1].strip()
    return platform.processor()


if __name__ == "__main__":
    main()
