import copy

import torch
from tensordict.nn import TensorDictModule
from torchrl.objectives import DDPGLoss, SoftUpdate

from softgm_bench.upstream.soft_update import FusedSoftUpdate


def test_targets_move_as_by_torchrls_own_update():
    torch.manual_seed(0)
    actor = TensorDictModule(torch.nn.Linear(3, 2), ["observation"], ["action"])
    critic = TensorDictModule(torch.nn.Bilinear(3, 2, 1), ["observation", "action"], ["state_action_value"])
    losses = [DDPGLoss(*copy.deepcopy((actor, critic)), delay_actor=True, delay_value=True) for _ in range(2)]
    updates = [kind(loss, tau=0.25) for kind, loss in zip((FusedSoftUpdate, SoftUpdate), losses, strict=True)]
    before = [target.clone() for target in targets(losses[0])]
    for _ in range(3):
        for loss, update in zip(losses, updates, strict=True):
            with torch.no_grad():
                for parameter in loss.parameters():
                    parameter.add_(1.0)
            update.step()
    for one, other, old in zip(*map(targets, losses), before, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)
        assert not torch.equal(one, old)


def targets(loss):
    groups = (loss.target_actor_network_params, loss.target_value_network_params)
    return [value for group in groups for value in group.values(True, True)]
