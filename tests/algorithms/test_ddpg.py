import dataclasses

import pytest
import torch
from bandit import ENV, LEARNS_FAST, error_after_learning
from torchrl.envs.utils import ExplorationType, set_exploration_type

from off_policy_cases import SHORT, SMALL, batches, filled, says, three_ends
from pairwise import partly
from softgm_bench.algorithms.ddpg import DDPG, DDPGConfig
from softgm_bench.algorithms.off_policy import AGENT_REWARD
from softgm_bench.envs import entries, make_env, views
from softgm_bench.models.action_value import ACTION_VALUE
from softgm_bench.models.mlp import MLPConfig

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def build(settings):
    def algorithm(name="iddpg", *overrides, task="basic", horizon=7):
        config = settings(f"task={task}", f"algo={name}", *SMALL, *overrides)
        torch.manual_seed(0)
        env = make_env(config.task, SHORT, num_envs=4, seed=0, horizon=horizon)
        return DDPG(config.algo, config.model, env), env

    return algorithm


@pytest.mark.parametrize("name", ["iddpg", "maddpg"])
def test_targets_bootstrap_at_a_truncation_and_not_at_a_termination(build, name):
    """Target critic 2, critic 0, discount 0.5, by hand: 1 + 1, 3 + 1, 5."""
    algorithm = filled(*build(name, "algo.gamma=0.5"))
    says(algorithm.loss.value_network_params.parameters(), 0.0)
    says(algorithm.loss.target_value_network_params.values(True, True), 2.0)
    losses = algorithm.loss(three_ends(algorithm))
    assert losses["target_value"].T.tolist() == [[2.0, 4.0, 5.0]] * 6
    assert losses["loss_value"].item() == pytest.approx((4 + 16 + 25) / 3)
    assert losses["loss_actor"].item() == 0.0


@pytest.mark.parametrize(("name", "mirror"), [("iddpg", "average"), ("maddpg", "canonical")])
def test_a_mirrored_policy_does_in_the_mirror_what_mirrors_its_actions(build, name, mirror):
    algorithm, env = build(name, f"algo.actor.mirror={mirror}", task="wall")
    with torch.no_grad():
        for parameter in algorithm.policy.parameters():
            parameter.normal_(std=0.1)
        td = env.rollout(3, auto_reset=True)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            here, there = (algorithm.policy(seen)[entries.ACTION] for seen in (td.clone(), views.mirrored(td)))
    torch.testing.assert_close(there, here * torch.tensor([1.0, -1.0]), rtol=1e-5, atol=1e-6)
    assert here.abs().min() > 1e-5


def test_the_target_network_follows_softly(build):
    algorithm, _ = build("iddpg", "algo.tau=0.25", "algo.target_actor=true")
    for name in ("value_network_params", "actor_network_params"):
        sources = list(getattr(algorithm.loss, name).parameters())
        targets = list(getattr(algorithm.loss, f"target_{name}").values(True, True))
        assert all(torch.equal(*pair) for pair in zip(sources, targets, strict=True))
        says(sources, 4.0)
        says(targets, 0.0)
        algorithm.target_update.step()
        assert (targets[-1] == 1.0).all()  # 0 + (4 - 0) / 4
        algorithm.target_update.step()
        assert (targets[-1] == 1.75).all()  # 1 + (4 - 1) / 4
        assert all((target == 0.0).all() for target in targets[:-1])


@pytest.mark.parametrize("name", ["iddpg", "maddpg"])
def test_the_actors_loss_asks_for_the_current_actions_of_all_agents(build, name):
    algorithm = filled(*build(name))
    transitions = algorithm.sample()
    critic = algorithm.loss.value_network
    with torch.no_grad(), algorithm.loss.value_network_params.to_module(critic):
        current = algorithm.policy.actor(transitions.copy())
        assert not torch.equal(current[entries.ACTION], transitions[entries.ACTION])
        expected = -critic(current)[ACTION_VALUE].mean()
    assert algorithm.loss(transitions)["loss_actor"].item() == pytest.approx(expected.item(), rel=1e-5)


def test_the_teams_reward_is_every_agents(build):
    transitions = filled(*build()).sample()
    assert transitions["next", entries.REWARD].shape == (16, 1)
    assert transitions["next", AGENT_REWARD].shape == (16, 6, 1)
    assert (transitions["next", AGENT_REWARD] == transitions["next", entries.REWARD].unsqueeze(1)).all()
    assert transitions["next", entries.REWARD].unique().numel() > 5


def observe(env):
    return env.reset().select(*entries.OBSERVATION)


def actions(policy, td, exploration, count=1):
    with torch.no_grad(), set_exploration_type(exploration):
        return torch.stack([policy(td.clone())[entries.ACTION] for _ in range(count)])


def test_noise_is_added_only_while_exploring_and_has_the_scheduled_sigma(build):
    algorithm, env = build("iddpg", "algo.initial_sigma=0.4", "algo.final_sigma=0.1", "algo.sigma_frames=64")
    td, policy = observe(env), algorithm.policy
    mean = policy.actor(td.clone())[entries.ACTION]
    assert mean.abs().max() < 0.1
    for exploration in (ExplorationType.DETERMINISTIC, ExplorationType.MEAN):
        assert torch.equal(actions(policy, td, exploration)[0], mean)
    explored = actions(policy, td, ExplorationType.RANDOM, 400)
    assert explored.abs().max() == 1.0  # cut
    assert (explored - mean).abs().median().item() == pytest.approx(0.6745 * 0.4, rel=0.05)  # cutting moves no median
    for batch, sigma in zip(batches(algorithm, env, count=3), (0.25, 0.1, 0.1), strict=True):
        algorithm.update(batch)
        assert policy.sigma == pytest.approx(sigma)
    assert torch.equal(actions(policy, td, ExplorationType.DETERMINISTIC)[0], policy.actor(td.clone())[entries.ACTION])


@pytest.mark.parametrize("correlation", [0.0, 0.8])
def test_noise_has_the_same_sigma_whatever_its_correlation(build, correlation):
    algorithm, env = build("iddpg", f"algo.noise_correlation={correlation}", "algo.initial_sigma=0.2")
    says(algorithm.policy.actor.parameters(), 0.0)
    td, taken = observe(env), []
    torch.manual_seed(0)
    for _ in range(600):
        taken.append(actions(algorithm.policy, td, ExplorationType.RANDOM)[0])
        td[entries.PREVIOUS_ACTION] = taken[-1]
    noise = torch.stack(taken)[20:]
    assert noise.std().item() == pytest.approx(0.2, rel=0.05)
    lag_one = (noise[1:] * noise[:-1]).mean() / noise.square().mean()
    assert lag_one.item() == pytest.approx(correlation, abs=0.03)


def test_actions_are_uniform_and_nothing_is_learnt_during_the_random_frames(build):
    algorithm, env = build("iddpg", "algo.random_frames=64", "algo.initial_sigma=0.01", "algo.final_sigma=0.01")
    seen = []
    for batch in batches(algorithm, env, count=3):
        before = [parameter.clone() for parameter in algorithm.loss.parameters()]
        metrics = algorithm.update(batch)
        changed = any(not torch.equal(*pair) for pair in zip(before, algorithm.loss.parameters(), strict=True))
        assert changed == (metrics["gradient_steps"] > 0)
        seen.append((metrics["gradient_steps"], batch[entries.ACTION].std().item()))
    assert [steps for steps, _ in seen] == [0.0, 3.0, 3.0]
    assert [spread for _, spread in seen[:2]] == pytest.approx([3**-0.5] * 2, rel=0.1)
    assert seen[2][1] < 0.1


def test_gradient_steps_per_frame_may_be_a_fraction(build):
    algorithm, env = build("iddpg", "algo.updates_per_frame=0.09")
    taken = [algorithm.update(batch)["gradient_steps"] for batch in batches(algorithm, env, count=4)]
    assert taken == [2.0, 3.0, 3.0, 3.0]  # of 2.88, 5.76, 8.64, 11.52


@pytest.mark.parametrize("model", ["mlp", "softgm"])
@pytest.mark.parametrize("name", ["iddpg", "maddpg"])
def test_an_update_moves_actor_critic_and_target_on_every_model(build, name, model):
    algorithm, env = build(name, f"model={model}", "model.hidden=16", "task.sensing_radius=0.4", task="wall")
    loss = algorithm.loss
    (batch,) = batches(algorithm, env)
    assert batch[entries.EDGE].any()
    groups = [loss.actor_network_params, loss.value_network_params, loss.target_value_network_params]
    before = [group.clone() for group in groups]
    metrics = algorithm.update(batch)
    for old, new in zip(before, groups, strict=True):
        moved = [not torch.equal(old[key], new[key]) for key in new.keys(True, True)]
        assert sum(moved) > 0.9 * len(moved)
    assert set(metrics) == {
        *("loss_actor", "loss_value", "q_mean", "target_mean", "actor_grad_norm", "critic_grad_norm"),
        *("gradient_steps", "replay_size", "actor_saturation", "actor_preactivation"),
    }
    assert all(torch.tensor(value).isfinite() for value in metrics.values())
    # the collector's policy is the loss's actor
    assert {p.data_ptr() for p in algorithm.policy.parameters()} == {
        p.data_ptr() for p in loss.actor_network_params.parameters()
    }


def test_without_the_replay_an_algorithm_waits_for_new_frames(build):
    algorithm, env = build("iddpg", "algo.random_frames=40")
    one, two, three, four = batches(algorithm, env, count=4)
    for batch in (one, two):
        algorithm.update(batch)
    state = algorithm.state_dict()
    assert "replay" not in state
    other, _ = build("iddpg", "algo.random_frames=40")
    other.load_state_dict(state)
    assert not other.policy.uniform
    assert [other.update(batch)["gradient_steps"] for batch in (three, four)] == [0.0, 3.0]


@pytest.mark.parametrize("name", partly(["iddpg", "maddpg"], ["maddpg"]))
def test_it_learns_what_each_agent_should_do(settings, name):
    config = dataclasses.replace(settings(f"algo={name}").algo, **LEARNS_FAST, initial_sigma=0.5, final_sigma=0.5)
    torch.manual_seed(0)
    algorithm = DDPG(config, MLPConfig(hidden=32, layers=2, velocity_scale=1.0), ENV)
    assert error_after_learning(algorithm, 32 + 60) < 0.02


@pytest.mark.parametrize(
    ("key", "value"), [("noise_correlation", 1.0), ("tau", 0.0), ("updates_per_frame", 0.0), ("gamma", 1.5)]
)
def test_values_that_make_no_sense_are_refused_by_name(settings, key, value):
    values = vars(settings("algo=iddpg").algo) | {key: value}
    with pytest.raises(ValueError, match=rf"^algo\.{key} is {value}: it must "):
        DDPGConfig(**values)


@pytest.mark.parametrize("oracle", [False, True])
def test_privileged_numbers_reach_the_critic_that_asks_for_them_and_the_actor_of_an_oracle_alone(
    build, settings, oracle
):
    algorithm, env = build("maddpg", "algo.critic.asymmetric=true", task="wall")
    if oracle:
        config = settings("task=wall", "algo=maddpg", *SMALL)
        algorithm = DDPG(config.algo, config.model, env, oracle=True)
    assert (entries.PRIVILEGED in algorithm.policy.in_keys) == oracle
    filled(algorithm, env)
    transitions = algorithm.sample()
    assert transitions[entries.PRIVILEGED].shape == transitions["next", entries.PRIVILEGED].shape == (16, 4)
    assert transitions[entries.PRIVILEGED].unique(dim=0).shape[0] > 1
    assert algorithm.loss(transitions)["loss_value"].isfinite()
