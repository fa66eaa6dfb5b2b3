"""The loop on tasks that are not the arm's: every algorithm runs, and what only the arm has is absent or refused."""

import csv
import json
import math
import sys

import pytest

from softgm_bench.assembly import configure
from softgm_bench.errors import UserError
from softgm_bench.runs.loop import train

SMALL = (
    "model=vector_mlp",
    "recipe=paper",
    "experiment=smoke",
    "threads=1",
    "experiment.total_frames=64",
    "experiment.num_envs=4",
    "experiment.steps_per_batch=8",
    "experiment.evaluation.interval=32",
    "experiment.evaluation.episodes=2",
    "experiment.evaluation.final_episodes=3",
)
OFF_POLICY = ("algo.batch_size=8", "algo.random_frames=40", "algo.updates_per_frame=0.1")


@pytest.fixture
def _vmas():
    pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")


@pytest.mark.usefixtures("_vmas")
@pytest.mark.parametrize("algo", ["ippo", "mappo", "iddpg", "maddpg", "isac", "masac"])
def test_every_algorithm_trains_on_it(algo, tmp_path):
    own = () if algo.endswith("ppo") else OFF_POLICY
    summary = train(configure(["task=vmas_balance", f"algo={algo}", f"run_dir={tmp_path / 'run'}", *SMALL, *own]))

    assert summary["final_evaluation"]["episodes"] == 3
    assert {"undiscounted_return", "episode_length"} <= summary["final_evaluation"].keys()
    assert "success_rate" not in summary["final_evaluation"]
    with (tmp_path / "run" / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    losses = [name for name in rows[-1] if name.startswith("loss")]
    assert losses
    assert all(math.isfinite(float(rows[-1][name])) for name in (*losses, "reward"))
    evaluations = (tmp_path / "run" / "evaluations.jsonl").read_text().splitlines()
    assert [json.loads(line)["frames"] for line in evaluations] == [32, 64]


@pytest.mark.usefixtures("_vmas")
@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (["task=vmas_balance", "algo=mappo"], "add model=vector_mlp"),
        (["task=basic", "algo=mappo", "model=vector_mlp"], "add model=mlp or softgm"),
        (["task=vmas_balance", "algo=iddpg", "model=vector_mlp", "algo.noise_correlation=0.5"], "must be 0"),
        (["task=vmas_balance", "algo=mappo", "model=vector_mlp", "algo.actor.persistence=0.5"], "must be 0"),
        (["task=vmas_balance", "algo=mappo", "model=vector_mlp", "task.horizon=0"], "task.horizon is 0"),
    ],
)
def test_what_does_not_fit_is_refused_in_one_line(overrides, said):
    with pytest.raises(UserError, match=said) as caught:
        configure(["recipe=paper", *overrides])
    assert "\n" not in str(caught.value)


def test_without_vmas_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "vmas", None)  # an import then fails
    with pytest.raises(UserError, match=r"needs VMAS: pip install '\.\[vmas\]'"):
        configure(["recipe=paper", "task=vmas_navigation", "algo=mappo", "model=vector_mlp"])
