"""Training in processes of its own, which can be killed, and what two runs have written, for comparison."""

import csv
import json
import multiprocessing
import os
import resource
import signal
from pathlib import Path

import torch

from softgm_bench.runs import checkpoint
from softgm_bench.runs.ending import REHEARSAL
from softgm_bench.storage.run_folder import RunFolder

TINY = (
    "experiment=smoke",
    "recipe=paper",
    "threads=1",
    "experiment.total_frames=160",
    "experiment.num_envs=4",
    "experiment.steps_per_batch=4",
    "experiment.train_horizon=7",
    "experiment.evaluation.interval=48",
    "experiment.evaluation.episodes=2",
    "experiment.evaluation.horizon=2",
    "experiment.evaluation.final_horizon=2",
    "experiment.evaluation.final_episodes=3",
    "experiment.checkpoint.interval=32",
    "rod.n_elements=20",
)
PPO = ("algo.epochs=2", "algo.minibatch_size=8")
SMALL = (*TINY, *PPO, "model.hidden=16")  # of SoftGM on basic
TIMINGS = ("wall_time", "frames_per_second")

# A server that has everything imported and no threads yet: a process of its costs milliseconds, not seconds.
_context = multiprocessing.get_context("forkserver")
_context.set_forkserver_preload(["softgm_bench.runs.loop", "softgm_bench.runs.resume"])


def start(*overrides, dying=None, file_size=None):
    """A process that trains.

    Args:
        overrides: of its settings.
        dying: ``(name, before)``: it kills itself when a file of this name's beginning has been written beside its
            place and is about to be put there, or, unless ``before``, right after that. The rehearsal's files count
            under ``.rehearsal/`` alone.
        file_size: bytes that no file may exceed.
    """
    process = _context.Process(target=_train, args=(overrides, dying, file_size))
    process.start()
    return process


def _train(overrides, dying, file_size):
    from softgm_bench.config import compose
    from softgm_bench.runs import folder as run_folder
    from softgm_bench.runs.loop import train

    if dying is not None:
        name, before = dying
        replace = os.replace

        def replace_or_die(source, target):
            rehearsed = f"{REHEARSAL}/" if REHEARSAL in Path(target).parts else ""
            fatal = f"{rehearsed}{Path(target).name}".startswith(name)
            if not (fatal and before):
                replace(source, target)
            if fatal:
                os.kill(os.getpid(), signal.SIGKILL)

        run_folder.os.replace = replace_or_die
    if file_size is not None:
        resource.setrlimit(resource.RLIMIT_FSIZE, (file_size, file_size))
    train(compose(list(overrides)))


def written(folder):
    """Everything that a run has written down, without what depends on the clock."""
    with (folder / "metrics.csv").open() as file:
        rows = [_timeless(row) for row in csv.DictReader(file)]
    evaluations = folder / "evaluations.jsonl"
    looks = [_timeless(json.loads(line)) for line in evaluations.read_text().splitlines()]
    summary = _timeless(json.loads((folder / "summary.json").read_text()))
    return rows, looks, (folder / "episodes.csv").read_text(), summary


def state(folder):
    """The newest checkpoint of a run, without what depends on the clock, the folder and how often it was begun."""
    held = checkpoint.load(RunFolder(folder).newest())
    held["counters"].pop("wall_time")
    held.pop("config")
    return held


def differences(one, other, at=""):
    """Places in two nested states at which they are not equal bit for bit."""
    if isinstance(one, dict) and isinstance(other, dict) and one.keys() == other.keys():
        return [place for key in one for place in differences(one[key], other[key], f"{at}/{key}")]
    if isinstance(one, list) and isinstance(other, list) and len(one) == len(other):
        return [place for index in range(len(one)) for place in differences(one[index], other[index], f"{at}/{index}")]
    if isinstance(one, torch.Tensor) and isinstance(other, torch.Tensor) and one.dtype == other.dtype:
        same = one.shape == other.shape and torch.equal(one.nan_to_num(), other.nan_to_num())
        return [] if same else [at]
    return [] if type(one) is type(other) and one == other else [at]


def _timeless(row):
    return {name: value for name, value in row.items() if name not in TIMINGS}
