"""Training that begins with a trained policy."""

import pytest
import torch

from off_policy_cases import SHORT, batches, copied
from softgm_bench.algorithms import build_algorithm
from softgm_bench.envs import make_env

pytestmark = pytest.mark.usefixtures("one_thread")

FRAMES = 32  # of a batch: 4 environments, 8 steps
PPO = ("algo.epochs=2", "algo.minibatch_size=16")
OFF_POLICY = ("algo.batch_size=16", "algo.replay_capacity=200", "algo.random_frames=0", "algo.updates_per_frame=0.1")
CASES = {"softgm": PPO, "ippo": PPO, "maddpg": OFF_POLICY, "isac": OFF_POLICY}


@pytest.fixture(params=CASES)
def build(request, settings):
    def algorithm(seed):
        config = settings("task=basic", f"algo={request.param}", *CASES[request.param], "model.hidden=16")
        torch.manual_seed(seed)
        env = make_env(config.task, SHORT, num_envs=4, seed=0, horizon=7)
        return build_algorithm(config.algo, config.model, env), env

    return algorithm


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


def critic_of(algorithm):
    """Every parameter that the policy does not have, a temperature's aside."""
    of_policy = {id(parameter) for parameter in algorithm.policy.parameters()}
    named = dict(algorithm.loss.named_parameters())
    return {k: v.detach().clone() for k, v in named.items() if id(v) not in of_policy and "alpha" not in k}


def test_a_run_that_begins_with_a_policy_acts_as_it_and_lets_the_critic_learn_alone_at_first(build):
    trained = copied(build(seed=1)[0].policy.state_dict())
    algorithm, env = build(seed=0)
    assert not same(trained, algorithm.policy.state_dict())
    algorithm.begin_with(trained, 2 * FRAMES)
    assert same(trained, algorithm.policy.state_dict())

    held = []
    for batch in batches(algorithm, env, count=3):
        critic = critic_of(algorithm)
        algorithm.update(batch)
        held.append(same(trained, algorithm.policy.state_dict()))
        after = critic_of(algorithm)
        assert critic
        assert not same(critic, after)
    waited = 2 if hasattr(algorithm, "advantage") else 1  # off policy, frames are stored before they are learnt from
    assert held == [True] * waited + [False] * (3 - waited)


def test_targets_follow_the_actor_that_was_given(settings):
    config = settings("task=basic", "algo=maddpg", *OFF_POLICY, "model.hidden=16")
    algorithms = []
    for seed in (0, 1):
        torch.manual_seed(seed)
        env = make_env(config.task, SHORT, num_envs=4, seed=0, horizon=7)
        algorithms.append(build_algorithm(config.algo, config.model, env))
    algorithm, other = algorithms
    algorithm.begin_with(other.policy.state_dict(), 0)
    target = algorithm.loss.target_actor_network_params.flatten_keys(".")
    wanted = other.loss.actor_network_params.flatten_keys(".")
    assert len(list(target.keys())) > 0
    assert all(torch.equal(target[name].data, wanted[name].data) for name in wanted.keys())  # noqa: SIM118


def test_an_actor_that_waits_goes_on_waiting_when_its_run_is_resumed(build):
    algorithm, env = build(seed=0)
    algorithm.begin_with(None, 3 * FRAMES)
    (batch,) = batches(algorithm, env)
    algorithm.update(batch)
    saved = copied(algorithm.state_dict())
    resumed, _ = build(seed=2)
    resumed.begin_with(None, 3 * FRAMES)
    resumed.load_state_dict(saved)
    before = copied(resumed.policy.state_dict())
    resumed.update(batch)
    assert same(before, resumed.policy.state_dict())
    for _ in range(2):
        resumed.update(batch)
    assert not same(before, resumed.policy.state_dict())


def test_a_run_that_begins_with_nothing_learns_from_its_first_frame(build):
    algorithm, env = build(seed=0)
    before = copied(algorithm.policy.state_dict())
    for batch in batches(algorithm, env, count=1):
        algorithm.update(batch)
    assert not same(before, algorithm.policy.state_dict())
