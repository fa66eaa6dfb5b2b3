import dataclasses
import math

import pytest
import torch
from bandit import ENV, LEARNS_FAST, error_after_learning
from test_ddpg import actions, observe
from torchrl.envs.utils import ExplorationType

from off_policy_cases import SHORT, SMALL, batches, filled, says, three_ends
from pairwise import partly
from softgm_bench.algorithms.sac import SAC
from softgm_bench.envs import entries, make_env
from softgm_bench.models.heads import LOC
from softgm_bench.models.mlp import MLPConfig

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def build(settings):
    def algorithm(name="isac", *overrides, task="basic"):
        config = settings(f"task={task}", f"algo={name}", *SMALL, *overrides)
        torch.manual_seed(0)
        env = make_env(config.task, SHORT, num_envs=4, seed=0, horizon=7)
        return SAC(config.algo, config.model, env), env

    return algorithm


def two_critics_say(parameters, first, second):
    """Stacked critics: all zero but the last biases."""
    leaves = [parameter.data for parameter in parameters]
    says(leaves, 0.0)
    leaves[-1].copy_(torch.tensor([[first], [second]]))


@pytest.mark.parametrize("name", ["isac", "masac"])
def test_targets_bootstrap_at_a_truncation_and_not_at_a_termination(build, name):
    """The smaller target critic says 2, the critics 0 and 1, discount 0.5, no entropy, by hand: 1 + 1, 3 + 1, 5."""
    algorithm = filled(*build(name, "algo.gamma=0.5", "algo.initial_alpha=1e-30"))
    two_critics_say(algorithm.loss.qvalue_network_params.parameters(), 0.0, 1.0)
    two_critics_say(algorithm.loss.target_qvalue_network_params.values(True, True), 7.0, 2.0)
    losses = algorithm.loss(three_ends(algorithm))
    squares = (4 + 16 + 25) + (1 + 9 + 16)
    assert losses["loss_qvalue"].item() == pytest.approx(squares / 3)
    assert losses["loss_actor"].item() == pytest.approx(0.0)  # minus the smaller critic


def test_each_agents_target_holds_its_own_entropy(build):
    """2 is the next state's Q, alpha 0.5, discount 0.5: r + 0.5 (2 - 0.5 log pi_i)."""
    algorithm = filled(*build("masac", "algo.gamma=0.5", "algo.initial_alpha=0.5"))
    two_critics_say(algorithm.loss.target_qvalue_network_params.values(True, True), 2.0, 2.0)
    transitions = three_ends(algorithm)
    torch.manual_seed(1)
    target = algorithm.loss._compute_target_v2(transitions)
    torch.manual_seed(1)
    _, log_prob = algorithm.policy.actor.get_dist(transitions["next"].copy()).rsample_and_log_prob()
    expected = torch.tensor([1.0, 3.0])[:, None] + 0.5 * (2.0 - 0.5 * log_prob[:2])
    torch.testing.assert_close(target[:2], expected)
    assert (target[2] == 5.0).all()
    assert log_prob.shape == (3, 6)
    assert log_prob[0].unique().numel() == 6


@pytest.mark.parametrize("task", ["basic", "wall"])
def test_the_target_entropy_is_minus_two_for_each_agent(build, task):
    algorithm, _ = build("isac", task=task)
    assert algorithm.loss.target_entropy.item() == -2.0
    assert build("isac", "algo.target_entropy=-1.5")[0].loss.target_entropy.item() == -1.5


def test_the_temperature_rises_below_the_target_entropy_and_falls_above(build):
    """With log alpha = 1 its loss is the entropy minus the target, -2."""
    for target, sign in ((5.0, 1), (-20.0, -1)):
        algorithm, env = build("isac", f"algo.initial_alpha={math.e}", f"algo.target_entropy={target}")
        losses = filled(algorithm, env).loss(algorithm.sample())
        assert losses["loss_alpha"].item() == pytest.approx(losses["entropy"].item() - target, rel=1e-4)
        before = algorithm.loss.log_alpha.item()
        algorithm._step(algorithm.sample())
        assert (algorithm.loss.log_alpha.item() - before) * sign > 0


def test_the_actors_loss_scores_the_exact_sample_where_the_tanh_rounds(build):
    """With means at the bound and a wide sigma most actions round to 1; entropy and gradients stay right."""
    algorithm = filled(*build("isac", "algo.actor.initial_sigma=1.9", "algo.actor.mean_bound=8"))
    with torch.no_grad():
        algorithm.policy.actor.module[0].head.function[-1].bias[:2].fill_(50.0)
    transitions = algorithm.sample()
    dist = algorithm.policy.actor.get_dist(transitions.copy())
    torch.manual_seed(2)
    assert (dist.rsample() > 1.0 - 2e-6).float().mean() > 0.5
    losses = algorithm.loss(transitions)
    # log pi = log N(z) - log(1 - tanh(z)^2), the latter near log 4 - 2 z; E[z] = 8, sigma 1.9, two components
    entropy = 2 * (0.5 * math.log(2 * math.pi * math.e * 1.9**2) + math.log(4.0) - 16.0)
    assert losses["entropy"].item() == pytest.approx(entropy, rel=0.05)
    losses["loss_actor"].backward()
    gradients = [parameter.grad for parameter in algorithm.policy.parameters() if parameter.grad is not None]
    assert gradients
    assert all(gradient.isfinite().all() for gradient in gradients)


def test_the_two_critics_begin_apart_and_their_targets_with_them(build):
    algorithm, _ = build("masac", "algo.tau=0.25")
    sources = list(algorithm.loss.qvalue_network_params.parameters())
    targets = list(algorithm.loss.target_qvalue_network_params.values(True, True))
    assert all(source.shape[0] == 2 for source in sources)
    assert all(torch.equal(*pair) for pair in zip(sources, targets, strict=True))
    weights = [source for source in sources if source.ndim == 3]
    assert all(not torch.equal(weight[0], weight[1]) for weight in weights)
    # orthogonal, as their initialisation says
    last_but_one = weights[-2][0]
    gram = last_but_one @ last_but_one.T
    torch.testing.assert_close(gram, 2.0 * torch.eye(len(gram)), atol=1e-4, rtol=0.0)
    says(sources, 4.0)
    says(targets, 0.0)
    algorithm.target_update.step()
    assert (targets[-1] == 1.0).all()


def test_it_is_deterministic_when_told_so_and_samples_while_exploring(build):
    algorithm, env = build()
    td, policy = observe(env), algorithm.policy
    loc = policy.actor(td.clone())[LOC]
    torch.testing.assert_close(actions(policy, td, ExplorationType.DETERMINISTIC)[0], (3 * (loc / 3).tanh()).tanh())
    sampled = actions(policy, td, ExplorationType.RANDOM, 2)
    assert not torch.equal(sampled[0], sampled[1])
    policy.uniform = True
    assert actions(policy, td, ExplorationType.RANDOM, 200).std().item() == pytest.approx(3**-0.5, rel=0.05)
    assert actions(policy, td, ExplorationType.DETERMINISTIC).abs().max() < 0.1


def test_the_policy_writes_the_action_alone(build):
    algorithm, env = build()
    td = observe(env)
    before = set(td.keys(True, True))
    assert set(algorithm.policy(td).keys(True, True)) == before | {entries.ACTION}


@pytest.mark.parametrize("model", ["mlp", "softgm"])
@pytest.mark.parametrize("name", ["isac", "masac"])
def test_an_update_moves_actor_critics_targets_and_temperature_on_every_model(build, name, model):
    algorithm, env = build(name, f"model={model}", "model.hidden=16", "task.sensing_radius=0.4", task="wall")
    loss = algorithm.loss
    (batch,) = batches(algorithm, env)
    assert batch[entries.EDGE].any()
    groups = [loss.actor_network_params, loss.qvalue_network_params, loss.target_qvalue_network_params]
    before = [group.clone() for group in groups]
    alpha = loss.log_alpha.item()
    metrics = algorithm.update(batch)
    for old, new in zip(before, groups, strict=True):
        moved = [not torch.equal(old[key], new[key]) for key in new.keys(True, True)]
        assert sum(moved) > 0.9 * len(moved)
    assert loss.log_alpha.item() != alpha
    assert set(metrics) == {
        *("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", "q_mean"),
        *("actor_grad_norm", "critic_grad_norm", "alpha_grad_norm", "gradient_steps", "replay_size"),
        *("actor_saturation", "actor_preactivation"),
    }
    assert all(torch.tensor(value).isfinite() for value in metrics.values())
    assert {p.data_ptr() for p in algorithm.policy.parameters()} == {
        p.data_ptr() for p in loss.actor_network_params.parameters()
    }


@pytest.mark.parametrize("name", partly(["isac", "masac"], ["isac"]))
def test_it_learns_what_each_agent_should_do(settings, name):
    config = dataclasses.replace(settings(f"algo={name}").algo, **LEARNS_FAST, alpha_lr=3e-3, initial_alpha=0.05)
    torch.manual_seed(0)
    algorithm = SAC(config, MLPConfig(hidden=32, layers=2, velocity_scale=1.0), ENV)
    assert error_after_learning(algorithm, 32 + 40) < 0.02
