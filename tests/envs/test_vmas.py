"""VMAS tasks: what our adapter returns is what VMAS itself computes; only beginning again is done in another way."""

import pytest
import torch
from torchrl.envs import check_env_specs

from softgm_bench.envs import entries
from softgm_bench.envs.vmas import OBSERVATION, SCENARIOS, VmasConfig, VmasEnv

vmas = pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")

ARGUMENTS = {"vmas_balance": {"n_agents": 4}, "vmas_navigation": {"n_agents": 3, "shared_rew": False}}
ENVS = 6


@pytest.fixture(params=SCENARIOS)
def config(request):
    return VmasConfig(request.param, horizon=100, limit_terminates=False, scenario=ARGUMENTS[request.param])


def theirs(config, seed):
    env = vmas.make_env(SCENARIOS[config.name], num_envs=ENVS, **config.scenario)
    return env, torch.stack(env.reset(seed=seed), dim=1)


def random_actions(env, steps):
    generator = torch.Generator().manual_seed(1)
    shape = (steps, ENVS, env.sizes.n_agents, 2)
    return torch.empty(shape).uniform_(-1.0, 1.0, generator=generator)


def step(env, data, action):
    """The step's data and what follows it, environments that are done beginning again."""
    return env.step_and_maybe_reset(data.set(entries.ACTION, action))


def test_specs_hold(config):
    check_env_specs(VmasEnv(config, ENVS, seed=0))


def test_steps_are_vmas_own(config):
    env = VmasEnv(config, ENVS, seed=3)
    data = env.reset()
    peer, observation = theirs(config, seed=3)
    torch.testing.assert_close(data[OBSERVATION], observation, rtol=0, atol=0)
    for action in random_actions(env, 15):
        data = env.step(data.set(entries.ACTION, action))["next"]
        observations, rewards, done, _ = peer.step(list(action.unbind(1)))
        torch.testing.assert_close(data[OBSERVATION], torch.stack(observations, dim=1), rtol=0, atol=0)
        torch.testing.assert_close(data[entries.REWARD].squeeze(-1), torch.stack(rewards).mean(0), rtol=0, atol=0)
        assert torch.equal(data[entries.TERMINATED].squeeze(-1), done)


def test_an_episode_that_begins_again_is_one_of_the_next_full_reset(config):
    env = VmasEnv(config, ENVS, seed=3)
    data = env.reset()
    peer, _ = theirs(config, seed=3)
    fresh = torch.stack(peer.reset(), dim=1)  # the draw after the first one
    actions = random_actions(env, 5)
    for action in actions[:3]:
        data = env.step(data.set(entries.ACTION, action))["next"]
    before = data[OBSERVATION].clone()
    mask = torch.tensor([False, True, False, False, True, False])
    data = env.reset(data.select("agents").set("_reset", mask.unsqueeze(-1)))
    torch.testing.assert_close(data[OBSERVATION][mask], fresh[:2], rtol=0, atol=0)
    torch.testing.assert_close(data[OBSERVATION][~mask], before[~mask], rtol=0, atol=0)

    for action in actions[3:]:  # the others go on as if nothing had happened, and the new ones as VMAS's do
        data = env.step(data.set(entries.ACTION, action))["next"]
        shifted = action.clone()
        shifted[:2] = action[mask]
        observations, _, _, _ = peer.step(list(shifted.unbind(1)))
        torch.testing.assert_close(data[OBSERVATION][mask], torch.stack(observations, dim=1)[:2], rtol=0, atol=0)
    undisturbed, _ = theirs(config, seed=3)
    for action in actions:
        observations, rewards, _, _ = undisturbed.step(list(action.unbind(1)))
    torch.testing.assert_close(data[OBSERVATION][~mask], torch.stack(observations, dim=1)[~mask], rtol=0, atol=0)
    mean = torch.stack(rewards).mean(0)
    torch.testing.assert_close(data[entries.REWARD].squeeze(-1)[~mask], mean[~mask], rtol=0, atol=0)


def test_more_episodes_than_one_store_holds(config):
    env = VmasEnv(config, ENVS, seed=0)
    data = env.reset()
    seen = [data[OBSERVATION]]
    for _ in range(5):
        data = env.reset(data.select("agents").set("_reset", (torch.arange(ENVS) < 4).unsqueeze(-1)))
        seen.append(data[OBSERVATION][:4])
    begun = torch.cat(seen).flatten(1)
    assert len(begun.unique(dim=0)) == len(begun)


@pytest.mark.parametrize("limit_terminates", [False, True])
def test_the_horizon_ends_an_episode(limit_terminates):
    config = VmasConfig("vmas_navigation", 100, limit_terminates, ARGUMENTS["vmas_navigation"])
    env = VmasEnv(config, ENVS, seed=0)
    data = env.reset()
    rest = torch.zeros(ENVS, env.sizes.n_agents, 2)
    for count in range(1, 102):
        now, data = step(env, data, rest)
        done, terminated, truncated = (
            now["next", key] for key in (entries.DONE, entries.TERMINATED, entries.TRUNCATED)
        )
        assert bool(done.all()) == bool(done.any()) == (count == 100)
        assert torch.equal(terminated, done & limit_terminates)
        assert torch.equal(truncated, done & (not limit_terminates))
        assert not data[entries.DONE].any()


def test_seeds_decide_and_global_generators_do_not(config):
    torch.manual_seed(0)
    one = VmasEnv(config, ENVS, seed=7).reset()[OBSERVATION]
    state = torch.get_rng_state()
    env = VmasEnv(config, ENVS, seed=8)
    other = env.reset()[OBSERVATION]
    env.reset(env.reset().select("agents").set("_reset", torch.ones(ENVS, 1, dtype=torch.bool)))
    assert torch.equal(torch.get_rng_state(), state)
    env.set_seed(7)
    assert torch.equal(env.reset()[OBSERVATION], one)
    assert not torch.equal(one, other)


def test_a_saved_state_goes_on_exactly(config):
    env, other = VmasEnv(config, ENVS, seed=0, horizon=4), VmasEnv(config, ENVS, seed=1, horizon=4)
    data = env.reset()
    actions = random_actions(env, 15)
    for action in actions[:6]:
        _, data = step(env, data, action)
    other.reset()
    other.load_simulation_state(env.simulation_state())
    other.set_generator_state(env.generator_state())
    copy = data.clone()
    for action in actions[6:]:
        _, data = step(env, data, action)
        _, copy = step(other, copy, action)
        assert torch.equal(data[OBSERVATION], copy[OBSERVATION])
        assert torch.equal(data[entries.DONE], copy[entries.DONE])
