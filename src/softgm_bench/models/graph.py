"""The paper's graph from the observation, by pure functions.

Shapes: ``...`` are any leading batch dimensions (time, environment), N agents, M obstacle slots. The node order is the
paper's: the N agents first, then the M slots. Contract with the environment: an edge exists only from an active slot.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softgm_bench.envs import entries
from softgm_bench.envs.views import (
    CHANNELS,
    MIRRORED,
    agent_channels,
    flat_features,
    flat_observation,
    mirrored,
    obstacle_channels,
    relative_points,
    slot_channels,
)

NODE_FEATURES = 22  # the paper's x_v, of which the last 7 are reserved zeros for every node type
AGENT, OBSTACLE, PAD = 0, 1, 2  # node types

__all__ = [  # with the views, so that models name one module
    "AGENT",
    "CHANNELS",
    "MIRRORED",
    "NODE_FEATURES",
    "OBSTACLE",
    "PAD",
    "Sensed",
    "absent_neighbours",
    "absent_slots",
    "agent_channels",
    "agent_features",
    "all_slots",
    "chain_adjacency",
    "flat_features",
    "flat_observation",
    "full_adjacency",
    "heard_slots",
    "mirrored",
    "node_types",
    "obstacle_channels",
    "pad_channels",
    "relative_points",
    "sense",
    "slot_channels",
    "slot_features",
    "without_empty_slots",
]


def agent_features(td: TensorDictBase) -> Tensor:
    """The agent nodes' ``x_i``, ``(..., N, 22)`` (section "Graph Construction")."""
    return pad_channels(agent_channels(td))


def slot_features(td: TensorDictBase) -> Tensor:
    """The slot nodes' ``x_k``, ``(..., M, 22)``; a PAD node is exactly zero (section "Graph Construction")."""
    return pad_channels(slot_channels(td))


def node_types(td: TensorDictBase) -> Tensor:
    """AGENT, OBSTACLE or PAD of every node, int64 ``(..., N + M)``."""
    active = td[entries.SLOT_ACTIVE]
    agents = active.new_full((*active.shape[:-1], td[entries.EDGE].shape[-2]), AGENT, dtype=torch.long)
    slots = torch.full_like(active, PAD, dtype=torch.long).masked_fill_(active, OBSTACLE)
    return torch.cat([agents, slots], dim=-1)


def chain_adjacency(n_agents: int, device: torch.device | None = None) -> Tensor:
    """Neighbouring agents, both ways, without self-loops: bool ``(N, N)``."""
    index = torch.arange(n_agents, device=device)
    return (index.unsqueeze(0) - index.unsqueeze(1)).abs() == 1


def heard_slots(td: TensorDictBase, discovered: bool) -> Tensor:
    """Which slots' messages reach an agent, bool ``(..., N, M)``: those that it senses now, as in the paper.

    ``discovered``: every agent hears every slot that some agent has sensed in this episode. A slot keeps its index
    until the episode ends, so the table of slots is a memory of the team, the one that an MLP reads.
    """
    edge = td[entries.EDGE]
    return td[entries.SLOT_ACTIVE].unsqueeze(-2).expand_as(edge) if discovered else edge


def full_adjacency(td: TensorDictBase, discovered: bool = False) -> Tensor:
    """The paper's A_t, bool ``(..., N + M, N + M)``: row u, column v true if a message may go from v to u.

    Agents hear their neighbours on the chain and the obstacles of ``heard_slots``; slots hear nobody. Self-loops belong
    to the stages, not to A_t.
    """
    edge = heard_slots(td, discovered)
    n_agents, n_slots = edge.shape[-2:]
    adjacency = edge.new_zeros((*edge.shape[:-2], n_agents + n_slots, n_agents + n_slots))
    adjacency[..., :n_agents, :n_agents] = chain_adjacency(n_agents, edge.device)
    adjacency[..., :n_agents, n_agents:] = edge
    return adjacency


def pad_channels(channels: Tensor) -> Tensor:
    """Append the paper's reserved zeros: ``(..., 15)`` to ``(..., 22)``."""
    return torch.nn.functional.pad(channels, (0, NODE_FEATURES - CHANNELS))


@lru_cache
def absent_neighbours(n_agents: int, device: torch.device, dtype: torch.dtype) -> Tensor:
    """0 between an agent and itself or a neighbour on the chain, else -inf: ``(N, 1, N)``, target first.

    Made once, and not to be changed.
    """
    apart = torch.full((n_agents, n_agents), -math.inf, device=device, dtype=dtype)
    return (apart.triu(2) + apart.tril(-2)).unsqueeze(1)


def absent_slots(td: TensorDictBase, discovered: bool = False) -> Tensor:
    """0 where an agent hears a slot, else -inf: ``(B, N, 1, M)``, leading dimensions packed into B."""
    edge = heard_slots(td, discovered)
    shape = (edge.shape[:-2].numel(), edge.shape[-2], 1, edge.shape[-1])  # a task may have no slots at all
    return edge.to(td[entries.SLOT_DESCRIPTOR].dtype).log().reshape(shape)


def all_slots(td: TensorDictBase) -> Tensor:
    """Features of all slots, ``(B, M, 15)``, leading dimensions packed into B; those of PAD are finite, no more."""
    descriptor = td[entries.SLOT_DESCRIPTOR]
    target, tip = td[entries.TARGET].unsqueeze(-2), td[entries.TIP].unsqueeze(-2)
    shape = (descriptor.shape[:-2].numel(), descriptor.shape[-2], CHANNELS)
    return obstacle_channels(descriptor, target, tip).reshape(shape)


def without_empty_slots(td: TensorDictBase) -> TensorDictBase:
    """Give the observation without the last slots, those that are active nowhere in the batch: slots fill in order.

    Where that many are, is read from the tensors: not for devices that must not be waited for.
    """
    active = td[entries.SLOT_ACTIVE]
    used = active.unsqueeze(0).flatten(0, -2).any(0).nonzero()
    count = int(used[-1]) + 1 if len(used) else 0
    cropped = td.select(entries.TIP, entries.TARGET)
    cropped[entries.EDGE] = td[entries.EDGE][..., :count]
    cropped[entries.SLOT_ACTIVE] = active[..., :count]
    cropped[entries.SLOT_DESCRIPTOR] = td[entries.SLOT_DESCRIPTOR][..., :count, :]
    return cropped


class Sensed(NamedTuple):
    """The K obstacle nodes that some agent senses now, packed over the batch, and the E edges from them.

    Attributes:
        channels: features of the nodes, ``(K, 15)``.
        source: the node of each edge, ``(E,)``.
        target: the agent of each edge among all ``B N`` packed agents, ascending, ``(E,)``.
        slot: the slot of each edge's node, ``(E,)``.
        first: the first edge of each packed agent, and E, ``(B N + 1,)``.
    """

    channels: Tensor
    source: Tensor
    target: Tensor
    slot: Tensor
    first: Tensor


def sense(td: TensorDictBase) -> Sensed:
    """Gather what the entity -> agent edges need. Leading dimensions are packed into B."""
    edge = td[entries.EDGE]
    n_agents, n_slots = edge.shape[-2:]
    position = edge.reshape(-1).nonzero().squeeze(-1)
    target = position // n_slots
    slot = position - target * n_slots
    row = (target // n_agents) * n_slots + slot  # the slot's row among all B M slots

    active = edge.new_zeros(edge.numel() // n_agents).index_fill_(0, row, True)
    rows = active.nonzero().squeeze(-1)
    rank = torch.empty_like(active, dtype=torch.long)  # read only where written
    rank.index_copy_(0, rows, torch.arange(rows.numel(), device=rows.device))

    environment = rows // n_slots
    descriptor = td[entries.SLOT_DESCRIPTOR].flatten(0, -2).index_select(0, rows)
    goal = td[entries.TARGET].reshape(-1, 3).index_select(0, environment)
    tip = td[entries.TIP].reshape(-1, 3).index_select(0, environment)
    first = torch.searchsorted(target, torch.arange(edge.shape[:-1].numel() + 1, device=edge.device))
    return Sensed(obstacle_channels(descriptor, goal, tip), rank.index_select(0, row), target, slot, first)
