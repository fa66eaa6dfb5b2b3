"""An encoder after InforMARL (Nayak et al. 2023, "Scalable Multi-Agent Reinforcement Learning through Intelligent
Information Aggregation"): graph transformers over one graph of agents and entities.

Nodes are embedded with their type, then convolved L times by UniMP's attention (Shi et al. 2021), which the paper uses,
with the distance along an edge as its feature. An actor reads [o_i || g_i], an agent's own observation and its node, as
the paper's; a centralised critic with pooling ``mean`` reads the mean over agents, the paper's X_agg. What differs:

- observation: sections of an arm are the agents, neighbours on the chain hear each other (the paper: whoever is within
  the sensing radius) and a sensed obstacle bin is an entity. The target is a part of every node's features, as in the
  rest of this package, and no node of its own.
- node features are those that SoftGM reads, in the frame of the arm's base, target and tip relative to the node; the
  paper's are all relative to the agent that the graph is made for, which would need a graph for each agent. (The
  authors' code has both.) The distance that an edge carries is the paper's.
- the embedding is a node's own. The authors' code lets it sum over neighbours, one more step of messages without
  attention, in which an agent does not hear itself.
- 4 heads are concatenated to 80 channels and there are 2 convolutions; the authors' code averages 3 heads of 16
  channels and has 3. With 2 an agent hears of agents two places away, as with SoftGM, and of bins that its neighbours
  sense; with SoftGM those of agents two places away.
- heads, algorithm and recurrence are this package's: the paper trains with MAPPO and a recurrent layer.
"""

import itertools
from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional

from softgm_bench.envs.interface import Sizes
from softgm_bench.models import dot_product, graph
from softgm_bench.models.dot_product import Distances, Heard, Hearing
from softgm_bench.models.registry import Encoder, register_model


@dataclass
class InforMARLConfig:
    """Architecture. Values: ``conf/model/informarl.yaml``.

    Attributes:
        name: of the file in ``conf/model``.
        hidden: length of a node's embedding, over all heads.
        heads: attention heads; divides ``hidden``.
        layers: L, convolutions; how many places away on the chain an agent is heard.
        type_embedding: length of the learnt embedding of a node's type.
        embedding_layers: linear layers of a node's embedding, each followed by ReLU and a layer normalisation.
        velocity_scale: factor of the agents' velocity channels at the input.
        remember: every agent hears all bins that the team has discovered, not those alone that it senses.
    """

    name: str
    hidden: int
    heads: int
    layers: int
    type_embedding: int
    embedding_layers: int
    velocity_scale: float
    remember: bool

    def __post_init__(self) -> None:
        """Refuse values that give no network.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        dot_product.check_sizes(self, "layers", "type_embedding", "embedding_layers")


class GraphTransformer(nn.Module):
    """UniMP's convolution (Shi et al. 2021) with one edge feature, heads concatenated, without its gated residual.

    ``x_i' = W_r x_i + sum_j a_ij (W_v x_j + w_e d_ij)``, a_ij the softmax over what i hears of
    ``(W_q x_i)^T (W_k x_j + w_e d_ij) / sqrt(C)``; biases beside W_r, W_q, W_k and W_v.
    """

    def __init__(self, features: int, heads: int) -> None:
        """Draw the parameters, as torch draws those of linear layers."""
        super().__init__()
        self.shape = (heads, features // heads)
        self.attention = nn.Linear(features, 3 * features)  # of query, key and value
        self.root = nn.Linear(features, features)
        self.edge = nn.Parameter(torch.empty(self.shape).uniform_(-1.0, 1.0))

    def forward(self, agents: Tensor, bins: Tensor, hearing: Hearing, far: Distances) -> tuple[Tensor, Heard]:
        """Give new agents ``(T, features)`` from agents and bins ``(K, features)``, and what they heard."""
        features = agents.shape[-1]
        of_agents = self.attention(agents).unflatten(-1, (3, *self.shape))
        of_bins = functional.linear(bins, self.attention.weight[features:], self.attention.bias[features:])
        slope = (of_agents[:, 0] * self.edge).sum(-1)
        heard = dot_product.attend(of_agents, of_bins.unflatten(-1, (2, *self.shape)), hearing, far, slope)
        values = torch.addcmul(heard.values, heard.distances.unsqueeze(-1), self.edge)
        return self.root(agents) + values.flatten(-2), heard


@register_model("informarl", "informarl_remember", config=InforMARLConfig)
class InforMARLEncoder(Encoder):
    """Turns the observation into one embedding g_i per agent, its node after L convolutions."""

    def __init__(self, config: InforMARLConfig, sizes: Sizes) -> None:
        """Draw the parameters; none depends on N or M, which ``forward`` takes from the observation."""
        super().__init__(config.hidden, config.velocity_scale)
        self.config = config
        self.types = nn.Embedding(2, config.type_embedding)
        widths = [graph.CHANNELS + config.type_embedding, *[config.hidden] * config.embedding_layers]
        self.embedding = nn.ModuleList(nn.Linear(fan_in, fan_out) for fan_in, fan_out in itertools.pairwise(widths))
        self.norms = nn.ModuleList(nn.LayerNorm(config.hidden) for _ in self.embedding)
        for linear in cast(Iterable[nn.Linear], self.embedding):  # as the authors' code
            nn.init.orthogonal_(linear.weight, nn.init.calculate_gain("relu"))
            nn.init.zeros_(linear.bias)
        self.convolutions = nn.ModuleList(GraphTransformer(config.hidden, config.heads) for _ in range(config.layers))

    def forward(self, td: TensorDictBase) -> Tensor:
        """Embeddings ``(..., N, hidden)`` from the entries ``entries.OBSERVATION``."""
        return self._embed(td, None)

    def forward_with_weights(self, td: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Embeddings as ``forward``, and the attention weights of every convolution.

        Returns:
            Embeddings and ``(..., L, H, N, N + M)``, of every node (agents, then slots) for every agent. Rows sum to
            one, or to zero for an agent that hears nothing.
        """
        record: list[Tensor] = []
        embeddings = self._embed(td, record)
        weights = torch.stack(record, dim=1)
        return embeddings, weights.reshape(*embeddings.shape[:-2], *weights.shape[1:])

    def _embed(self, td: TensorDictBase, record: list[Tensor] | None) -> Tensor:
        channels = graph.agent_channels(td, self.velocity_scale)
        packed = channels.flatten(0, -2)
        hearing = dot_product.listen(td, reach=1, itself=False, discovered=self.config.remember)
        far = dot_product.distances(hearing, packed[:, :3])
        agents, bins = self._enter(packed, graph.AGENT), self._enter(hearing.bins, graph.OBSTACLE)
        for depth, layer in enumerate(cast(Iterable[GraphTransformer], self.convolutions), start=1):
            new, heard = layer(agents, bins, hearing, far)
            agents = functional.relu(new)
            if depth < len(self.convolutions):  # nobody reads what the last one makes of bins, which hear nobody
                bins = functional.relu(layer.root(bins))
            if record is not None:
                record.append(dot_product.weights(heard, hearing))
        return agents.unflatten(0, channels.shape[:-1])

    def _enter(self, channels: Tensor, node_type: int) -> Tensor:
        """Embed nodes of one type, ``(K, 15)`` to ``(K, hidden)``."""
        first, *rest = cast(Iterable[nn.Linear], self.embedding)
        own, of_type = first.weight.split([graph.CHANNELS, self.types.embedding_dim], dim=1)
        nodes = functional.linear(channels, own, first.bias + of_type @ self.types.weight[node_type])
        norm, *norms = self.norms
        nodes = norm(functional.relu(nodes))
        for linear, norm in zip(rest, norms, strict=True):
            nodes = norm(functional.relu(linear(nodes)))
        return nodes
