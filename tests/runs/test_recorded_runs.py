"""A whole run with recorded gradient and control steps is the run without; the graph is a stand-in on the CPU."""

import csv
from unittest import mock

import pytest
import torch

from dense import force_dense
from pairwise import partly
from recordings import Broken, Repetition, recordings
from softgm_bench.config import Config, compose
from softgm_bench.runs.loop import train

TINY = (
    "experiment=smoke",
    "task=wall",
    "threads=1",
    "experiment.total_frames=64",
    "experiment.num_envs=4",
    "experiment.steps_per_batch=4",
    "experiment.train_horizon=3",
    "experiment.evaluation.interval=32",
    "experiment.evaluation.horizon=2",
    "experiment.evaluation.final_horizon=2",
    "experiment.evaluation.final_episodes=2",
    "experiment.checkpoint.interval=32",
    "rod.n_elements=20",
)
pytestmark = pytest.mark.usefixtures("one_thread")
SMALL = {
    "softgm": ("algo.epochs=2", "algo.minibatch_size=12"),
    "mappo": ("algo.epochs=2", "algo.minibatch_size=8", "algo.actor.memory={cell:gru,size:8}"),
    "masac": ("algo.batch_size=8", "algo.random_frames=8", "algo.updates_per_frame=0.1", "algo.replay_capacity=100"),
}


def run(folder, name, graphs):
    config = compose([*TINY, f"algo={name}", *SMALL[name], f"run_dir={folder}"])
    with force_dense(), mock.patch.object(Config, "graphs", graphs):
        train(config)
    rows = list(csv.DictReader((folder / "metrics.csv").open()))
    untimed = [{key: float(value) for key, value in row.items()} for row in rows]
    return [{key: row[key] for key in row if key not in ("wall_time", "frames_per_second")} for row in untimed]


@pytest.mark.parametrize("kind", [Repetition, Broken])
@pytest.mark.parametrize("name", partly(list(SMALL), ["mappo"]))
def test_a_recorded_run_learns_what_a_plain_one_does(tmp_path, name, kind):
    torch.manual_seed(0)
    expected = run(tmp_path / "plain", name, graphs=False)
    with recordings(kind) as log:
        found = run(tmp_path / "recorded", name, graphs=True)
    for row, other in zip(found, expected, strict=True):
        assert row == pytest.approx(other, rel=1e-3, abs=1e-4, nan_ok=True)
    # the gradient step, and where the policy follows no schedule the control step
    assert log.count("record") == (1 if name == "masac" else 2)
