import numpy as np
import pytest
import torch
from counting_env import N_AGENTS, CountingEnv
from tensordict.nn import TensorDictModule
from torchrl.envs.utils import exploration_type

from softgm_bench.envs import keys
from softgm_bench.experiment.evaluation import evaluate
from softgm_bench.experiment.summary import summarise, wilson_interval
from softgm_bench.rod.dense import force_dense


def policy(seen=None):
    def act(tip):
        if seen is not None:
            seen.append((tip.shape[0], exploration_type().name, torch.is_grad_enabled()))
        return torch.ones(*tip.shape[:-1], N_AGENTS, 2) * torch.rand(())

    return TensorDictModule(act, in_keys=[keys.TIP], out_keys=[keys.ACTION])


def test_every_environment_counts_its_first_episode_and_no_more():
    records = evaluate(policy(), CountingEnv([3, 1, 7]), deterministic=True, seed=0, gamma=0.5)

    np.testing.assert_array_equal(records.length, [3, 1, 7])
    np.testing.assert_allclose(records.undiscounted_return, [3, 1, 7])
    np.testing.assert_allclose(records.discounted_return, [1.75, 1.0, 2 - 0.5**6])
    np.testing.assert_allclose(records.tip_travel_distance, [1.5, 0.5, 3.5])
    np.testing.assert_allclose(records.final_distance, [3, 1, 7])
    np.testing.assert_array_equal(records.success, [True, False, True])
    np.testing.assert_array_equal(records.diverged, [False, True, False])


def test_torques_are_means_over_the_episodes_own_steps():
    act = TensorDictModule(lambda tip: torch.ones(*tip.shape[:-1], N_AGENTS, 2), [keys.TIP], [keys.ACTION])

    records = evaluate(act, CountingEnv([2, 5]), deterministic=True, seed=0)

    np.testing.assert_allclose(records.torque_per_agent, np.sqrt(2.0), rtol=1e-6)
    np.testing.assert_allclose(records.torque_joint, 2.0, rtol=1e-6)


def test_ended_environments_cost_no_policy_evaluation_and_the_last_one_ends_the_work():
    seen = []

    evaluate(policy(seen), CountingEnv([3, 1, 2]), deterministic=True, seed=0)

    assert [count for count, _, _ in seen] == [3, 2, 1]


def test_looking_only_now_and_then_whether_episodes_go_on_changes_no_record():
    def records():
        act = TensorDictModule(lambda tip: torch.ones(*tip.shape[:-1], N_AGENTS, 2), [keys.TIP], [keys.ACTION])
        return evaluate(act, CountingEnv([3, 1, 20]), deterministic=True, seed=0).rows()

    expected = records()
    with force_dense():
        assert records() == expected


@pytest.mark.parametrize(("deterministic", "expected"), [(True, "DETERMINISTIC"), (False, "RANDOM")])
def test_exploration_is_what_was_asked_for_and_gradients_are_off(deterministic, expected):
    seen = []

    evaluate(policy(seen), CountingEnv([2]), deterministic=deterministic, seed=0)

    assert {(name, grad) for _, name, grad in seen} == {(expected, False)}


def test_sampling_repeats_with_the_seed_and_leaves_the_global_generator_alone():
    torch.manual_seed(3)
    before = torch.get_rng_state()

    first, again, other = (
        evaluate(policy(), CountingEnv([4, 6]), deterministic=False, seed=seed).torque_joint for seed in (1, 1, 2)
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
