import numpy as np
import pytest
import torch
from counting_env import N_AGENTS, CountingEnv
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import exploration_type

from dense import force_dense
from softgm_bench.envs import entries, make_env
from softgm_bench.episodes.evaluation import (
    CHECK_EVERY,
    EpisodeRecords,
    evaluate,
    evaluate_in_parts,
    evaluation_seed,
    watched,
)
from softgm_bench.episodes.summary import STEPS, success_by_step, summarise, table, wilson_interval
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.runs.loop import derive_seeds


def policy(seen=None):
    def act(tip):
        if seen is not None:
            seen.append((tip.shape[0], exploration_type().name, torch.is_grad_enabled()))
        return torch.ones(*tip.shape[:-1], N_AGENTS, 2) * torch.rand(())

    return TensorDictModule(act, in_keys=[entries.TIP], out_keys=[entries.ACTION])


def test_every_environment_counts_its_first_episode_and_no_more():
    records = evaluate(policy(), CountingEnv([3, 1, 7]), deterministic=True, seed=0, gamma=0.5)

    np.testing.assert_array_equal(records["length"], [3, 1, 7])
    np.testing.assert_allclose(records["undiscounted_return"], [3, 1, 7])
    np.testing.assert_allclose(records["discounted_return"], [1.75, 1.0, 2 - 0.5**6])
    np.testing.assert_allclose(records["tip_travel_distance"], [1.5, 0.5, 3.5])
    np.testing.assert_allclose(records["final_tip_step"], 0.5)
    np.testing.assert_allclose(records["final_distance"], [3, 1, 7])
    np.testing.assert_array_equal(records["success"], [True, False, True])
    np.testing.assert_array_equal(records["diverged"], [False, True, False])


def test_torques_are_means_over_the_episodes_own_steps():
    act = TensorDictModule(lambda tip: torch.ones(*tip.shape[:-1], N_AGENTS, 2), [entries.TIP], [entries.ACTION])

    records = evaluate(act, CountingEnv([2, 5]), deterministic=True, seed=0)

    np.testing.assert_allclose(records["torque_per_agent"], np.sqrt(2.0), rtol=1e-6)
    np.testing.assert_allclose(records["torque_joint"], 2.0, rtol=1e-6)


def test_ended_environments_cost_no_policy_evaluation_and_the_last_one_ends_the_work():
    seen = []

    evaluate(policy(seen), CountingEnv([3, 1, 2]), deterministic=True, seed=0)

    assert [count for count, _, _ in seen] == [3, 2, 1]


def test_looking_only_now_and_then_whether_episodes_go_on_changes_no_record():
    def records():
        act = TensorDictModule(lambda tip: torch.ones(*tip.shape[:-1], N_AGENTS, 2), [entries.TIP], [entries.ACTION])
        return evaluate(act, CountingEnv([3, 1, 20]), deterministic=True, seed=0).rows()

    expected = records()
    with force_dense():
        assert records() == expected


@pytest.mark.parametrize("free", [True, False])
def test_who_watches_is_told_of_every_step_and_every_end_and_changes_no_record(free, monkeypatch):
    monkeypatch.setattr("softgm_bench.rod.sync.is_free", lambda device: free)
    told = []
    lengths = [3, 1, 7]
    seen = evaluate(policy(), CountingEnv(lengths), deterministic=True, seed=0, watch=lambda *one: told.append(one))
    steps, ended = np.array(told).T
    assert steps.sum() == (max(lengths) if free else CHECK_EVERY)
    assert ended.sum() == len(lengths)
    if free:
        assert ended.tolist() == [1, 0, 1, 0, 0, 0, 1]
    alone = evaluate(policy(), CountingEnv(lengths), deterministic=True, seed=0)
    assert all(np.array_equal(seen[name], alone[name]) for name in alone)


def test_all_parts_of_an_evaluation_are_told_of_together():
    told = []
    watch = watched(5, lambda steps, words: told.append(words))
    evaluate_in_parts(
        policy(), lambda n, seed: CountingEnv([2] * n), 5, deterministic=True, seed=0, at_once=2, watch=watch
    )
    assert told[-1] == "5 of 5 episodes have ended"
    assert "2 of 5 episodes have ended" in told


@pytest.mark.parametrize(("deterministic", "expected"), [(True, "DETERMINISTIC"), (False, "RANDOM")])
def test_exploration_is_what_was_asked_for_and_gradients_are_off(deterministic, expected):
    seen = []

    evaluate(policy(seen), CountingEnv([2]), deterministic=deterministic, seed=0)

    assert {(name, grad) for _, name, grad in seen} == {(expected, False)}


def test_sampling_repeats_with_the_seed_and_leaves_the_global_generator_alone():
    torch.manual_seed(3)
    before = torch.get_rng_state()

    first, again, other = (
        evaluate(policy(), CountingEnv([4, 6]), deterministic=False, seed=seed)["torque_joint"] for seed in (1, 1, 2)
    )

    assert torch.equal(torch.get_rng_state(), before)
    np.testing.assert_array_equal(first, again)
    assert (first != other).all()


def test_summary_averages_episodes_and_counts_the_diverged_as_failures():
    metrics = summarise(evaluate(policy(), CountingEnv([3, 1, 7, 5]), deterministic=True, seed=0))

    assert metrics["episodes"] == 4
    assert metrics["success_rate"]["mean"] == 0.5
    assert metrics["diverged"] == 2
    assert metrics["episode_length"] == {"mean": 4.0, "std": np.sqrt(5.0)}


def test_wilson_interval_equals_published_values():
    # Newcombe (1998), Statistics in Medicine 17, table I: 81/263, 15/148, 0/20, 1/29.
    assert wilson_interval(81, 263) == pytest.approx((0.2553, 0.3662), abs=5e-5)
    assert wilson_interval(15, 148) == pytest.approx((0.0624, 0.1605), abs=5e-5)
    assert wilson_interval(0, 20) == pytest.approx((0.0, 0.1611), abs=5e-5)
    assert wilson_interval(1, 29) == pytest.approx((0.0061, 0.1718), abs=5e-5)


def arm(settings, num_envs, seed):
    return make_env(settings("task=wall").task, RodParameters(n_elements=20), num_envs, seed, horizon=40)


def test_an_arms_episode_is_the_sum_of_what_its_steps_say(settings):
    pushes = torch.tensor([[0.9, -0.2], [0.9, 0.4], [-0.9, 0.0]])[:, None].expand(3, 6, 2)
    act = TensorDictModule(lambda tip: pushes, in_keys=[entries.TIP], out_keys=[entries.ACTION])
    records = evaluate(act, arm(settings, 3, 0), deterministic=True, seed=5)
    env = arm(settings, 3, 0)
    env.set_seed(5)
    frames = env.rollout(40, act, break_when_any_done=False)["next"]

    assert records["length"].tolist() == [40, 40, 40]
    assert records["contact_steps"].max() >= 3
    assert records["discovered_bins"].max() > 3
    np.testing.assert_array_equal(records["contact_steps"], (frames[entries.CONTACT_NODES] > 0).sum((1, 2)))
    np.testing.assert_array_equal(records["discovered_bins"], frames[entries.DISCOVERED][:, -1, 0])
    np.testing.assert_array_equal(records["dropped_bins"], frames[entries.DROPPED][:, -1, 0])
    ways = frames[entries.TIP_STEP][..., 0].double().numpy()  # forgotten by a tenth a step; the first has all before it
    weights = 0.1 * 0.9 ** np.arange(39, -1, -1) / np.array([0.1] + [1.0] * 39)
    np.testing.assert_allclose(records["final_tip_step"], ways @ weights, rtol=1e-6)
    total = 0.0
    for name in entries.REWARD_TERM_NAMES:
        values = records[f"reward_{name}"]
        np.testing.assert_allclose(values, frames[entries.REWARD_TERMS, name].double().sum((1, 2)), rtol=1e-12)
        total = total + values
    np.testing.assert_allclose(records["undiscounted_return"], total, rtol=1e-6)


def test_parts_are_evaluations_with_seeds_of_their_own(settings):
    built = []

    def build(count, seed):
        built.append((count, seed))
        return arm(settings, count, seed)

    act = TensorDictModule(lambda tip: torch.ones(len(tip), 6, 2), in_keys=[entries.TIP], out_keys=[entries.ACTION])
    together = evaluate_in_parts(act, build, 5, deterministic=True, seed=3, at_once=2)
    assert [count for count, _ in built] == [2, 2, 1]
    assert len({seed for _, seed in built}) == 3
    single = [evaluate(act, arm(settings, count, 0), deterministic=True, seed=seed) for count, seed in built]
    np.testing.assert_array_equal(
        together["final_distance"], np.concatenate([part["final_distance"] for part in single])
    )
    assert together["contact_steps"].shape == (5,)


def test_what_a_task_does_not_tell_is_not_recorded(settings):
    records = evaluate_in_parts(policy(), lambda count, seed: CountingEnv([2] * count), 3, deterministic=True, seed=0)
    assert records["length"].tolist() == [2, 2, 2]
    assert "reward_time" not in records
    assert "contact_steps" not in records
    assert "reward_time" not in records.rows()[0]


def test_evaluations_never_draw_what_training_draws():
    numbers = range(100)
    own = {evaluation_seed(seed, part) for seed in numbers for part in range(3)}
    assert len(own) == 300
    assert not own & {word for seed in numbers for word in derive_seeds(seed)}


def test_success_by_a_step_counts_the_successes_that_took_no_longer_and_no_failure():
    columns = {"length": np.array([50, 51, 30, 400]), "success": np.array([True, True, False, False])}
    assert success_by_step(columns, 400) == {"50": 0.25, "100": 0.5, "200": 0.5, "400": 0.5}
    assert success_by_step(columns, 399) == {"50": 0.25, "100": 0.5, "200": 0.5}
    assert success_by_step(columns, 49) == success_by_step(columns, None) == {}


def test_a_summary_has_success_by_step_as_far_as_the_episodes_may_last():
    """The last is the success rate where it is the horizon; the printed table shows each."""
    columns = {"length": np.array([7, 200, 90]), "success": np.array([True, False, True])}
    metrics = summarise(EpisodeRecords(columns, horizon=200))
    assert metrics["success_by_step"] == {"50": 1 / 3, "100": 2 / 3, "200": 2 / 3}
    assert metrics["success_by_step"]["200"] == metrics["success_rate"]["mean"]
    assert "success by step 50   0.333\n" in table(metrics, "") + "\n"
    for records in (EpisodeRecords(columns, horizon=10), EpisodeRecords({"length": columns["length"]}, horizon=200)):
        assert "success_by_step" not in summarise(records)
    assert STEPS[-1] == 2000


def test_a_failure_is_motionless_if_its_tip_stood_still_at_the_end():
    columns = {
        "length": np.array([9, 9, 9, 9]),
        "success": np.array([True, False, False, False]),
        "final_tip_step": np.array([0.0, 0.9e-4, 1.1e-4, 0.0]),
    }
    assert summarise(EpisodeRecords(columns))["motionless_failures"] == 2
    del columns["final_tip_step"]
    assert "motionless_failures" not in summarise(EpisodeRecords(columns))


def test_records_know_how_long_episodes_may_last(settings):
    rod = RodParameters(n_elements=20, substeps=5)

    def build(count, seed):
        return make_env(settings("task=basic").task, rod, num_envs=count, seed=seed, horizon=2)

    act = TensorDictModule(lambda tip: torch.zeros(*tip.shape[:-1], 6, 2), [entries.TIP], [entries.ACTION])
    assert evaluate_in_parts(act, build, 3, deterministic=True, seed=0, at_once=2).horizon == 2
