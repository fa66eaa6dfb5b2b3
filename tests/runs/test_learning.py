import csv

import pytest

from softgm_bench.config import compose
from softgm_bench.runs.loop import train


@pytest.mark.slow
def test_softgm_learns_to_reach_on_basic(tmp_path):
    """A twentieth of the quick run, with as many updates as a quarter of it: the tip's mean distance falls by half."""
    overrides = ["task=basic", "experiment=quick", "experiment.total_frames=100_000"]
    overrides += ["experiment.num_envs=128", "algo.minibatch_size=800"]
    summary = train(compose([*overrides, f"run_dir={tmp_path}", "experiment.evaluation.final_horizon=200"]))

    with (tmp_path / "metrics.csv").open() as file:
        distance = [float(row["tip_distance"]) for row in csv.DictReader(file)]
    assert sum(distance[-5:]) / 5 < 0.5 * distance[0]
    assert summary["final_evaluation"]["success_rate"]["mean"] > 0.1
    assert summary["final_evaluation"]["diverged"] == 0
