import pytest
import torch
from torchrl.objectives import SACLoss

from off_policy_cases import SHORT, SMALL, batches
from softgm_bench.algorithms.sac import SAC
from softgm_bench.envs import make_env

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("model", ["mlp", "softgm"])
@pytest.mark.parametrize("name", ["isac", "masac"])
def test_losses_and_gradients_are_those_of_torchrls_own_way_through_the_critics(settings, name, model):
    changes = (f"algo={name}", f"model={model}", "model.hidden=16", "task.sensing_radius=0.4", *SMALL)
    config = settings("task=wall", *changes)
    torch.manual_seed(0)
    env = make_env(config.task, SHORT, num_envs=4, seed=0, horizon=7)
    algorithm = SAC(config.algo, config.model, env)
    algorithm.update(*batches(algorithm, env))
    transitions, loss = algorithm.sample(), algorithm.loss
    found = []
    for _ in range(2):
        torch.manual_seed(3)
        losses = loss(transitions.copy())
        loss.zero_grad()
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        found.append([*losses.values(), *(p.grad for p in loss.parameters() if p.requires_grad)])
        loss.deactivate_vmap = True
        SACLoss._make_vmap(loss)
    assert all(torch.equal(ours, theirs) for ours, theirs in zip(*found, strict=True))
