"""A per-agent MLP over the flat view: the baselines' encoder, with the same interface as SoftGM's."""

import math
from dataclasses import dataclass

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional

from softgm_bench.envs import keys
from softgm_bench.models import graph
from softgm_bench.models.registry import Encoder, register_model


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


@register_model("mlp", MLPConfig)
class MLPEncoder(Encoder):
    """Parameters shared by all agents; reads ``graph.flat_observation`` without ever forming it.

    The slots' part of an agent's flat observation is the same for all agents of an environment, so the first layer
    multiplies it once per environment and adds the result to every agent's.
    """

    def __init__(self, config: MLPConfig, n_agents: int, n_slots: int) -> None:
        """Draw the parameters for M = ``n_slots``; none depends on N."""
        super().__init__(config.hidden, config.velocity_scale)
        self.first = nn.Linear(graph.flat_features(n_slots), config.hidden)
        self.rest = nn.ModuleList(nn.Linear(config.hidden, config.hidden) for _ in range(config.layers - 1))
        for layer in (self.first, *self.rest):
            nn.init.orthogonal_(layer.weight, math.sqrt(2))
            nn.init.zeros_(layer.bias)

    def forward(self, td: TensorDictBase) -> Tensor:
        """Embeddings ``(..., N, hidden)`` from the entries ``keys.OBSERVATION``."""
        edge = td[keys.EDGE]
        n_slots = edge.shape[-1]
        own = graph.agent_channels(td, self.velocity_scale)
        own_weight, slot_weight, edge_weight = self.first.weight.split(
            [graph.CHANNELS, n_slots * graph.CHANNELS, n_slots], dim=1
        )
        shared = functional.linear(graph.slot_channels(td).flatten(-2), slot_weight, self.first.bias)
        # One product for the agent's own two parts.
        private = torch.cat([own, edge.to(own.dtype)], dim=-1)
        hidden = functional.linear(private, torch.cat([own_weight, edge_weight], dim=1)) + shared.unsqueeze(-2)
        hidden = hidden.tanh()
        for layer in self.rest:
            hidden = layer(hidden).tanh()
        return hidden
