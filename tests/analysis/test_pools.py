import pytest

from made_up_runs import write_evaluation, write_run
from softgm_bench.analysis.pools import by_condition, comparable, newest, pool_evaluations, pool_runs, wilson
from softgm_bench.analysis.runs import find
from softgm_bench.analysis.statistics import Bootstrap

BOOTSTRAP = Bootstrap(resamples=500, seed=0)


def pools_of(path):
    return pool_runs(newest(find(path).runs)[0])


def test_a_statistic_is_over_all_episodes_of_all_seeds(tmp_path):
    write_run(tmp_path, "basic", "softgm", 0, count=20)
    write_run(tmp_path, "basic", "softgm", 1, count=60)
    pool = pools_of(tmp_path)["basic", "softgm"]
    lengths = [length for one in pool.evaluations for length in one.episodes["length"]]
    assert len(lengths) == 80
    assert pool.statistic("length")[0] == pytest.approx(sum(lengths) / 80)
    assert pool.seeds == 2


def test_what_was_not_recorded_is_none(tmp_path):
    write_run(tmp_path, "basic", "softgm", 0)
    assert pools_of(tmp_path)["basic", "softgm"].statistic("heat") is None


def test_one_seed_has_wilsons_interval_and_several_the_bootstraps(tmp_path):
    write_run(tmp_path, "basic", "softgm", 0, success=0.5)
    pool = pools_of(tmp_path)["basic", "softgm"]
    assert pool.success_interval(BOOTSTRAP) == wilson(pool.evaluations[0])
    write_run(tmp_path, "basic", "softgm", 1, success=0.9)
    pool = pools_of(tmp_path)["basic", "softgm"]
    low, high = pool.success_interval(BOOTSTRAP)
    assert (low, high) == (pool.success_rates.min(), pool.success_rates.max())  # two seeds: either twice is likely


def test_an_interval_does_not_depend_on_what_else_was_run(tmp_path):
    for seed in range(3):
        write_run(tmp_path, "basic", "softgm", seed, success=0.5)
    alone = pools_of(tmp_path)["basic", "softgm"].success_interval(BOOTSTRAP)
    write_run(tmp_path, "basic", "mappo", 0)
    assert pools_of(tmp_path)["basic", "softgm"].success_interval(BOOTSTRAP) == alone


def test_of_two_runs_with_the_same_seed_the_longer_counts_and_the_other_is_named(tmp_path):
    write_run(tmp_path / "long", "basic", "softgm", 0, frames=3_000_000)
    write_run(tmp_path / "short", "basic", "softgm", 0, frames=1_000_000)
    (run,), ((left, instead),) = newest(find(tmp_path).runs)
    assert run.final.frames == 3_000_000
    assert instead is run
    assert left.final.frames == 1_000_000


def test_an_oracle_and_training_under_a_perturbation_are_marked_and_not_ranked(tmp_path):
    write_run(tmp_path, "wall", "softgm", 0)
    write_run(tmp_path, "wall", "softgm_oracle", 0, observation="oracle")
    write_run(tmp_path, "wall", "softgm_noise", 0, perturbation="noise")
    pools = pools_of(tmp_path)
    assert {label: (pool.marks, pool.ranked) for (_, label), pool in pools.items()} == {
        "softgm": ("", True),
        "softgm_oracle": ("†", False),
        "softgm_noise": ("§", False),
    }


def test_a_run_of_smoke_size_is_never_ranked(tmp_path):
    write_run(tmp_path, "wall", "mappo", 0)
    write_run(tmp_path, "wall", "softgm", 0, frames=384)
    pools = pools_of(tmp_path)
    assert (pools["wall", "softgm"].marks, pools["wall", "softgm"].ranked) == ("¶", False)
    assert (pools["wall", "mappo"].marks, pools["wall", "mappo"].ranked) == ("", True)


def test_a_run_that_began_with_a_trained_policy_is_marked_and_not_ranked(tmp_path):
    write_run(tmp_path, "wall", "mappo", 0)
    write_run(tmp_path, "wall", "softgm_started", 0, start="some.pt")
    pools = pools_of(tmp_path)
    assert (pools["wall", "softgm_started"].marks, pools["wall", "softgm_started"].ranked) == ("‖", False)
    assert (pools["wall", "mappo"].marks, pools["wall", "mappo"].ranked) == ("", True)


def test_a_curriculum_is_ranked_only_where_all_had_one(tmp_path):
    write_run(tmp_path, "wall", "softgm", 0, curriculum=True)
    write_run(tmp_path, "wall", "softgm_oracle", 0, observation="oracle")
    pool = pools_of(tmp_path)["wall", "softgm"]
    assert (pool.marks, pool.ranked) == ("‡", True)
    write_run(tmp_path, "wall", "mappo", 0)
    assert not pools_of(tmp_path)["wall", "softgm"].ranked
    assert pools_of(tmp_path)["wall", "mappo"].ranked


def test_evaluations_are_pooled_by_condition_and_other_settings_are_not(tmp_path):
    for seed in range(2):
        write_evaluation(tmp_path / f"noise{seed}", "wall", "softgm", seed, {"name": "noise", "position_sigma": 0.1})
    write_evaluation(tmp_path / "louder", "wall", "softgm", 0, {"name": "noise", "position_sigma": 0.2})
    write_evaluation(tmp_path / "other", "wall", "softgm", 0, {"name": "none"}, overrides=("task=wall",))
    pools = pool_evaluations(find(tmp_path).evaluations)
    assert {condition: pool.seeds for (_, _, condition), pool in pools.items()} == {
        "noise (position sigma 0.1)": 2,
        "noise (position sigma 0.2)": 1,
    }


def test_only_what_was_evaluated_under_a_perturbation_has_rows_of_conditions_beside_the_papers_own(tmp_path):
    for label in ("mappo", "ippo"):
        write_evaluation(tmp_path / label, "wall", label, 0, {"name": "none"})
    write_evaluation(tmp_path / "mappo_noise", "wall", "mappo", 0, {"name": "noise", "position_sigma": 0.1})
    rows = by_condition({}, pool_evaluations(find(tmp_path).evaluations))
    assert {subject: [name for name, pool in conditions if pool] for subject, conditions in rows.items()} == {
        ("wall", "softgm"): [],
        ("wall", "mappo"): ["none", "noise"],
    }


def test_algorithms_are_comparable_with_three_seeds_and_frames_that_are_equal_but_for_rounding(tmp_path):
    for seed in range(3):
        write_run(tmp_path, "basic", "softgm", seed, frames=1_000_000)
        write_run(tmp_path, "basic", "masac", seed, frames=1_011_200)
        write_run(tmp_path, "basic", "mappo", seed, frames=1_100_000)
        if seed < 2:
            write_run(tmp_path, "basic", "ippo", seed, frames=1_000_000)
    pools = pools_of(tmp_path)
    softgm = pools["basic", "softgm"]
    rivals = ("masac", "mappo", "ippo")
    assert [comparable(softgm, pools["basic", name]) for name in rivals] == [True, False, False]


def test_another_recipe_is_another_row_that_is_not_ranked(tmp_path):
    write_run(tmp_path / "tuned", "basic", "softgm", 0, frames=1_000_000)
    write_run(tmp_path / "paper", "basic", "softgm", 0, frames=2_000_000, recipe="paper")
    write_run(tmp_path / "old", "basic", "mappo", 0, recipe="open")
    pools = pools_of(tmp_path)
    assert {label: (pool.recipe, pool.ranked) for (_, label), pool in pools.items()} == {
        "softgm": ("tuned", True),
        "softgm_paper": ("paper", False),
        "mappo": ("tuned", True),
    }
    assert pools["basic", "softgm"].frames == [1_000_000]
    assert pools["basic", "softgm"].minutes == (10.0,)
