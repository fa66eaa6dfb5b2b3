"""One run: collect, update, evaluate, write down."""

import ctypes
import math
import platform
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numba
import numpy as np
import torch
from tensordict import TensorDict, TensorDictBase

from softgm_bench.algorithms import Algorithm, build_algorithm
from softgm_bench.assembly import build_env
from softgm_bench.config import Config, UserError, available_threads, plain
from softgm_bench.envs import SoftArmEnv
from softgm_bench.envs.vmas import VmasEnv
from softgm_bench.episodes.evaluation import DISCOUNT, EpisodeRecords, evaluate
from softgm_bench.episodes.summary import summarise, table, versions
from softgm_bench.runs import checkpoint, resume
from softgm_bench.runs import folder as run_folder
from softgm_bench.runs.folder import RunFolder
from softgm_bench.runs.interruption import Interrupted, Interruption
from softgm_bench.runs.loggers.guarded import Loggers
from softgm_bench.runs.loggers.video import episode_video
from softgm_bench.runs.metrics import CsvWriter, EpisodeTracker, step_metrics
from softgm_bench.runs.progress import Progress
from softgm_bench.upstream.collector import FrameCollector

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
        started: when it would have begun if it had never been broken off, on the clock of ``time.perf_counter``.
        frames: control steps of single environments that the policy has learnt from.
        evaluations: made so far.
    """

    config: Config
    folder: RunFolder
    seeds: Seeds
    env: SoftArmEnv | VmasEnv
    algorithm: Algorithm
    collector: FrameCollector
    episodes: EpisodeTracker
    started: float
    iteration: int = 0
    frames: int = 0
    evaluations: int = 0
    loggers: Loggers = field(init=False)

    @property
    def wall_time(self) -> float:
        """Seconds since the run began, without those between being broken off and going on."""
        return time.perf_counter() - self.started

    @property
    def evaluations_due(self) -> int:
        """How many evaluations ``evaluation.interval`` asks for by now, at most one an iteration."""
        return min(self.iteration, self.frames // self.config.experiment.evaluation.interval)

    def state_dict(self) -> dict[str, Any]:
        """Everything that going on needs, and what it belongs to: tensors and plain Python values."""
        return {
            "algorithm": self.algorithm.state_dict(),
            "random": checkpoint.random_state(),
            "environment": {
                "generator": self.env.generator_state(),
                "simulation": self.env.simulation_state().to_dict(),
                "shown": self.collector.shown(),
            },
            "episodes": self.episodes.state_dict(),
            "counters": {"iteration": self.iteration, "evaluations": self.evaluations, "wall_time": self.wall_time},
            "config": plain(self.config),
            "versions": versions(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from a checkpoint: what ``state_dict`` returned, and ``frames``."""
        self.algorithm.load_state_dict(state["algorithm"])
        environment, counters = state["environment"], state["counters"]
        simulation = TensorDict(environment["simulation"], self.env.batch_size, device=self.env.device)
        self.env.load_simulation_state(simulation)
        self.env.set_generator_state(environment["generator"])
        self.collector.show(environment["shown"])
        self.episodes.load_state_dict(state["episodes"])
        self.iteration, self.evaluations = counters["iteration"], counters["evaluations"]
        self.frames = state["frames"]
        self.started -= counters["wall_time"]
        checkpoint.set_random_state(state["random"])  # last: nothing draws any more


def train(config: Config) -> dict[str, Any]:
    """Run a checked configuration to its end, from its beginning or, with ``resume``, from its newest checkpoint.

    Returns:
        What ``summary.json`` holds.

    Raises:
        UserError: the run folder cannot be used, or not any longer, or holds a run with other settings.
        Interrupted: SIGINT or SIGTERM; a checkpoint of the last whole iteration is left.
    """
    if config.resume and (summary := resume.finished(config, total_frames(config))) is not None:
        return summary
    run = _build(config)
    try:
        with run_folder.exclusive(config.run_dir):
            _begin(run)
            with Loggers(config, run.folder.path, run.frames) as run.loggers:
                records = _go(run)
                return _finish(run, records)
    except OSError as error:  # a full disk, or a folder taken away
        place = error.filename or run.folder.path
        raise UserError(f"{place}: {error.strerror}; earlier checkpoints are whole, resume=true goes on") from error
    finally:
        run.collector.shutdown()


def _go(run: Run) -> EpisodeRecords:
    """Train, then evaluate; an interruption leaves a checkpoint."""
    config = run.config
    with Interruption() as interruption, Progress(total_frames(config), run.frames) as progress:
        try:
            _learn(run, interruption, progress)
            _save(run)
            settings = config.experiment.evaluation
            progress.say(f"final evaluation: {settings.final_episodes} episodes")
            with interruption.at_once():
                seed = run.seeds.final_evaluation
                return _evaluate(run, settings.final_episodes, seed, settings.final_horizon)
        except Interrupted as stop:
            stop.args = (f"interrupted after {run.frames} frames, resume=true goes on; checkpoint: {_save(run)}",)
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


def _build(config: Config) -> Run:
    """A run at its beginning; nothing is written yet."""
    started = time.perf_counter()
    seeds = derive_seeds(config.seed)
    set_threads(config.threads)
    keep_memory()
    torch.manual_seed(seeds.torch)
    experiment = config.experiment
    env = build_env(config, experiment.num_envs, seeds.training, experiment.train_horizon, training=True)
    try:
        algorithm = build_algorithm(config.algo, config.model, env, config.oracle)
    except ValueError as error:  # settings that do not fit together
        raise UserError(str(error)) from error
    collector = FrameCollector(env, algorithm.policy, _frames_per_iteration(config))
    episodes = EpisodeTracker(experiment.num_envs, config.device)
    return Run(config, RunFolder(Path(config.run_dir)), seeds, env, algorithm, collector, episodes, started)


def _begin(run: Run) -> None:
    """Make the run's folder, or go on with the run in it."""
    config = run.config
    state = resume.newest_state(config) if config.resume else None
    if state is None:
        run_folder.create(config.run_dir, plain(config), config.overwrite or config.resume)
    else:
        resume.restore(run, state)


def _learn(run: Run, interruption: Interruption, progress: Progress) -> None:
    experiment = run.config.experiment
    with CsvWriter(run.folder.metrics, append=run.iteration > 0) as metrics:
        _evaluate_if_due(run, interruption, progress)  # one that the signal before a resumption broke off
        began = time.perf_counter()
        for batch in _batches(run):
            losses = run.algorithm.update(batch)
            run.iteration += 1
            run.frames += batch.numel()
            row = _row(run, batch, losses, time.perf_counter() - began)
            metrics.write(row)
            run.loggers.metrics(row)
            progress.advance(batch.numel(), row.get("success_rate", math.nan))
            interruption.check()
            _evaluate_if_due(run, interruption, progress)
            if _crossed(experiment.checkpoint.interval, run.frames, batch.numel()):
                _save(run)
            began = time.perf_counter()


def _batches(run: Run) -> Iterator[TensorDictBase]:
    """A batch ``(num_envs, steps)`` for each iteration that is left, sampled from the current policy."""
    batches = iter(run.collector)
    while run.frames < total_frames(run.config):
        yield next(batches)


def total_frames(config: Config) -> int:
    """Frames of a run: those that are asked for, rounded up to whole iterations."""
    frames = _frames_per_iteration(config)
    return -(-config.experiment.total_frames // frames) * frames


def _frames_per_iteration(config: Config) -> int:
    return config.experiment.num_envs * config.experiment.steps_per_batch


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
    env = build_env(run.config, episodes, seed, horizon)
    deterministic = run.config.experiment.evaluation.deterministic
    return evaluate(run.algorithm.policy, env, deterministic=deterministic, seed=seed)


def _evaluate_if_due(run: Run, interruption: Interruption, progress: Progress) -> None:
    if run.evaluations == run.evaluations_due:
        return
    with interruption.at_once():
        settings = run.config.experiment.evaluation
        records = _evaluate(run, settings.episodes, run.seeds.evaluation, settings.horizon)
    run.evaluations += 1
    metrics = summarise(records)
    at = {"evaluation": run.evaluations, "iteration": run.iteration, "frames": run.frames, "wall_time": run.wall_time}
    with run.folder.evaluations.open("a") as file:
        file.write(run_folder.to_json(at | metrics) + "\n")
    run.loggers.evaluation(run.frames, metrics)
    value, length = metrics["undiscounted_return"]["mean"], metrics["episode_length"]["mean"]
    achieved = f"success {metrics['success_rate']['mean']:.2f}" if "success_rate" in metrics else f"return {value:.2f}"
    oracle = " (oracle)" if run.config.oracle else ""
    progress.say(f"evaluation after {run.frames} frames{oracle}: {achieved}, {length:.1f} steps an episode")


def _save(run: Run) -> Path:
    run_folder.to_disk(run.folder)  # what a checkpoint goes on from must not be lost where it is not
    keep = run.config.experiment.checkpoint.keep
    return checkpoint.save(run.folder.checkpoints, run.frames, run.state_dict(), keep)


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
    video = partial(episode_video, config, run.algorithm.policy, run.frames)
    run.loggers.finish(run.frames, metrics, records.rows(), video)
    return summary
