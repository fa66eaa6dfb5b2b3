"""SoftGM's encoder: two stages of graph attention (paper, section "Attention-based Message Passing").

Cheap by construction. Only obstacle slots with an edge to some agent are computed: slots hear nobody, so one without an
edge cannot influence any agent. On a device that must not be waited for (``softgm_bench.rod.sync``) all slots are
computed and masked instead, in shapes that no value decides on; and where every agent hears every discovered slot,
which is too many edges for a list. Nothing between ``W_in`` and the first attention layer
is nonlinear, so their matrices are multiplied first and ``h^(0)`` is never formed (unless a residual connection needs
it). ``forward_dense`` is the paper's text, all nodes and masked, with the same parameters; the forms agree to rounding.

Where the paper is silent: ELU after every layer but the very last, a bias in every layer, and heads concatenated in all
of them (Velickovic et al. 2018 average them in a classifier's last layer).
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import graph
from softgm_bench.models.attention import chain_attention, entity_attention, slot_attention, stack_layers
from softgm_bench.models.gat import Affine, GraphAttention, after
from softgm_bench.models.registry import Encoder, register_model
from softgm_bench.rod import sync


@dataclass
class SoftGMConfig:
    """Architecture of SoftGM. Values: ``conf/model/softgm.yaml``.

    Attributes:
        name: of the file in ``conf/model``; the paper's ablations and SoftGM that remembers have names of their own.
        hidden: length of a node's embedding, over all heads (paper: 128).
        heads: attention heads; divides ``hidden`` (paper: 4).
        layers: L, attention layers in each stage (paper: 2).
        type_embedding: length of the learnt embedding of a node's type (paper: 8).
        stage1: entity -> agent messages; false is the paper's ablation "without stage 1".
        stage2: agent <-> agent messages; false is the paper's ablation "without stage 2".
        gatv2: GATv2 scores instead of the paper's GAT scores.
        residual: add a layer's input to its output (paper: no).
        velocity_scale: factor of the agents' velocity channels at the input (paper: 1).
        remember: every agent hears all slots that the team has discovered, not those alone that it senses (paper: no).
    """

    name: str
    hidden: int
    heads: int
    layers: int
    type_embedding: int
    stage1: bool
    stage2: bool
    gatv2: bool
    residual: bool
    velocity_scale: float
    remember: bool

    def __post_init__(self) -> None:
        """Refuse values that give no network.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        for name, lowest in (("hidden", 1), ("heads", 1), ("layers", 0), ("type_embedding", 1)):
            if getattr(self, name) < lowest:
                raise ValueError(f"model.{name} is {getattr(self, name)}: it must be at least {lowest}")


Record = list[Tensor] | None  # where to leave the attention of each layer


@register_model("softgm", "softgm_no_stage1", "softgm_no_stage2", "softgm_remember", config=SoftGMConfig)
class SoftGMEncoder(Encoder):
    """Turns the observation into one embedding g_i per agent."""

    def __init__(self, config: SoftGMConfig, sizes: Sizes) -> None:
        """Draw the parameters; none depends on N or M, which ``forward`` takes from the observation."""
        super().__init__(config.hidden, config.velocity_scale)
        self.config = config
        self.types = nn.Embedding(3, config.type_embedding)  # PAD's row never trains: a PAD node has no edge
        self.input = nn.Linear(graph.NODE_FEATURES + config.type_embedding, config.hidden, bias=False)
        nn.init.xavier_uniform_(self.input.weight)

        def stage(used: bool) -> nn.ModuleList:
            depth = config.layers if used else 0
            shape = (config.hidden, config.hidden, config.heads, config.gatv2)
            return nn.ModuleList(GraphAttention(*shape) for _ in range(depth))

        self.stage1, self.stage2 = stage(config.stage1), stage(config.stage2)

    def forward(self, td: TensorDictBase) -> Tensor:
        """Embeddings ``(..., N, hidden)`` from the entries ``entries.OBSERVATION``."""
        return self._embed(td, None, None)

    def forward_with_attention(self, td: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Embeddings as ``forward``, and the attention weights of every layer.

        Returns:
            ``stage1``: ``(..., L, H, N, N + M)``, of every node (agents, then slots) for every agent; ``stage2``:
            ``(..., L, H, N, N)``. Rows sum to one. A stage that is switched off is absent.
        """
        stage1: list[Tensor] = []
        stage2: list[Tensor] = []
        embeddings = self._embed(td, stage1, stage2)
        return embeddings, stack_layers({"stage1": stage1, "stage2": stage2}, embeddings.shape[:-2])

    def forward_dense(self, td: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """The paper's formulas over all N + M nodes, masked: the reference for ``forward_with_attention``."""
        n_agents, n_slots = td[entries.EDGE].shape[-2:]
        channels = torch.cat([graph.agent_channels(td, self.velocity_scale), graph.slot_channels(td)], dim=-2)
        nodes = self.input(torch.cat([graph.pad_channels(channels), self.types(graph.node_types(td))], dim=-1))
        lead = nodes.shape[:-2]

        adjacency = graph.full_adjacency(td, self.config.remember)
        identity = torch.eye(n_agents + n_slots, dtype=torch.bool, device=nodes.device)
        is_agent = torch.arange(n_agents + n_slots, device=nodes.device) < n_agents
        record: dict[str, list[Tensor]] = {"stage1": [], "stage2": []}
        plan = [("stage1", ~is_agent, layer) for layer in _layers(self.stage1)]
        plan += [("stage2", is_agent, layer) for layer in _layers(self.stage2)]
        for depth, (stage, sources, layer) in enumerate(plan, start=1):
            out, attention = layer(nodes, (adjacency & is_agent.unsqueeze(-1) & sources) | identity)
            nodes = self._between(out, nodes, last=depth == len(plan))
            columns = n_agents + n_slots if stage == "stage1" else n_agents
            record[stage].append(attention[..., :n_agents, :columns].reshape(-1, layer.heads, n_agents, columns))
        return nodes[..., :n_agents, :], stack_layers(record, lead)

    def _embed(self, td: TensorDictBase, stage1: Record, stage2: Record) -> Tensor:
        channels = graph.agent_channels(td, self.velocity_scale)
        shape = td[entries.EDGE].shape[-2:]
        agents, pending = self._enter(channels.flatten(0, -2), graph.AGENT)  # packed: (B N, 15 or hidden)
        if len(self.stage1):
            agents, pending = self._entity_stage(td, agents, pending, stage1), None
        if len(self.stage2):
            agents = self._agent_stage(agents, pending, shape[0], stage2)
        return agents.unflatten(0, channels.shape[:-1])

    def _entity_stage(self, td: TensorDictBase, agents: Tensor, pending: Affine | None, record: Record) -> Tensor:
        """Stage 1: ``(B N, hidden)`` after L layers of entity -> agent messages.

        ``W_in`` is absorbed with residual connections too: an obstacle node hears only itself, so they are linear there
        as well.
        """
        n_agents, n_slots = td[entries.EDGE].shape[-2:]
        nodes, heard = self._nodes(td, crop=record is None)
        entity_pending: Affine | None = self._input_of(graph.OBSTACLE)
        for depth, layer in enumerate(_layers(self.stage1), start=1):
            last = depth == len(self.stage1)
            affine = after(layer.weight, entity_pending)
            if isinstance(heard, graph.Sensed):
                own = layer.project(agents, *after(layer.joint_weight(), pending))
                out, own_weights, weights = layer.edges_to_agent(own, nodes, affine, heard, n_agents)
            else:
                own = layer.project_agents(agents, pending)
                out, own_weights, weights = layer.slots_to_agent(own, nodes, affine, heard)
            if not last:  # nobody reads what the last layer makes of obstacle nodes
                nodes = functional.elu(self._slot_message(nodes, affine, entity_pending, layer.bias), inplace=True)
                entity_pending = None
            agents, pending = self._between(out, agents, last=last and not len(self.stage2)), None
            if record is not None and isinstance(heard, graph.Sensed):
                record.append(entity_attention(own_weights, weights, heard, (n_agents, n_slots)))
            elif record is not None:
                record.append(slot_attention(own_weights, weights))
        return agents

    def _nodes(self, td: TensorDictBase, *, crop: bool) -> tuple[Tensor, graph.Sensed | Tensor]:
        """Obstacle nodes and who hears them: packed, with edges, or all slots ``(B, M, 15)`` with ``absent_slots``.

        ``crop`` leaves slots out that are in use nowhere.
        """
        is_free = sync.is_free(td[entries.EDGE].device)
        if is_free and not self.config.remember:
            sensed = graph.sense(td)
            return sensed.channels, sensed
        if is_free and crop:
            td = graph.without_empty_slots(td)
        return graph.all_slots(td), graph.absent_slots(td, self.config.remember)

    def _slot_message(self, slots: Tensor, affine: Affine, pending: Affine | None, bias: Tensor) -> Tensor:
        """What slots make of themselves before the nonlinearity, ``(..., hidden)``.

        ``affine`` gives their messages and ``pending``, unless it is None, the embeddings that they stand for.
        """
        weight, offset = affine[0], bias if affine[1] is None else affine[1] + bias
        if self.config.residual and pending is not None:
            weight, offset = weight + pending[0], offset if pending[1] is None else offset + pending[1]
        out = functional.linear(slots, weight, offset)
        return out + slots if self.config.residual and pending is None else out

    def _agent_stage(self, agents: Tensor, pending: Affine | None, n_agents: int, record: Record) -> Tensor:
        """Stage 2: ``(B N, hidden)`` after L layers of agent <-> agent messages."""
        absent = None if sync.is_free(agents.device) else graph.absent_neighbours(n_agents, agents.device, agents.dtype)
        for depth, layer in enumerate(_layers(self.stage2), start=1):
            if absent is None:
                own = layer.project(agents, *after(layer.joint_weight(), pending))
                out, weights = layer.chain(own, n_agents)
            else:
                out, weights = layer.chain_masked(layer.project_agents(agents, pending), absent)
            agents, pending = self._between(out, agents, last=depth == len(self.stage2)), None
            if record is not None:
                record.append(chain_attention(weights) if absent is None else weights.transpose(1, 2))
        return agents

    def _enter(self, channels: Tensor, node_type: int) -> tuple[Tensor, Affine | None]:
        """``h^(0)`` of nodes of one type; or, if a layer follows that can absorb ``W_in``, their channels and W_in."""
        pending = self._input_of(node_type)
        if self.config.residual or not (len(self.stage1) or len(self.stage2)):
            return functional.linear(channels, *pending), None
        return channels, pending

    def _input_of(self, node_type: int) -> Affine:
        """``W_in`` for nodes of one type, as a linear map of their channels."""
        weight = self.input.weight
        offset = weight[:, graph.NODE_FEATURES :] @ self.types.weight[node_type]
        return weight[:, : graph.CHANNELS], offset

    def _between(self, out: Tensor, before: Tensor, *, last: bool) -> Tensor:
        if self.config.residual:
            out = out + before
        return out if last else functional.elu(out)


def _layers(stage: nn.ModuleList) -> Iterable[GraphAttention]:
    return cast(Iterable[GraphAttention], stage)
