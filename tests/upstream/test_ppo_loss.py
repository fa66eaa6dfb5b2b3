import pytest
import torch
from torchrl.objectives import ClipPPOLoss

from off_policy_cases import SHORT, batches
from softgm_bench.algorithms.ppo import PPO
from softgm_bench.envs import make_env

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize(("name", "bonus"), [("softgm", 0.0), ("ippo", 0.0), ("softgm", 0.003), ("mappo", 0.05)])
def test_losses_gradients_and_reports_are_torchrls_own(settings, name, bonus):
    changes = ("recipe=tuned", f"algo.entropy_coeff={bonus}", "algo.minibatch_size=16", "algo.actor_lr=1e-2")
    config = settings("task=wall", f"algo={name}", *changes)
    torch.manual_seed(0)
    env = make_env(config.task, SHORT, num_envs=8, seed=0, horizon=7)
    algorithm = PPO(config.algo, config.model, env)
    (batch,) = batches(algorithm, env)
    algorithm.update(batch)  # ratios leave 1, some of them the bounds
    loss, frames = algorithm.loss, algorithm.prepare(batch)
    found = []
    for forward in (type(loss).forward, ClipPPOLoss.forward):
        torch.manual_seed(3)  # the entropy is estimated by a sample
        losses = forward(loss, frames.copy())
        loss.zero_grad()
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        found.append((losses, [p.grad for p in loss.parameters() if p.grad is not None]))
    (ours, gradients), (theirs, others) = found
    assert ours["clip_fraction"] > 0.0
    assert ("entropy" in set(ours.keys())) == (bonus > 0.0)
    assert all(torch.equal(value, theirs[key]) for key, value in ours.items())
    assert all(torch.equal(*pair) for pair in zip(gradients, others, strict=True))
