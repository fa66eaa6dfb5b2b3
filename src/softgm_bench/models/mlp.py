"""MLPs over the flat view, the baselines' encoders: one for each agent, with SoftGM's interface, and a team's."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import graph
from softgm_bench.models.activation import tanh
from softgm_bench.models.registry import Encoder, TeamEncoder, register_model


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
        of_agents = sizes.n_agents * (graph.CHANNELS + sizes.n_slots)
        in_features = of_agents + sizes.n_slots * graph.CHANNELS + n_further
        self.layers = nn.ModuleList(orthogonal_layers([in_features, *[config.hidden] * config.layers]))

    def forward(self, td: TensorDictBase, further: Tensor) -> Tensor:
        """Embeddings ``(..., hidden)`` of own nodes, edges, slots and ``further``, in this order."""
        own = graph.agent_channels(td, self.velocity_scale)
        edge, slots = td[entries.EDGE].to(own.dtype), graph.slot_channels(td)
        hidden = torch.cat([own.flatten(-2), edge.flatten(-2), slots.flatten(-2), further], dim=-1)
        for layer in self.layers:
            hidden = tanh(layer(hidden))
        return hidden


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
        edge = td[entries.EDGE]
        n_slots = edge.shape[-1]
        own = graph.agent_channels(td, self.velocity_scale)
        own_weight, slot_weight, edge_weight = self.first.weight.split(
            [graph.CHANNELS, n_slots * graph.CHANNELS, n_slots], dim=1
        )
        shared = functional.linear(graph.slot_channels(td).flatten(-2), slot_weight, self.first.bias)
        # One product for the agent's own two parts.
        private = torch.cat([own, edge.to(own.dtype)], dim=-1)
        hidden = functional.linear(private, torch.cat([own_weight, edge_weight], dim=1)) + shared.unsqueeze(-2)
        hidden = tanh(hidden)
        for layer in self.rest:
            hidden = tanh(layer(hidden))
        return hidden


def orthogonal_layers(sizes: Sequence[int]) -> list[nn.Linear]:
    """Hidden layers, each to be followed by tanh: orthogonal weights (gain sqrt 2), zero biases."""
    layers = [nn.Linear(fan_in, fan_out) for fan_in, fan_out in itertools.pairwise(sizes)]
    for layer in layers:
        nn.init.orthogonal_(layer.weight, math.sqrt(2))
        nn.init.zeros_(layer.bias)
    return layers
