"""Training throughput: frames per second of the whole loop, per algorithm and task, and where the time goes.

``python benchmarks/bench_training.py`` prints a table and writes the raw figures. Each cell collects and updates as a
run with ``recipe=tuned`` does, from its first iteration on; evaluations are left out. Memory is warmed up and random
exploration of the off-policy algorithms cut short, so that every measured iteration takes its gradient steps. The time
is split into the simulator (with sensing, rewards and resets), the policy's actions, the update, and the rest, which is
TorchRL's collector. Each figure is that of the fastest repetition. ``frames_per_processor_s`` counts processor time
of all threads instead of the clock's, which hardly changes where others keep the processor busy too.
"""

import argparse
import itertools
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from record import write
from timing import Stopwatch
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from softgm_bench.algorithms import build_algorithm
from softgm_bench.config import compose
from softgm_bench.envs import make_env
from softgm_bench.runs.machine import keep_memory, set_threads

ALGORITHMS = ("softgm", "ippo", "mappo", "iddpg", "maddpg", "isac", "masac")
OFF_POLICY = ("iddpg", "maddpg", "isac", "masac")
TASKS = ("basic", "structured", "wall")
PARTS = ("simulator", "policy", "update", "framework")
FRAMES = 12_800  # at least so many between two looks at the clock, of PPO; a tenth of it off-policy


def measure(
    algo: str, task: str, repetitions: int, threads: int, settings: Sequence[str] = (), model: str | None = None
) -> dict[str, Any]:
    """The fastest repetition, with further settings: frames per second and each part's share."""
    off_policy = algo in OFF_POLICY
    config = compose(
        [f"algo={algo}", f"task={task}", "recipe=tuned", "experiment=quick"]
        + (["algo.random_frames=0"] if off_policy else [])
        + ([] if model is None else [f"model={model}"])
        + list(settings)
    )
    set_threads(threads, config.matmul)
    experiment = config.experiment
    env = make_env(config.task, config.rod, experiment.num_envs, 0, experiment.train_horizon, stagger=True)
    algorithm = build_algorithm(config.algo, config.model, env)
    stopwatch = Stopwatch()
    for owner, name, part in (
        (env, "step_and_maybe_reset", "simulator"),
        (algorithm.policy, "forward", "policy"),
        (algorithm, "update", "update"),
    ):
        stopwatch.watch(owner, name, part)
    per_iteration = experiment.num_envs * experiment.steps_per_batch
    iterations = max(1, (FRAMES // 10 if off_policy else FRAMES) // per_iteration)
    collector = Collector(
        env,
        algorithm.policy,
        frames_per_batch=per_iteration,
        total_frames=per_iteration * (iterations * (repetitions + 1)),
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
        track_traj_ids=False,
    )
    best: dict[str, Any] = {"frames_per_s": 0.0}
    quickest = 0.0
    batches = iter(collector)
    for repetition in range(repetitions + 1):
        stopwatch.seconds.clear()
        start, busy = time.perf_counter(), time.process_time()
        for _ in range(iterations):
            algorithm.update(next(batches))
        seconds = time.perf_counter() - start
        rate = iterations * per_iteration / seconds
        if repetition:
            quickest = max(quickest, iterations * per_iteration / (time.process_time() - busy))
        if repetition and rate > best["frames_per_s"]:  # the first one compiles and fills the replay
            shares = {part: round(stopwatch.seconds[part] / seconds, 4) for part in PARTS[:-1]}
            shares["framework"] = round(1.0 - sum(shares.values()), 4)
            best = {"frames_per_s": round(rate, 1), "shares": shares}
    collector.shutdown()
    named = {} if model is None else {"model": model}
    said = {"algo": algo, "task": task, **named, "num_envs": experiment.num_envs, "settings": list(settings)}
    return said | best | {"frames_per_processor_s": round(quickest, 1)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--repetitions", type=int, default=2)
    parser.add_argument("--algorithms", nargs="+", default=ALGORITHMS)
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--models", nargs="+", default=[None], help="instead of each algorithm's own")
    parser.add_argument(
        "--settings", nargs="+", default=(), help="further ones, e.g. 'algo.actor.memory={cell:gru,size:128}'"
    )
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/training.json"))
    options = parser.parse_args()
    threads = options.threads
    keep_memory()

    print(f"{threads} thread(s); shares of the time in %: {', '.join(PARTS)}")
    print(f"{'algorithm':<12}{'task':<12}{'frames/s':>10}   shares in %")
    rows = []
    for algo, model, task in itertools.product(options.algorithms, options.models, options.tasks):
        row = measure(algo, task, options.repetitions, threads, options.settings, model)
        shares = "".join(f"{100.0 * row['shares'][part]:>6.1f}" for part in PARTS)
        print(f"{algo:<12}{task:<12}{row['frames_per_s']:>10.0f}  {shares}  {model or ''}", flush=True)
        rows.append(row)
    write(options.output, {"threads": threads, "rows": rows})


if __name__ == "__main__":
    main()
