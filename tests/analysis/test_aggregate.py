import numpy as np
import pytest

from made_up_runs import write_run
from softgm_bench.analysis import figures
from softgm_bench.analysis.aggregate import THRESHOLDS, aggregates, comparisons, success_rates
from softgm_bench.analysis.pools import newest, pool_runs
from softgm_bench.analysis.runs import find
from softgm_bench.analysis.statistics import Bootstrap

TASKS = ("basic", "structured", "wall")
BOOTSTRAP = Bootstrap(resamples=200, seed=0)


@pytest.fixture(scope="module")
def pools(tmp_path_factory):
    """SoftGM three seeds and IPPO one on every task, MAPPO on one task, an ablation, an oracle."""
    root = tmp_path_factory.mktemp("runs")
    for task in TASKS:
        for seed in range(3):
            write_run(root, task, "softgm", seed, success=0.9 - 0.1 * seed)
        write_run(root, task, "ippo", 0, success=0.3)
        write_run(root, task, "softgm_no_stage1", 0)
    write_run(root, "basic", "mappo", 0, success=0.5)
    write_run(root, "wall", "softgm_oracle", 0, observation="oracle")
    return pool_runs(newest(find(root).runs)[0])


@pytest.fixture(scope="module")
def three_seeds(tmp_path_factory):
    """SoftGM and IPPO on every task, IPPO with other frames on one; MAPPO on one task; three seeds each."""
    root = tmp_path_factory.mktemp("runs")
    for seed in range(3):
        for task in TASKS:
            write_run(root, task, "softgm", seed, success=0.9)
            write_run(root, task, "ippo", seed, success=0.3, frames=2_000_000 if task != "wall" else 1_900_000)
        write_run(root, "basic", "mappo", seed, success=0.6)
    return pool_runs(newest(find(root).runs)[0])


def test_neither_ablations_nor_oracles_compete(pools):
    assert list(success_rates(pools)) == ["ippo", "mappo", "softgm"]


def test_an_interval_needs_several_seeds_and_an_aggregate_every_task(pools):
    entries = {entry.label: entry for entry in aggregates(pools, BOOTSTRAP)}
    assert entries["softgm"].iqm.interval is not None
    assert entries["ippo"].iqm.interval is None
    assert entries["mappo"].iqm is None
    assert entries["mappo"].missing == ("structured", "wall")


def test_aggregates_are_of_the_success_rates_of_runs(pools):
    (entry,) = [entry for entry in aggregates(pools, BOOTSTRAP) if entry.label == "softgm"]
    rates = np.concatenate([pools[task, "softgm"].success_rates for task in TASKS])
    assert entry.mean.value == pytest.approx(rates.mean())
    assert entry.iqm.value == pytest.approx(np.sort(rates)[2:7].mean())
    low, high = entry.iqm.interval
    assert rates.min() <= low <= entry.iqm.value <= high <= rates.max()


def test_each_pair_is_compared_once_over_the_tasks_on_which_both_are_comparable(three_seeds):
    pairs = {(pair.first, pair.second): pair for pair in comparisons(three_seeds, BOOTSTRAP)}
    assert set(pairs) == {("mappo", "ippo"), ("softgm", "ippo"), ("softgm", "mappo")}
    assert pairs["softgm", "ippo"].tasks == ("basic", "structured")  # IPPO had fewer frames on the third
    assert pairs["softgm", "mappo"].tasks == ("basic",)
    assert pairs["softgm", "ippo"].estimate.value == 1.0
    assert all(pair.estimate.interval is not None for pair in pairs.values())
    drawn = figures.improvement(list(pairs.values()))
    assert drawn.key == "probability_of_improvement"
    assert drawn.svg.count("SoftGM") >= 1


def test_with_fewer_seeds_than_three_none_is_compared(pools):
    assert comparisons(pools, BOOTSTRAP) == []


def test_a_profile_falls_from_all_runs_to_none(pools):
    drawn = {entry.label: entry.profile for entry in aggregates(pools, BOOTSTRAP) if entry.profile}
    assert set(drawn) == {"softgm", "ippo"}
    share = drawn["softgm"].value
    assert share[0] == 1.0
    assert share[-1] == 0.0
    assert (np.diff(share) <= 0).all()
    assert drawn["softgm"].interval.shape == (2, len(THRESHOLDS))
    assert drawn["ippo"].interval is None
