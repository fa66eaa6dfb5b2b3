"""A memory for each agent: a gated recurrent unit (Cho et al. 2014) between an actor's inputs and its head.

Parameters are shared by all agents, as the rest of the actor is; the hidden state is an agent's own and is computed
from its own inputs alone, so execution stays decentralised.
"""

from dataclasses import dataclass
from typing import ClassVar

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from softgm_bench.envs import entries
from softgm_bench.models.activation import tanh

CELLS = ("gru",)


@dataclass
class MemoryConfig:
    """An actor's memory. Values: ``conf/algo``.

    Attributes:
        cell: the kind of recurrent cell, one of ``CELLS``.
        size: length of an agent's hidden state.
    """

    cell: str
    size: int

    def __post_init__(self) -> None:
        """Refuse values that give no memory.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        if self.cell not in CELLS:
            raise ValueError(f"algo.actor.memory.cell is {self.cell}: choose one of {', '.join(CELLS)}")
        if self.size < 1:
            raise ValueError(f"algo.actor.memory.size is {self.size}: it must be at least 1")


class Memory(nn.Module):
    """torch's GRU with the state put to zero where an episode begins.

    Attributes:
        size: H, length of an agent's hidden state.
    """

    in_keys: ClassVar[list[NestedKey]] = [entries.MEMORY, entries.IS_INIT]
    out_keys: ClassVar[list[NestedKey]] = [entries.NEXT_MEMORY]

    def __init__(self, config: MemoryConfig, in_features: int) -> None:
        """Draw the parameters: orthogonal for every gate, zero biases."""
        super().__init__()
        self.size = config.size
        self.input = nn.Linear(in_features, 3 * config.size)  # of reset gate, update gate and candidate
        self.recurrent = nn.Linear(config.size, 3 * config.size)
        for layer in (self.input, self.recurrent):
            for gate in layer.weight.detach().chunk(3):
                nn.init.orthogonal_(gate)
            nn.init.zeros_(layer.bias)

    def forward(self, td: TensorDictBase, inputs: Tensor) -> Tensor:
        """Hidden states after these frames, ``(..., N, H)``.

        A tensordict ``(B,)`` or ``()`` is one step: its state is read from ``entries.MEMORY`` (zeros, which are
        written there, if it is absent), the new one is written under ``next``. A tensordict ``(B, T)`` is T consecutive
        steps: the state before the first is read, and nothing is written.

        Args:
            td: ``entries.IS_INIT`` says where episodes begin.
            inputs: ``(..., N, in_features)``.

        Raises:
            ValueError: more than two batch dimensions.
        """
        if inputs.ndim > 4:
            raise ValueError(
                f"inputs have shape {tuple(inputs.shape)}: an actor with memory reads (B,) or (B, T) frames"
            )
        begins = td.get(entries.IS_INIT).unsqueeze(-1)  # (..., 1, 1)
        state = td.get(entries.MEMORY, None)
        if state is None:
            state = inputs.new_zeros(*inputs.shape[:-1], self.size)
            td.set(entries.MEMORY, state)
        gates = self.input(inputs)
        if inputs.ndim == 4:
            return self._over_time(gates, state[:, 0], begins)
        after = self._step(gates, state.masked_fill(begins, 0.0))
        td.set(entries.NEXT_MEMORY, after)
        return after

    def _over_time(self, gates: Tensor, state: Tensor, begins: Tensor) -> Tensor:
        """States ``(B, T, N, H)`` of the inputs' gates ``(B, T, N, 3 H)`` from the state ``(B, N, H)`` before them."""
        states = []
        for of_step, begin in zip(gates.unbind(1), begins.unbind(1), strict=True):
            state = self._step(of_step, state.masked_fill(begin, 0.0))
            states.append(state)
        return torch.stack(states, dim=1)

    def _step(self, gates: Tensor, state: Tensor) -> Tensor:
        own = self.recurrent(state)
        size = self.size
        reset, update = torch.sigmoid(gates[..., : 2 * size] + own[..., : 2 * size]).chunk(2, dim=-1)
        candidate = tanh(torch.addcmul(gates[..., 2 * size :], reset, own[..., 2 * size :]))
        return torch.lerp(candidate, state, update)
