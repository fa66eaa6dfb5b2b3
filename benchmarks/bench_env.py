"""Environment steps per second, and where the time of a step goes.

``python benchmarks/bench_env.py`` prints a table and writes the raw figures. Actions are random, episodes last 200
control steps and are reset as they end; no policy is called. A step is split into the rod, sensing (with the count of
touching nodes), the rest of the step (reward, observation), resets, and what TorchRL adds. Each figure is that of the
fastest of several repetitions, so that other load on the machine spoils as little as possible.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import torch
from record import write
from timing import Stopwatch

from softgm_bench.config import compose
from softgm_bench.envs import SoftArmEnv, entries, make_env
from softgm_bench.runs.machine import set_threads

TASKS = ("basic", "structured", "wall")
SIZES = (1, 16, 64, 256, 1024)
DTYPES = {"float64": torch.float64, "float32": torch.float32}
HORIZON = 200
PARTS = ("rod", "sensing", "reward and observation", "resets", "framework")


def watched(env: SoftArmEnv) -> Stopwatch:
    stopwatch = Stopwatch()
    stopwatch.watch(env.backend, "control_step", "rod")
    for name in ("sense", "contacts"):
        stopwatch.watch(env.simulator, name, "sensing")
    stopwatch.watch(env, "_step", "reward and observation")
    stopwatch.watch(env, "maybe_reset", "resets")
    stopwatch.watch(env, "step_and_maybe_reset", "framework")
    return stopwatch


@torch.no_grad()
def measure(task: str, dtype: str, num_envs: int, device: str, repetitions: int) -> dict[str, Any]:
    """The fastest repetition: environment steps per second, milliseconds per step and each part's share."""
    config = compose([f"task={task}"])
    env = make_env(
        config.task, config.rod, num_envs, seed=0, horizon=HORIZON, device=device, dtype=DTYPES[dtype], stagger=True
    )
    generator = torch.Generator(device).manual_seed(0)
    shape = (HORIZON, num_envs, env.sizes.n_agents, 2)
    actions = 2.0 * torch.rand(shape, generator=generator, device=device) - 1.0
    stopwatch = watched(env)
    td = env.reset()
    for action in actions[:5]:  # compile, and leave the rest state
        _, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
    steps = min(max(2048 // num_envs, 20), HORIZON)
    best: dict[str, Any] = {"env_steps_per_s": 0.0}
    for _ in range(repetitions):
        stopwatch.seconds.clear()
        _wait(device)
        start = time.perf_counter()
        for action in actions[:steps]:
            _, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
        _wait(device)
        seconds = time.perf_counter() - start
        if num_envs * steps / seconds > best["env_steps_per_s"]:
            total = sum(stopwatch.seconds.values())
            shares = {part: round(stopwatch.seconds[part] / total, 4) for part in PARTS}
            best = {"env_steps_per_s": num_envs * steps / seconds, "ms_per_step": 1e3 * seconds / steps}
            # on a GPU the parts are those of the launching processor, not of the GPU
            best["shares"] = shares
    return {"task": task, "dtype": dtype, "num_envs": num_envs} | best


def _wait(device: str) -> None:
    if device != "cpu":
        torch.cuda.synchronize()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/env.json"))
    options = parser.parse_args()
    threads = set_threads(options.threads)

    print(f"{threads} thread(s), device {options.device}; shares of a step: {', '.join(PARTS)}")
    print(f"{'task':<12}{'precision':<10}{'envs':>6}{'env steps/s':>13}{'ms/step':>10}   shares in %")
    rows = []
    for task in TASKS:
        for dtype in DTYPES:
            for num_envs in options.sizes:
                row = measure(task, dtype, num_envs, options.device, options.repetitions)
                shares = "".join(f"{100.0 * row['shares'][part]:>6.1f}" for part in PARTS)
                rate = f"{row['env_steps_per_s']:>13.0f}{row['ms_per_step']:>10.3f}"
                print(f"{task:<12}{dtype:<10}{num_envs:>6}{rate}  {shares}", flush=True)
                rows.append(row)
    gpu = {} if options.device == "cpu" else {"gpu": torch.cuda.get_device_name()}
    write(options.output, {"threads": threads, "device": options.device, **gpu, "horizon": HORIZON, "rows": rows})


if __name__ == "__main__":
    main()
