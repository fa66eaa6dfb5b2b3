"""TorchRL's soft update of target networks, for all parameters in one call."""

import torch
from tensordict import TensorDictBase
from torchrl.objectives import SoftUpdate


class FusedSoftUpdate(SoftUpdate):
    """``SoftUpdate`` whose parameters are not updated one by one, which takes as long as their optimiser's step."""

    def _step(self, p_source: TensorDictBase, p_target: TensorDictBase) -> None:
        sources, targets = ([p.data for p in params.values(True, True)] for params in (p_source, p_target))
        torch._foreach_lerp_(targets, sources, 1.0 - self.eps)
