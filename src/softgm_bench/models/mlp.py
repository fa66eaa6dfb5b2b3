"""MLPs over the flat view, the baselines' encoders: one for each agent, with SoftGM's interface, and a team's."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import graph
from softgm_bench.models.activation import tanh
from softgm_bench.models.registry import Encoder, TeamEncoder, register_model
from softgm_bench.rod import sync
from softgm_bench.upstream import functorch


@dataclass
class MLPConfig:
    """Architecture of the MLP. Values: ``conf/model/mlp.yaml``.

    Attributes:
        hidden: width of every layer and of the embedding.
        layers: number of hidden layers, each followed by tanh.
        velocity_scale: factor of the agents' velocity channels at the input.
    """

    hidden: int
    layers: int
    velocity_scale: float

    def __post_init__(self) -> None:
        """Refuse values that give no network.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        for name, lowest in (("hidden", 1), ("layers", 0)):
            if getattr(self, name) < lowest:
                raise ValueError(f"model.{name} is {getattr(self, name)}: it must be at least {lowest}")


class MLPTeamEncoder(TeamEncoder):
    """One MLP that reads all agents' flat observations and further inputs, as BenchMARL's centralised critics do.

    What the agents' flat observations share, the slots, is read once. It costs a critic N times less than N embeddings.
    """

    def __init__(self, config: MLPConfig, sizes: Sizes, n_further: int) -> None:
        """Draw the parameters for N agents, M slots and ``n_further`` inputs besides."""
        super().__init__(config.hidden)
        self.velocity_scale = config.velocity_scale
        n_agents, n_slots = sizes.n_agents, sizes.n_slots
        self.parts = [n_agents * graph.CHANNELS, n_agents * n_slots, n_slots * graph.CHANNELS, n_further]
        self.layers = nn.ModuleList(orthogonal_layers([sum(self.parts), *[config.hidden] * config.layers]))

    def forward(self, td: TensorDictBase, further: Tensor) -> Tensor:
        """Embeddings ``(..., hidden)`` of own nodes, edges, slots and ``further``, in this order."""
        own = graph.agent_channels(td, self.velocity_scale)
        td = _without_zeros(td)
        edge, slots = td[entries.EDGE].to(own.dtype), graph.slot_channels(td)
        inputs = torch.cat([own.flatten(-2), edge.flatten(-2), slots.flatten(-2), further], dim=-1)
        first, *rest = cast("list[nn.Linear]", list(self.layers))
        hidden = tanh(functional.linear(inputs, self._read(first.weight, *edge.shape[-2:]), first.bias))
        for layer in rest:
            hidden = tanh(layer(hidden))
        return hidden

    def _read(self, weight: Tensor, n_agents: int, n_slots: int) -> Tensor:
        """The first layer's columns that the first ``n_slots`` slots are read with, and all others."""
        own, edge, slots, further = weight.split(self.parts, dim=1)
        edge = edge.unflatten(1, (n_agents, -1))[..., :n_slots].flatten(1)
        return torch.cat([own, edge, slots[:, : n_slots * graph.CHANNELS], further], dim=1)


@register_model("mlp", config=MLPConfig, team=MLPTeamEncoder)
class MLPEncoder(Encoder):
    """Parameters shared by all agents; reads ``graph.flat_observation`` without ever forming it.

    The slots' part of an agent's flat observation is the same for all agents of an environment, so the first layer
    multiplies it once per environment and adds the result to every agent's.
    """

    def __init__(self, config: MLPConfig, sizes: Sizes) -> None:
        """Draw the parameters for M slots; none depends on N."""
        super().__init__(config.hidden, config.velocity_scale)
        widths = [graph.flat_features(sizes.n_slots), *[config.hidden] * config.layers]
        self.first, *rest = orthogonal_layers(widths)
        self.rest = nn.ModuleList(rest)

    def forward(self, td: TensorDictBase) -> Tensor:
        """Embeddings ``(..., N, hidden)`` from the entries ``entries.OBSERVATION``."""
        n_slots = td[entries.EDGE].shape[-1]
        own = graph.agent_channels(td, self.velocity_scale)
        own_weight, slot_weight, edge_weight = self.first.weight.split(
            [graph.CHANNELS, n_slots * graph.CHANNELS, n_slots], dim=1
        )
        td = _without_zeros(td)
        edge, slots = td[entries.EDGE].to(own.dtype), graph.slot_channels(td).flatten(-2)
        shared = functional.linear(slots, slot_weight[:, : slots.shape[-1]], self.first.bias)
        # One product for the agent's own two parts.
        own_weight = torch.cat([own_weight, edge_weight[:, : edge.shape[-1]]], dim=1)
        hidden = functional.linear(torch.cat([own, edge], dim=-1), own_weight) + shared.unsqueeze(-2)
        hidden = tanh(hidden)
        for layer in self.rest:
            hidden = tanh(layer(hidden))
        return hidden


def _without_zeros(td: TensorDictBase) -> TensorDictBase:
    """The observation without slots that are empty in the whole batch, where that may be asked: often most of them."""
    free = sync.is_free(td[entries.EDGE].device) and not functorch.transforms_active()
    return graph.without_empty_slots(td) if free else td


def orthogonal_layers(sizes: Sequence[int]) -> list[nn.Linear]:
    """Hidden layers, each to be followed by tanh: orthogonal weights (gain sqrt 2), zero biases."""
    layers = [nn.Linear(fan_in, fan_out) for fan_in, fan_out in itertools.pairwise(sizes)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, math.sqrt(2))
        nn.init.zeros_(layer.bias)
    return layers
