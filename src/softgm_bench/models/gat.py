"""Multi-head graph attention (paper, section "Attention-based Message Passing"; Velickovic et al. 2018).

One set of parameters, five forms of the same layer:

- ``forward``: dense and masked, for any adjacency; the plain reference;
- ``edges_to_agent``: an edge list from obstacle nodes to agents, plus the agents' self-loops (stage 1);
- ``slots_to_agent``: the same from all slots, masked: shapes do not depend on the edges, and no value is looked at;
- ``chain``: neighbours on a chain plus self-loops (stage 2);
- ``chain_masked``: the same as dense attention, in fewer and larger operations.

The GAT score ``a^T [u_i || u_j]`` is split into ``a_target^T u_i + a_source^T u_j``, so no pairwise feature tensor
exists. Segment operations are ``index_add`` and ``scatter_reduce("amax")``: deterministic on CPU.
"""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional

from softgm_bench.models.chain_kernel import ChainAttention
from softgm_bench.models.edge_kernel import EdgeAttention
from softgm_bench.models.graph import Sensed
from softgm_bench.upstream import functorch

Affine = tuple[Tensor, Tensor | None]  # weight and offset of a linear map
NEGATIVE_SLOPE = 0.2  # of LeakyReLU, as in Velickovic et al. 2018; the paper gives none


class Projection(NamedTuple):
    """The projections of nodes that attention needs; C = out_features / heads channels a head.

    Attributes:
        message: u, ``(..., H, C)``.
        source: the node's part of a score as a source: ``(..., H)``, for GATv2 ``(..., H, C)``.
        target: the same as a target.
        values: all of it side by side, as it was computed, ``(..., out + 2 H)``; for GATv2 ``(..., 2 out)``.
    """

    message: Tensor
    source: Tensor
    target: Tensor
    values: Tensor


class GraphAttention(nn.Module):
    """Heads concatenated, then a bias (the paper's formula has none; the reference GAT does)."""

    def __init__(self, in_features: int, out_features: int, heads: int, gatv2: bool) -> None:
        """Draw the parameters.

        Args:
            in_features: of a node.
            out_features: of a node, over all heads.
            heads: number of heads; divides ``out_features``.
            gatv2: scores ``a^T LeakyReLU(W_target h_i + W h_j)`` (Brody et al. 2022, eq. 7) instead of the paper's.

        Raises:
            ValueError: if ``heads`` does not divide ``out_features``.
        """
        super().__init__()
        if out_features % heads:
            raise ValueError(f"out_features={out_features} is not a multiple of heads={heads}")
        self.heads, self.channels, self.gatv2 = heads, out_features // heads, gatv2
        self.weight = nn.Parameter(torch.empty(out_features, in_features))
        self.source = nn.Parameter(torch.empty(heads, self.channels))
        # GATv2 has one attention vector after the nonlinearity, and a second transform for targets before it.
        self.target = nn.Parameter(torch.empty((out_features, in_features) if gatv2 else (heads, self.channels)))
        self.bias = nn.Parameter(torch.zeros(out_features))
        for parameter in (self.weight, self.source, self.target):
            nn.init.xavier_uniform_(parameter)

    def forward(self, nodes: Tensor, adjacency: Tensor) -> tuple[Tensor, Tensor]:
        """Dense reference.

        Args:
            nodes: ``(..., V, in_features)``.
            adjacency: bool, incoming, with self-loops, broadcasts to ``(..., V, V)``: row = target.

        Returns:
            New nodes ``(..., V, out_features)`` and attention weights ``(..., H, V, V)``.
        """
        message = (nodes @ self.weight.mT).unflatten(-1, (self.heads, self.channels))
        if self.gatv2:
            target = (nodes @ self.target.mT).unflatten(-1, (self.heads, self.channels))
            scores = self._score(target.unsqueeze(-3) + message.unsqueeze(-4))
        else:
            target, source = (message * self.target).sum(-1), (message * self.source).sum(-1)
            scores = self._score(target.unsqueeze(-2) + source.unsqueeze(-3))
        scores = scores.masked_fill(~adjacency.unsqueeze(-1), -math.inf)
        attention = scores.softmax(dim=-2).movedim(-1, -3)
        return self.output(torch.einsum("...hij,...jhc->...ihc", attention, message)), attention

    def joint_weight(self) -> Tensor:
        """Everything that is linear in a node, as one matrix with rows (message, source score, target score).

        Returns:
            GAT: ``(out + 2 H, in)``; GATv2: ``(2 out, in)``, because the source's part is the message itself.
        """
        if self.gatv2:
            return torch.cat([self.weight, self.target])
        vectors = torch.stack([self.source, self.target]).unsqueeze(-2)
        scores = vectors @ self.weight.unflatten(0, (self.heads, self.channels))
        return torch.cat([self.weight, scores.flatten(0, -2)])

    def project(self, nodes: Tensor, weight: Tensor, offset: Tensor | None = None) -> Projection:
        """Apply ``joint_weight()``, or a product of it with an earlier linear map, to nodes ``(..., in)``."""
        values = functional.linear(nodes, weight, offset)
        out = self.heads * self.channels
        message = values[..., :out].unflatten(-1, (self.heads, self.channels))
        if self.gatv2:
            return Projection(message, message, values[..., out:].unflatten(-1, message.shape[-2:]), values)
        source, target = values[..., out:].chunk(2, dim=-1)
        return Projection(message, source, target, values)

    def edges_to_agent(
        self, agents: Projection, nodes: Tensor, affine: Affine, edges: Sensed, n_agents: int
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Stage 1 over an edge list: each agent hears itself and the obstacle nodes with an edge to it.

        Args:
            agents: projections of T packed agents, T a multiple of N.
            nodes: K packed obstacle nodes, ``(K, in)``.
            affine: ``weight``, or a product of it with an earlier linear map: ``(out, in)``, and an offset.
            edges: E edges between them.
            n_agents: N.

        Returns:
            New agents ``(T, out_features)`` and the weights of self-loops ``(T, H)`` and of edges ``(E, H)``.
        """
        if not len(edges.source):  # every agent hears only itself
            own = agents.message.new_ones(len(agents.message), self.heads)
            return self.output(agents.message), own, own[:0]
        if self._compiles(agents.message):
            scores = (*self._source_rows(affine), agents.target, agents.target + agents.source)
            own, mixed, incoming = EdgeAttention.apply(
                nodes, *scores, edges.first, edges.source, n_agents, NEGATIVE_SLOPE
            )
            return self._mixed_message(agents, mixed, own.unsqueeze(-1), affine), own, incoming
        message = functional.linear(nodes, *affine).unflatten(-1, (self.heads, self.channels))
        message = message.index_select(0, edges.source)
        source = message if self.gatv2 else (message * self.source).sum(-1)
        own = self._score(agents.target + agents.source)
        incoming = self._score(agents.target.index_select(0, edges.target) + source)
        own, incoming = edge_softmax(own, incoming, edges.target)
        aggregated = own.unsqueeze(-1) * agents.message
        aggregated = aggregated.index_add(0, edges.target, incoming.unsqueeze(-1) * message)
        return self.output(aggregated), own, incoming

    def project_agents(self, agents: Tensor, pending: Affine | None) -> Projection:
        """What ``project`` gives of nodes that receive, ``(T, in)``, after a linear map that is still to be applied.

        Scores are taken from the messages: on a GPU that is less than to make one matrix of weights at every step.
        """
        if self.gatv2:
            return self.project(agents, *after(self.joint_weight(), pending))
        message = functional.linear(agents, *after(self.weight, pending)).unflatten(-1, (self.heads, self.channels))
        vectors = torch.stack([self.source, self.target], dim=-1)
        source, target = torch.bmm(message.transpose(0, 1), vectors).permute(2, 1, 0)
        return Projection(message, source, target, message)

    def slots_to_agent(
        self, agents: Projection, slots: Tensor, affine: Affine, absent: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Stage 1 over all slots: each agent hears itself and the slots that it senses.

        The slots' messages are formed for GATv2's scores alone, as ``edge_kernel`` explains.

        Args:
            agents: projections of ``B N`` packed agents.
            slots: nodes ``(B, M, in)``; finite where no agent senses them, too.
            affine: ``weight``, or a product of it with an earlier linear map: ``(out, in)``, and an offset.
            absent: what is added to scores, ``(B, N, 1, M)``: 0 where the agent senses the slot, else -inf.

        Returns:
            New agents ``(B N, out_features)``, weights of self-loops ``(B N, H)`` and of slots ``(B, N, H, M)``.
        """
        shape = absent.shape[:2]
        target, own = agents.target.unflatten(0, shape), agents.source.unflatten(0, shape)
        if self.gatv2:
            message = functional.linear(slots, *affine).unflatten(-1, (self.heads, self.channels))
            pairs = torch.cat([(target + own).unsqueeze(2), target.unsqueeze(2) + message.unsqueeze(1)], dim=2)
            scores = self._score(pairs).transpose(-1, -2) + functional.pad(absent, (1, 0))
        else:
            source = functional.linear(slots, *self._source_rows(affine)).mT.unsqueeze(1) + absent
            scores = self._score(torch.cat([own.unsqueeze(-1), source], -1) + target.unsqueeze(-1))
        own_weight, weights = scores.softmax(-1).split([1, slots.shape[1]], -1)
        mixed = torch.bmm(weights.flatten(1, 2), slots).view(-1, self.heads, slots.shape[-1]).transpose(0, 1)
        own_weight = own_weight.flatten(0, 1)
        return self._mixed_message(agents, mixed, own_weight, affine), own_weight.squeeze(-1), weights

    def _source_rows(self, affine: Affine) -> Affine:
        """The scores of nodes as sources, ``(H, in)`` and ``(H,)``, for the map that gives their messages."""
        rows, offset = affine[0].unflatten(0, (self.heads, self.channels)), affine[1]
        part = None if offset is None else (self.source * offset.unflatten(0, self.source.shape)).sum(-1)
        return torch.bmm(self.source.unsqueeze(1), rows).squeeze(1), part

    def _mixed_message(self, agents: Projection, mixed: Tensor, own_weight: Tensor, affine: Affine) -> Tensor:
        """New agents ``(T, out_features)`` from weighted sums of nodes ``(H, T, in)`` and own weights ``(T, H, 1)``."""
        weight, offset = affine
        heads = weight.unflatten(0, (self.heads, self.channels))
        incoming = torch.bmm(mixed, heads.mT).transpose(0, 1)  # (T, H, C)
        if offset is not None:  # as often as the weights say, which with the own one sum to 1
            incoming = torch.addcmul(incoming, 1.0 - own_weight, offset.unflatten(0, self.source.shape))
        return self.output(torch.addcmul(incoming, own_weight, agents.message))

    def chain(self, agents: Projection, n_agents: int) -> tuple[Tensor, Tensor]:
        """Stage 2: each agent hears itself and its neighbours on the chain.

        Args:
            agents: projections of T packed agents, T a multiple of N.
            n_agents: N.

        Returns:
            New agents ``(T, out_features)`` and the weights ``(3, T / N, N, H)`` of the previous agent, the agent
            itself and the next one; zero where there is none.
        """
        if self._compiles(agents.values):
            out, weights = ChainAttention.apply(agents.values, n_agents, self.heads, NEGATIVE_SLOPE)
            return out + self.bias, weights.unflatten(1, (-1, n_agents))
        message, source, target = (part.unflatten(0, (-1, n_agents)) for part in agents[:3])
        absent = message.new_full((1,), -math.inf).expand(message.shape[0], 1, self.heads)
        previous = torch.cat([absent, self._score(target[:, 1:] + source[:, :-1])], dim=1)
        following = torch.cat([self._score(target[:, :-1] + source[:, 1:]), absent], dim=1)
        weights = torch.stack([previous, self._score(target + source), following]).softmax(dim=0)
        before, own, after = weights.unsqueeze(-1)
        aggregated = own * message
        aggregated[:, 1:].add_(before[:, 1:] * message[:, :-1])  # addcmul_ has no batching rule under vmap
        aggregated[:, :-1].add_(after[:, :-1] * message[:, 1:])
        return self.output(aggregated).flatten(0, 1), weights

    def chain_masked(self, agents: Projection, absent: Tensor) -> tuple[Tensor, Tensor]:
        """Stage 2 over all pairs of agents.

        Args:
            agents: projections of T packed agents, T a multiple of N.
            absent: what is added to scores, ``(N, 1, N)``, target first: 0 between neighbours and on the diagonal, else
                -inf.

        Returns:
            New agents ``(T, out_features)`` and the weights ``(T / N, N, H, N)``.
        """
        n_agents = len(absent)
        message, source, target = (part.unflatten(0, (-1, n_agents)) for part in agents[:3])
        if self.gatv2:
            scores = self._score(target.unsqueeze(2) + source.unsqueeze(1)).transpose(-1, -2)
        else:
            scores = self._score(target.unsqueeze(-1) + source.mT.unsqueeze(1))
        weights = (scores + absent).softmax(-1)
        aggregated = torch.einsum("binj,bjnc->binc", weights, message)
        return self.output(aggregated).flatten(0, 1), weights

    def _compiles(self, values: Tensor) -> bool:
        """Tell whether compiled loops can do it: the paper's scores, on a CPU, under no transform such as vmap."""
        plain = not functorch.is_wrapped(values)
        return plain and not self.gatv2 and values.device.type == "cpu"

    def output(self, aggregated: Tensor) -> Tensor:
        """Concatenate the heads of ``(..., H, C)`` and add the bias: ``(..., out_features)``."""
        return aggregated.flatten(-2) + self.bias

    def _score(self, pair: Tensor) -> Tensor:
        """Scores from the sum of the target's and the source's part: ``(..., H)``."""
        pair = functional.leaky_relu(pair, NEGATIVE_SLOPE)
        return (pair * self.source).sum(-1) if self.gatv2 else pair


def after(weight: Tensor, pending: Affine | None) -> Affine:
    """``weight`` applied after a pending linear map, as one linear map."""
    if pending is None:
        return weight, None
    return weight @ pending[0], None if pending[1] is None else weight @ pending[1]


def edge_softmax(own: Tensor, incoming: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """Softmax over each target's self-loop and incoming edges.

    Args:
        own: scores of self-loops, ``(T, H)``.
        incoming: scores of edges, ``(E, H)``.
        target: row of each edge's target, ``(E,)``.

    Returns:
        Weights of self-loops ``(T, H)`` and of edges ``(E, H)``.
    """
    index = target.unsqueeze(-1).expand_as(incoming)
    peak = own.detach().scatter_reduce(0, index, incoming.detach(), "amax")
    own = (own - peak).exp()
    incoming = (incoming - peak.index_select(0, target)).exp()
    total = own.index_add(0, target, incoming)
    return own / total, incoming / total.index_select(0, target)
