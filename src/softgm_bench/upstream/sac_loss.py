"""TorchRL's SAC loss with another way through its critics."""

from collections.abc import Sequence
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.objectives import SACLoss


class SequentialSACLoss(SACLoss):
    """``SACLoss`` that calls its critics one after another, keeping of each what the loss reads.

    TorchRL's way (``deactivate_vmap``) copies the whole transition through a general imitation of vmap and takes the
    networks apart and together again for each critic: a quarter of a gradient step of small networks. Losses and
    gradients are the same, bit by bit.
    """

    def _make_vmap(self) -> None:
        self._vmap_qnetworkN0 = self._values
        # where the network looks for each of its parameters
        self._places = []
        for name in self.qvalue_network_params.keys(True, True):
            *path, last = (name,) if isinstance(name, str) else name
            self._places.append((self.qvalue_network.get_submodule(".".join(path))._parameters, last))
        self._meta = [holder[name] for holder, name in self._places]

    def _values(self, td: TensorDictBase, parameters: TensorDictBase) -> TensorDict:
        """Compute every critic's action values ``(critics, B, N, 1)``; ``parameters`` has the critics in front too."""
        key, values = self.tensor_keys.state_action_value, []
        try:
            for of_one in zip(*(leaf.unbind(0) for leaf in parameters.values(True, True)), strict=True):
                self._compute_with(of_one)
                values.append(self.qvalue_network(td.copy()).get(key))
        finally:
            self._compute_with(self._meta)
        return TensorDict({key: torch.stack(values)}, [len(values), *td.batch_size])

    def _compute_with(self, parameters: Sequence[Any]) -> None:
        for (holder, name), parameter in zip(self._places, parameters, strict=True):
            holder[name] = parameter
