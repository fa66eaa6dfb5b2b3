"""PPO over arms of several numbers of sections."""

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from softgm_bench.algorithms.ppo import ADVANTAGE, PPO, VALUE_TARGET
from softgm_bench.config import compose
from softgm_bench.envs import entries, make_env
from softgm_bench.envs.section_mixture import members
from softgm_bench.rod.parameters import RodParameters

pytestmark = pytest.mark.usefixtures("one_thread")
SHORT = RodParameters(n_elements=20, substeps=5)
NO_BONUS = ("algo.entropy_coeff=0.0",)  # which is estimated by sampling
NUMBERS = {4: 4, 6: 3, 8: 1}  # environments of each number of sections


SETTINGS = ("recipe=paper", "task=structured", "algo.epochs=2", "algo.minibatch_size=16", "model.hidden=16")


def build(*overrides):
    """Learners with the same networks for each number of sections alone, and fresh batches of each."""
    config = compose([*SETTINGS, *overrides, f"task.n_agents={list(NUMBERS)}"])
    learners, batches = [], []
    for number, one in members(config).items():
        env = make_env(one.task, SHORT, num_envs=NUMBERS[number], seed=number, horizon=7)
        torch.manual_seed(0)
        learners.append(PPO(one.algo, one.model, env))
        batches.append(collect(learners[-1], env))
    return learners, batches


def collect(algorithm, env, steps=8):
    frames = env.batch_size[0] * steps
    collector = Collector(
        env,
        algorithm.policy,
        frames_per_batch=frames,
        total_frames=frames,
        exploration_type=ExplorationType.RANDOM,
        auto_register_policy_transforms=False,
    )
    (batch,) = list(collector)
    collector.shutdown()
    return batch


def gradients(algorithm, losses):
    parameters = [*algorithm._actor_parameters, *algorithm._critic_parameters]
    total = sum(value for name, value in losses.items() if name.startswith("loss_"))
    return torch.autograd.grad(total, parameters)


KINDS = pytest.mark.parametrize(
    "overrides",
    [
        ("algo=softgm",),
        ("algo=softgm", "model=mlp"),
        ("algo=ippo",),
        ("algo=softgm", "algo.actor.memory={cell:gru,size:8}"),
    ],
    ids=["softgm", "mlp", "ippo", "memory"],
)


@KINDS
def test_the_gradient_is_the_mean_of_the_groups_gradients_by_their_frames(overrides):
    learners, batches = build(*overrides, *NO_BONUS)
    groups = learners[0]._prepared(batches)
    found = gradients(learners[0], learners[0]._losses(groups))
    # each by a learner that was built for this number of sections alone
    own = [gradients(one, one.loss(frames)) for one, frames in zip(learners, groups, strict=True)]
    weights = [len(frames) / sum(map(len, groups)) for frames in groups]
    for index, gradient in enumerate(found):
        expected = sum(weight * each[index] for weight, each in zip(weights, own, strict=True))
        torch.testing.assert_close(gradient, expected, rtol=1e-4, atol=1e-7)


@KINDS
def test_a_groups_gradient_does_not_depend_on_who_computes_it_nor_on_the_others(overrides):
    """Bit by bit: by a learner of another number, alone, and beside frames of the others that say nothing."""
    learners, batches = build(*overrides, *NO_BONUS)
    groups = learners[0]._prepared(batches)
    alone = gradients(learners[1], learners[1].loss(groups[1]))
    assert all(map(torch.equal, alone, gradients(learners[0], learners[0]._losses(groups[1:2]))))

    def beside(scale):
        others = [frames.copy() if at == 1 else _silent(frames, scale) for at, frames in enumerate(groups)]
        parameters = learners[0]._actor_parameters
        return torch.autograd.grad(learners[0]._losses(others)["loss_objective"], parameters)

    assert all(map(torch.equal, beside(1.0), beside(2.0)))


def _silent(frames, scale):
    """Frames without advantage, of which nothing can be learnt, with other actions' probabilities."""
    silent = frames.clone()
    silent[ADVANTAGE] = torch.zeros_like(frames[ADVANTAGE])
    silent[entries.LOG_PROB] = frames[entries.LOG_PROB] * scale
    return silent


@pytest.mark.parametrize("name", ["softgm", "ippo"])
def test_advantages_and_targets_have_one_scale_for_all(name):
    learners, batches = build(f"algo={name}", "algo.value_norm_decay=0.5")
    raw, *_ = build(f"algo={name}", "algo.normalize_advantage=false")[0]
    groups, plain = learners[0]._prepared(batches), raw._prepared(batches)
    for number, frames in zip(NUMBERS, groups, strict=True):
        assert frames[ADVANTAGE].shape == (8 * NUMBERS[number], number, 1)
    # a team's advantage counts once a frame
    of = (lambda frames: frames[ADVANTAGE].flatten()) if name == "ippo" else (lambda frames: frames[ADVANTAGE][:, 0, 0])
    scaled, others = (torch.cat([of(frames) for frames in each]) for each in (groups, plain))
    assert scaled.mean().item() == pytest.approx(0.0, abs=1e-5)
    assert scaled.std().item() == pytest.approx(1.0, abs=1e-4)
    assert torch.corrcoef(torch.stack([scaled, others]))[0, 1].item() > 0.9
    targets = torch.cat([frames[VALUE_TARGET].flatten() for frames in groups])
    assert targets.mean().item() == pytest.approx(0.0, abs=1e-4)
    assert targets.std().item() == pytest.approx(1.0, abs=0.02)


@KINDS
def test_an_update_over_one_number_is_the_plain_one_and_over_several_moves_everything(overrides):
    (first, second, third), batches = build(*overrides, "algo.target_kl=0.01")
    torch.manual_seed(3)
    plain = first.update(batches[0])
    torch.manual_seed(3)
    assert second.update_mixture(batches[:1]) == plain
    assert all(map(torch.equal, first.policy.parameters(), second.policy.parameters()))

    before = [p.detach().clone() for p in (*third._actor_parameters, *third._critic_parameters)]
    metrics = third.update_mixture(batches)
    after = [*third._actor_parameters, *third._critic_parameters]
    assert metrics.keys() == plain.keys()
    assert all(torch.tensor(value).isfinite() for value in metrics.values())
    assert sum(not torch.equal(a, b) for a, b in zip(before, after, strict=True)) > 0.8 * len(before)
    assert third.trained_frames == 8 * sum(NUMBERS.values())


def test_what_is_told_of_an_update_is_a_mean_over_all_frames():
    (one, *_), batches = build("algo=softgm", "algo.entropy_coeff=0.0")
    told = one.update_mixture(batches)
    everything = torch.cat([batch[entries.LOG_PROB].mean(-1).flatten() for batch in batches])
    assert told["entropy"] == pytest.approx(-everything.mean().item(), rel=1e-5)
