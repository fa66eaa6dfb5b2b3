"""One run: collect, update, evaluate, write down."""

import math
import time
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase

from softgm_bench import output
from softgm_bench.algorithms import Algorithm
from softgm_bench.assembly import build_algorithm, build_envs
from softgm_bench.config import Config, plain
from softgm_bench.envs import SectionMixture
from softgm_bench.envs.section_mixture import numbers_of
from softgm_bench.episodes.evaluation import EpisodeRecords
from softgm_bench.episodes.summary import summarise, table
from softgm_bench.errors import NotFinite, UserError
from softgm_bench.runs import checkpoint, divergence, ending, folder, resume, start
from softgm_bench.runs.budget import Budget
from softgm_bench.runs.interruption import Interrupted, Interruption
from softgm_bench.runs.loggers.guarded import Loggers, refuse_missing
from softgm_bench.runs.loggers.video import episode_video
from softgm_bench.runs.machine import give_back_memory, keep_memory, set_matmul, set_threads
from softgm_bench.runs.metrics import CsvWriter, EpisodeTracker, of_team, step_metrics, success_by_number
from softgm_bench.runs.progress import Progress
from softgm_bench.runs.run import Run, derive_seeds, frames_per_iteration, total_frames
from softgm_bench.storage.files import to_json
from softgm_bench.storage.run_folder import RunFolder
from softgm_bench.upstream import default_dtype
from softgm_bench.upstream.collector import FrameCollector, MixtureCollector, RecordingCollector


def train(config: Config) -> dict[str, Any]:
    """Run a checked configuration to its end, from its beginning or, with ``resume``, from its newest checkpoint.

    Returns:
        What ``summary.json`` holds.

    Raises:
        UserError: the run folder cannot be used, or not any longer, or holds a run with other settings.
        NotFinite: training has diverged; the last finite checkpoint is left, and why it failed, but no summary.
        Interrupted: SIGINT or one of ``interruption.STOPPING``; a checkpoint of the last whole iteration is left.
    """
    with output.unbreakable(), default_dtype.float32():
        return _train(config)


def _train(config: Config) -> dict[str, Any]:
    if config.resume and (summary := resume.finished(config, total_frames(config))) is not None:
        return summary
    refuse_missing(config)
    run = _build(config)
    try:
        with folder.exclusive(config.run_dir):
            _begin(run)
            ending.rehearse(run)
            with Loggers(config, run.folder.path, run.frames) as run.loggers:
                records = _go(run)
                return _finish(run, records)
    except OSError as error:  # a full disk, or a folder taken away
        place = error.filename or run.folder.path
        raise UserError(f"{place}: {error.strerror}; earlier checkpoints are whole, resume=true resumes it") from error
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
                watch = progress.evaluation(settings.final_episodes)
                return ending.play(run, settings.final_episodes, seed, settings.final_horizon, watch)
        except NotFinite as error:
            raise _told(run, error) from error
        except Interrupted as stop:
            stop.args = (f"interrupted after {run.frames} frames, resume=true resumes it; checkpoint: {_save(run)}",)
            raise


def _told(run: Run, error: NotFinite) -> NotFinite:
    """Complete the message, and leave it in the run's folder."""
    kept = run.folder.newest()
    last = f"the last finite checkpoint is {kept}" if kept else "there was no checkpoint yet"
    line = f"{error} after {run.frames} frames: training has diverged, {last}; try smaller learning rates"
    folder.write_failure(run.folder, line)
    return NotFinite(line)


def _build(config: Config) -> Run:
    """A run at its beginning; nothing is written yet."""
    started, budget = time.perf_counter(), Budget(config.experiment.minutes)
    seeds = derive_seeds(config.seed)
    set_threads(config.threads, config.matmul)
    if config.device != "cpu":
        set_matmul(config.matmul)
    keep_memory()
    torch.manual_seed(seeds.torch)
    experiment = config.experiment
    env = build_envs(config, experiment.num_envs, seeds.training, experiment.train_horizon, training=True)
    algorithm = build_algorithm(config, env)
    collector = _collector(config, env, algorithm)
    episodes = EpisodeTracker(experiment.num_envs, config.device)
    return Run(config, RunFolder(Path(config.run_dir)), seeds, env, algorithm, collector, episodes, started, budget)


def _collector(config: Config, env: Any, algorithm: Algorithm) -> FrameCollector | MixtureCollector:
    """A collector and, in ``algorithm``, gradient steps that are recorded as CUDA graphs, as far as the settings say.

    A policy whose exploration follows a schedule changes in other ways than a recording can see.
    """
    if config.graphs and hasattr(algorithm, "use_graphs"):
        algorithm.use_graphs()
    if isinstance(env, SectionMixture):
        steps = config.experiment.steps_per_batch
        return MixtureCollector(
            {
                f"n{number}": FrameCollector(member, algorithm.policy, member.batch_size[0] * steps)
                for number, member in env.members.items()
            }
        )
    recorded = config.graphs and hasattr(env, "in_place") and not hasattr(algorithm.policy, "schedule")
    kind = RecordingCollector if recorded else FrameCollector
    return kind(env, algorithm.policy, frames_per_iteration(config))


def _begin(run: Run) -> None:
    """Make the run's folder, or resume the run in it."""
    config = run.config
    state = resume.newest_state(config) if config.resume else None
    start.begin(run, resumed=state is not None)
    if state is None:
        folder.create(config.run_dir, plain(config), config.overwrite or config.resume)
    else:
        resume.restore(run, state)


def _learn(run: Run, interruption: Interruption, progress: Progress) -> None:
    experiment = run.config.experiment
    with CsvWriter(run.folder.metrics, append=run.iteration > 0) as metrics:
        _evaluate_if_due(run, interruption, progress)  # one that a signal interrupted before the run was resumed
        began = time.perf_counter()
        for batches in _batches(run):
            losses = _update(run, batches)
            frames = sum(batch.numel() for batch in batches)
            run.iteration += 1
            run.frames += frames
            row = _row(run, batches, losses, time.perf_counter() - began)
            metrics.write(row)
            run.loggers.metrics(row)
            divergence.check_update(run.algorithm, batches, losses)
            progress.advance(frames, row.get("success_rate", math.nan))
            interruption.check()
            run.budget.lap()
            if run.budget.is_short(ending.final_steps(run)):
                minutes = experiment.minutes
                progress.say(f"experiment.minutes={minutes}: training stops here, after {run.frames} frames")
                return
            _evaluate_if_due(run, interruption, progress)
            if _crossed(experiment.checkpoint.interval, run.frames, frames):
                _save(run)
                give_back_memory()
            began = time.perf_counter()


def _batches(run: Run) -> Iterator[Sequence[TensorDictBase]]:
    """A batch ``(num_envs, steps)`` for each iteration that is left, sampled from the current policy.

    Of a mixture one for each number of sections.
    """
    batches: Iterator[Any] = iter(run.collector)
    while run.frames < total_frames(run.config):
        batch = next(batches)
        yield batch if run.config.mixed else (batch,)


def _update(run: Run, batches: Sequence[TensorDictBase]) -> dict[str, float]:
    algorithm: Any = run.algorithm
    return algorithm.update_mixture(batches) if run.config.mixed else algorithm.update(*batches)


def _crossed(interval: int, frames: int, new_frames: int) -> bool:
    """Tell whether a multiple of ``interval`` lies among the newest frames."""
    return frames // interval > (frames - new_frames) // interval


def _row(
    run: Run, batches: Sequence[TensorDictBase], losses: dict[str, float], seconds: float
) -> dict[str, float | int]:
    batch = of_team(batches)
    return {
        "iteration": run.iteration,
        "frames": run.frames,
        "wall_time": run.wall_time,
        "frames_per_second": batch.numel() / seconds,
        **run.episodes.update(batch),
        **success_by_number(batches, numbers_of(run.config.task)),
        **step_metrics(batch),
        **losses,
    }


def _evaluate_if_due(run: Run, interruption: Interruption, progress: Progress) -> None:
    if run.evaluations == run.evaluations_due:
        return
    with interruption.at_once():
        settings = run.config.experiment.evaluation
        watch = progress.evaluation(settings.episodes)
        records = ending.play(run, settings.episodes, run.seeds.evaluation, settings.horizon, watch)
    run.evaluations += 1
    metrics = summarise(records)
    at = {"evaluation": run.evaluations, "iteration": run.iteration, "frames": run.frames, "wall_time": run.wall_time}
    with run.folder.evaluations.open("a") as file:
        file.write(to_json(at | metrics) + "\n")
    run.loggers.evaluation(run.frames, metrics)
    value, length = metrics["undiscounted_return"]["mean"], metrics["episode_length"]["mean"]
    achieved = f"success {metrics['success_rate']['mean']:.2f}" if "success_rate" in metrics else f"return {value:.2f}"
    oracle = " (oracle)" if run.config.oracle else ""
    progress.say(f"evaluation after {run.frames} frames{oracle}: {achieved}, {length:.1f} steps an episode")


def _save(run: Run) -> Path:
    folder.to_disk(run.folder)  # rows that a checkpoint counts on must not be lost where it is not
    keep = run.config.experiment.checkpoint.keep
    return checkpoint.save(run.folder, run.frames, run.state_dict(), keep)


def _finish(run: Run, records: EpisodeRecords) -> dict[str, Any]:
    config = run.config
    summary = ending.write(run, run.folder, records)
    metrics = summary["final_evaluation"]
    print(table(metrics, f"{config.label} on {config.task.name}, seed {config.seed}, {run.frames} frames:"))
    print(f"run folder: {run.folder.path}")
    video = partial(episode_video, config, run.algorithm.policy, run.env.sizes, run.frames)
    run.loggers.finish(run.frames, metrics, records.rows(), video)
    return summary
