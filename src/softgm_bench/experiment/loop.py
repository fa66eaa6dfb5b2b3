"""One run: collect, update, evaluate, write down."""

import ctypes
import math
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from softgm_bench.algorithms import Algorithm, build_algorithm
from softgm_bench.config import Config, UserError, available_threads, dtype_of, plain
from softgm_bench.envs import SoftArmEnv, make_env
from softgm_bench.envs.vmas import VmasConfig, VmasEnv
from softgm_bench.experiment import checkpoint, run_folder
from softgm_bench.experiment.evaluation import DISCOUNT, EpisodeRecords, evaluate
from softgm_bench.experiment.interruption import Interrupted, Interruption
from softgm_bench.experiment.metrics import CsvWriter, EpisodeTracker, step_metrics
from softgm_bench.experiment.progress import Progress
from softgm_bench.experiment.run_folder import RunFolder
from softgm_bench.experiment.summary import summarise, table, versions

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # glibc's malloc.h


class Seeds(NamedTuple):
    """Independent seeds derived from a run's one."""

    torch: int
    training: int
    evaluation: int
    final_evaluation: int


@dataclass
class Run:
    """A run under way.

    Attributes:
        frames: control steps of single environments that the policy has learnt from.
        evaluations: made so far.
    """

    config: Config
    folder: RunFolder
    seeds: Seeds
    env: SoftArmEnv | VmasEnv
    algorithm: Algorithm
    episodes: EpisodeTracker
    started: float
    iteration: int = 0
    frames: int = 0
    evaluations: int = 0

    @property
    def wall_time(self) -> float:
        """Seconds since the run began."""
        return time.perf_counter() - self.started


def train(config: Config) -> dict[str, Any]:
    """Run a checked configuration from beginning to end and return what ``summary.json`` holds.

    Raises:
        UserError: the run folder cannot be used, or not any longer.
        Interrupted: SIGINT or SIGTERM; a checkpoint of the last whole iteration is left.
    """
    run = _begin(config)
    try:
        records = _go(run)
        return _finish(run, records)
    except OSError as error:  # a full disk, or a folder taken away
        raise UserError(
            f"{error.filename or run.folder.path}: {error.strerror}; earlier checkpoints are whole"
        ) from error


def _go(run: Run) -> EpisodeRecords:
    """Train, then evaluate; an interruption leaves a checkpoint."""
    config = run.config
    total = _iterations(config) * _frames_per_iteration(config)
    with Interruption() as interruption, Progress(total) as progress:
        try:
            _learn(run, interruption, progress)
            _save(run)
            settings = config.experiment.evaluation
            progress.say(f"final evaluation: {settings.final_episodes} episodes")
            with interruption.at_once():
                seed = run.seeds.final_evaluation
                return _evaluate(run, settings.final_episodes, seed, settings.final_horizon)
        except Interrupted as stop:
            stop.args = (f"interrupted after {run.frames} frames; checkpoint: {_save(run)}",)
            raise


def derive_seeds(seed: int) -> Seeds:
    """Seeds that share nothing, so that evaluation and training never draw the same targets."""
    return Seeds(*(int(word) for word in np.random.SeedSequence(seed).generate_state(4)))


def set_threads(threads: int | None) -> int:
    """Let torch and Numba use this many threads, or all there are; returns how many.

    Matrix products on the CPU go to oneDNN. The package's ``__init__`` says why, and why they stay float32.
    """
    count = threads or available_threads()
    # Numba first: when it starts its threads, it sets OpenMP's number of them, which is torch's too
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    torch.set_num_threads(count)
    torch.backends.mkldnn.matmul.fp32_precision = "bf16"  # type: ignore[attr-defined]
    return count


def keep_memory() -> None:
    """Let glibc keep freed memory: tensors of a megabyte would otherwise be mapped anew, page by page, at every use."""
    if platform.libc_ver()[0] == "glibc":
        libc = ctypes.CDLL(None)
        libc.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        libc.mallopt(M_MMAP_THRESHOLD, 2**25)  # the largest that glibc accepts


def _begin(config: Config) -> Run:
    started = time.perf_counter()
    seeds = derive_seeds(config.seed)
    set_threads(config.threads)
    keep_memory()
    torch.manual_seed(seeds.torch)
    experiment = config.experiment
    env = _make_env(config, experiment.num_envs, seeds.training, experiment.train_horizon, training=True)
    try:
        algorithm = build_algorithm(config.algo, config.model, env, config.oracle)
    except ValueError as error:  # settings that do not fit together
        raise UserError(str(error)) from error
    folder = run_folder.create(config.run_dir, plain(config), config.overwrite)
    return Run(config, folder, seeds, env, algorithm, EpisodeTracker(experiment.num_envs, config.device), started)


def _make_env(
    config: Config, num_envs: int, seed: int, horizon: int | None, training: bool = False
) -> SoftArmEnv | VmasEnv:
    if isinstance(config.task, VmasConfig):
        return VmasEnv(config.task, num_envs, seed, horizon)
    return make_env(
        config.task,
        config.rod,
        num_envs=num_envs,
        seed=seed,
        horizon=horizon,
        device=config.device,
        backend=config.backend,
        dtype=dtype_of(config),
        stagger=training,
        curriculum=training,
    )


def _learn(run: Run, interruption: Interruption, progress: Progress) -> None:
    experiment = run.config.experiment
    with CsvWriter(run.folder.metrics) as metrics:
        began = time.perf_counter()
        for batch in _batches(run):
            losses = run.algorithm.update(batch)
            run.iteration += 1
            run.frames += batch.numel()
            row = _row(run, batch, losses, time.perf_counter() - began)
            metrics.write(row)
            progress.advance(batch.numel(), row.get("success_rate", math.nan))
            interruption.check()
            if _crossed(experiment.evaluation.interval, run.frames, batch.numel()):
                _evaluate_in_training(run, interruption, progress)
            if _crossed(experiment.checkpoint.interval, run.frames, batch.numel()):
                _save(run)
            began = time.perf_counter()


def _batches(run: Run) -> Iterator[TensorDictBase]:
    """As many batches ``(num_envs, steps)`` as the run has iterations, each sampled from the current policy."""
    collector = Collector(
        run.env,
        run.algorithm.policy,
        frames_per_batch=_frames_per_iteration(run.config),
        total_frames=_iterations(run.config) * _frames_per_iteration(run.config),
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
        track_traj_ids=False,  # nobody reads them, and counting them would wait for the device at every step
    )
    try:
        yield from collector
    finally:
        collector.shutdown()


def _frames_per_iteration(config: Config) -> int:
    return config.experiment.num_envs * config.experiment.steps_per_batch


def _iterations(config: Config) -> int:
    return -(-config.experiment.total_frames // _frames_per_iteration(config))


def _crossed(interval: int, frames: int, new_frames: int) -> bool:
    """Whether a multiple of ``interval`` lies among the newest frames."""
    return frames // interval > (frames - new_frames) // interval


def _row(run: Run, batch: TensorDictBase, losses: dict[str, float], seconds: float) -> dict[str, float | int]:
    return {
        "iteration": run.iteration,
        "frames": run.frames,
        "wall_time": run.wall_time,
        "frames_per_second": batch.numel() / seconds,
        **run.episodes.update(batch),
        **step_metrics(batch),
        **losses,
    }


def _evaluate(run: Run, episodes: int, seed: int, horizon: int | None) -> EpisodeRecords:
    env = _make_env(run.config, episodes, seed, horizon)
    deterministic = run.config.experiment.evaluation.deterministic
    return evaluate(run.algorithm.policy, env, deterministic=deterministic, seed=seed)


def _evaluate_in_training(run: Run, interruption: Interruption, progress: Progress) -> None:
    with interruption.at_once():
        settings = run.config.experiment.evaluation
        records = _evaluate(run, settings.episodes, run.seeds.evaluation, settings.horizon)
    run.evaluations += 1
    metrics = summarise(records)
    at = {"evaluation": run.evaluations, "iteration": run.iteration, "frames": run.frames, "wall_time": run.wall_time}
    with run.folder.evaluations.open("a") as file:
        file.write(run_folder.to_json(at | metrics) + "\n")
    value, length = metrics["undiscounted_return"]["mean"], metrics["episode_length"]["mean"]
    achieved = f"success {metrics['success_rate']['mean']:.2f}" if "success_rate" in metrics else f"return {value:.2f}"
    oracle = " (oracle)" if run.config.oracle else ""
    progress.say(f"evaluation after {run.frames} frames{oracle}: {achieved}, {length:.1f} steps an episode")


def _save(run: Run) -> Path:
    state = {
        "algorithm": run.algorithm.state_dict(),
        "random": checkpoint.random_state(),
        "environment": {
            "generator": run.env.generator_state(),
            "simulation": run.env.simulation_state().to_dict(),
        },
        "episodes": run.episodes.state_dict(),
        "counters": {"iteration": run.iteration, "evaluations": run.evaluations, "wall_time": run.wall_time},
        "config": plain(run.config),
        "versions": versions(),
    }
    return checkpoint.save(run.folder.checkpoints, run.frames, state, run.config.experiment.checkpoint.keep)


def _finish(run: Run, records: EpisodeRecords) -> dict[str, Any]:
    config = run.config
    with CsvWriter(run.folder.episodes) as episodes:
        for row in records.rows():
            episodes.write(row)
    metrics = summarise(records)
    summary = {
        "task": config.task.name,
        "algo": config.label,
        "model": plain(config)["model"]["name"],
        "observation": config.observation,
        "seed": config.seed,
        "frames": run.frames,
        "wall_time": run.wall_time,
        "threads": torch.get_num_threads(),
        "discount": DISCOUNT,
        "deterministic": config.experiment.evaluation.deterministic,
        "final_evaluation": metrics,
        "versions": versions(),
    }
    run_folder.write_atomically(run.folder.summary, (run_folder.to_json(summary, indent=2) + "\n").encode())
    print(table(metrics, f"{config.label} on {config.task.name}, seed {config.seed}, {run.frames} frames:"))
    print(f"run folder: {run.folder.path}")
    return summary
