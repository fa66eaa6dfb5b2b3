"""Pairs of evaluations on the same scenes."""

import pytest

from made_up_runs import write_evaluation
from softgm_bench.analysis.interventions import pairs
from softgm_bench.analysis.pools import pool_evaluations
from softgm_bench.analysis.runs import find

NONE = {"name": "none"}


def write(folder, seed=0, task="wall", **further):
    return write_evaluation(folder, task, "softgm", seed, NONE, **further)


def pairs_of(path):
    return pairs(find(path).evaluations)


def test_the_same_policys_episodes_are_compared_one_by_one(tmp_path):
    write(tmp_path / "run" / "plain", success=0.7)
    write(tmp_path / "run" / "blind", success=0.4, intervention="blind")
    (pair,) = pairs_of(tmp_path)
    plain, blind = (one.episodes["success"] for one in (pair.plain, pair.intervened))
    assert (pair.intervened.intervention, pair.plain.intervention, pair.reason) == ("blind", "none", "")
    lost = sum(before and not after for before, after in zip(plain, blind, strict=True))
    won = sum(after and not before for before, after in zip(plain, blind, strict=True))
    assert (pair.discordance.lost, pair.discordance.won) == (lost, won)
    assert lost > won > 0
    assert 0 < pair.discordance.p < 0.05


DIFFERING = {
    "seed 1 and 2": {"evaluation_seed": 2},
    "horizon 2000 and 300": {"horizon": 300},
    "batch None and 50": {"batch": 50},
    "device cpu and cuda": {"device": "cuda"},
}


@pytest.mark.parametrize(("reason", "further"), list(DIFFERING.items()))
def test_other_scenes_are_not_compared_and_the_reason_is_said(tmp_path, reason, further):
    write(tmp_path / "plain", **further)
    write(tmp_path / "blind", intervention="blind")
    (pair,) = pairs_of(tmp_path)
    assert pair.plain is None
    assert pair.discordance is None
    assert pair.reason == f"not the same scenes: {reason}"


@pytest.mark.parametrize(
    "other", [{"seed": 1}, {"task": "wall_narrow"}, {"frames": 5}, {"deterministic": False}, {"overrides": ("a=1",)}]
)
def test_another_policy_or_world_is_no_partner(tmp_path, other):
    write(tmp_path / "plain", **other)
    write(tmp_path / "blind", intervention="blind")
    (pair,) = pairs_of(tmp_path)
    assert (pair.plain, pair.reason) == (None, "no evaluation of this policy without an intervention")


def test_of_several_the_one_that_lies_beside_it_counts_and_without_it_none(tmp_path):
    for run in ("one", "two"):
        write(tmp_path / run / "plain")
    write(tmp_path / "two" / "blind", intervention="blind")
    write(tmp_path / "elsewhere" / "swap", intervention="swap_obstacles")
    blind, swap = pairs_of(tmp_path)
    assert blind.plain.folder.endswith("two/plain")
    assert (swap.plain, swap.reason) == (None, "2 evaluations without an intervention: one must lie beside it")


def test_an_evaluation_under_an_intervention_enters_no_pool(tmp_path):
    write(tmp_path / "blind", intervention="blind")
    assert pool_evaluations(find(tmp_path).evaluations) == {}
    assert len(find(tmp_path).evaluations) == 1
