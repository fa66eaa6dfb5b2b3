"""The end of a run: the final evaluation and the files that tell of it; all of it is tried at the beginning.

A run of hours must not fail in its last minute for a reason that was there in its first.
"""

import shutil
import time
from typing import Any

import torch

from softgm_bench.assembly import build_envs
from softgm_bench.config import plain
from softgm_bench.config.checks import device_type
from softgm_bench.episodes.evaluation import DISCOUNT, EpisodeRecords, Watch, evaluate
from softgm_bench.episodes.summary import summarise
from softgm_bench.runs import checkpoint
from softgm_bench.runs.metrics import CsvWriter
from softgm_bench.runs.run import Run
from softgm_bench.storage.files import to_json, write_atomically
from softgm_bench.storage.run_folder import RunFolder
from softgm_bench.storage.versions import versions

REHEARSAL = ".rehearsal"  # in the run folder, while the end is tried
TIMED_STEPS = 8  # control steps by which the final evaluation's duration is foretold


def play(run: Run, episodes: int, seed: int, horizon: int | None, watch: Watch | None = None) -> EpisodeRecords:
    """Evaluate the policy while ``watch`` follows; the run's budget learns what it took."""
    began = time.perf_counter()
    env = build_envs(run.config, episodes, seed, horizon)
    settings = run.config.experiment.evaluation
    records = evaluate(run.algorithm.policy, env, deterministic=settings.deterministic, seed=seed, watch=watch)
    # a GPU takes as long for few environments as for many, as long as launches are what takes time
    size = settings.final_episodes / episodes if device_type(run.config.device) == "cpu" else 1.0
    run.budget.measured((time.perf_counter() - began) * max(1.0, size), int(records["length"].max()))
    return records


def final_steps(run: Run) -> int:
    """Give the most control steps that the final evaluation takes."""
    return run.config.experiment.evaluation.final_horizon or run.config.task.horizon


def write(run: Run, folder: RunFolder, records: EpisodeRecords) -> dict[str, Any]:
    """Write ``episodes.csv`` and then ``summary.json``; where that is, the run is whole.

    Returns:
        What ``summary.json`` holds.

    Raises:
        OSError: a full disk, or a folder taken away.
    """
    config = run.config
    with CsvWriter(folder.episodes) as episodes:
        for row in records.rows():
            episodes.write(row)
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
        "final_evaluation": summarise(records),
        "versions": versions(),
    } | ({} if run.start is None else {"start": run.start})
    write_atomically(folder.summary, (to_json(summary, indent=2) + "\n").encode())
    return summary


def rehearse(run: Run) -> None:
    """Do at the beginning what the end needs: one step of the final evaluation, its files, a checkpoint that is read.

    No number of the run depends on it, and nothing of it stays. With a budget, a few more steps are timed.

    Raises:
        Exception: whatever the end would have raised.
    """
    folder = RunFolder(run.folder.path / REHEARSAL)
    shutil.rmtree(folder.path, ignore_errors=True)  # of a process that was killed in it
    before = checkpoint.random_state()
    try:
        folder.checkpoints.mkdir(parents=True)
        checkpoint.load(checkpoint.save(folder, run.frames, run.state_dict(), 1))
        write(run, folder, _few_steps(run, 1))
        if run.budget.limited:
            began = time.perf_counter()
            _few_steps(run, TIMED_STEPS)
            run.budget.measured(time.perf_counter() - began, TIMED_STEPS)
    finally:
        shutil.rmtree(folder.path, ignore_errors=True)
        checkpoint.set_random_state(before)  # in case that building an environment draws


def _few_steps(run: Run, steps: int) -> EpisodeRecords:
    """Begin the final evaluation; it may have fewer steps than asked for."""
    seed, settings = run.seeds.final_evaluation, run.config.experiment.evaluation
    env = build_envs(run.config, settings.final_episodes, seed, min(steps, final_steps(run)))
    return evaluate(run.algorithm.policy, env, deterministic=settings.deterministic, seed=seed)
