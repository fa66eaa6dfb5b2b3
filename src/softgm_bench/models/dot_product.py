"""Scaled dot-product attention (Vaswani et al. 2017) of agents over each other and over obstacle bins.

What graph transformers and transformers over sections share. Agents alone have queries: a bin hears nobody, so what is
sensed by agents that are far apart carries no message between them. One sum, two forms:

- where values may be read, bins with an edge alone are gathered, and ``dot_product_kernel`` sums in compiled loops;
- on a device that must not be waited for (``softgm_bench.rod.sync``), under a transform such as vmap, and where every
  agent hears every discovered bin, all slots are computed and masked, in shapes that no value decides on.
"""

import math
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torch.nn import functional

from softgm_bench.envs import entries
from softgm_bench.models import graph
from softgm_bench.models.dot_product_kernel import DotProductAttention
from softgm_bench.rod import sync
from softgm_bench.upstream import functorch


def check_sizes(config: Any, *counts: str) -> None:
    """Refuse sizes that give no network; heads share ``hidden``.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    for name in ("hidden", "heads", *counts):
        if getattr(config, name) < 1:
            raise ValueError(f"model.{name} is {getattr(config, name)}: it must be at least 1")
    if config.hidden % config.heads:
        raise ValueError(f"model.hidden is {config.hidden}: it must be a multiple of model.heads, {config.heads}")


class Hearing(NamedTuple):
    """Who hears what in a batch of B observations with N agents and M slots.

    Attributes:
        n_agents: N.
        reach: how many places away on the chain an agent is heard.
        itself: whether an agent hears itself.
        bins: nodes of the bins, ``(K, 15)`` of those that some agent hears, or ``(B M, 15)`` of all slots.
        heard: edges from the former; or what is added to scores of all slots, ``(B, N, 1, M)``: 0 where the agent
            hears the slot, else -inf.
        n_slots: M of the observation, of which ``heard`` may leave out the last ones.
    """

    n_agents: int
    reach: int
    itself: bool
    bins: Tensor
    heard: graph.Sensed | Tensor
    n_slots: int


class Distances(NamedTuple):
    """How far what is heard is from who hears it, m.

    Attributes:
        agents: ``(B N, N)``.
        bins: of the edges ``(E,)``, or of all slots ``(B, N, M)``.
    """

    agents: Tensor
    bins: Tensor


class Heard(NamedTuple):
    """The result of attention for T packed agents.

    Attributes:
        values: weighted sums of values, ``(T, H, C)``; zero for an agent that hears nothing.
        distances: weighted sums of distances, ``(T, H)``.
        of_agents: weights of agents, ``(T, H, N)``.
        of_bins: weights of the edges ``(E, H)``, or of all slots ``(T, H, M)``.
    """

    values: Tensor
    distances: Tensor
    of_agents: Tensor
    of_bins: Tensor


def listen(td: TensorDictBase, reach: int | None, itself: bool, discovered: bool) -> Hearing:
    """Find out who hears what in an observation, whose leading dimensions are packed into B.

    Args:
        td: the entries ``entries.OBSERVATION``.
        reach: how many places away on the chain an agent is heard; None: everywhere.
        itself: whether an agent hears itself.
        discovered: agents hear all bins that the team has discovered, not those alone that they sense.
    """
    n_agents, n_slots = td[entries.EDGE].shape[-2:]
    device = td[entries.EDGE].device
    reach = n_agents if reach is None else reach
    if sync.is_free(device) and not discovered and not functorch.transforms_active():
        edges = graph.sense(td)
        return Hearing(n_agents, reach, itself, edges.channels, edges, n_slots)
    if sync.is_free(device):
        td = graph.without_empty_slots(td)
    absent = graph.absent_slots(td, discovered)
    return Hearing(n_agents, reach, itself, graph.all_slots(td).flatten(0, 1), absent, n_slots)


def distances(hearing: Hearing, position: Tensor) -> Distances:
    """Give the distances for positions of packed agents ``(B N, 3)``."""
    of_environment = position.unflatten(0, (-1, hearing.n_agents))
    agents = _length(of_environment.unsqueeze(2) - of_environment.unsqueeze(1)).flatten(0, 1)
    centre = hearing.bins[:, :3]
    if isinstance(hearing.heard, Tensor):
        centre = centre.unflatten(0, _slots(hearing.heard)).unsqueeze(1)
        return Distances(agents, _length(of_environment.unsqueeze(2) - centre))
    ways = position.index_select(0, hearing.heard.target) - centre.index_select(0, hearing.heard.source)
    return Distances(agents, _length(ways))


def attend(
    agents: Tensor, bins: Tensor, hearing: Hearing, far: Distances | None = None, slope: Tensor | None = None
) -> Heard:
    """Let every agent hear: softmax over all that it hears of ``(q^T k + slope d) / sqrt(C)``, d the distance.

    Args:
        agents: query, key and value of T packed agents, ``(T, 3, H, C)``.
        bins: key and value of ``hearing.bins``, ``(K or B M, 2, H, C)``.
        hearing: who hears what.
        far: the distances; None: all are 0.
        slope: ``(T, H)``; belongs to ``far``.
    """
    edges = hearing.heard
    if isinstance(edges, Tensor):
        return _masked(agents, bins, edges, hearing, far, slope)
    if far is None:
        far = Distances(agents.new_zeros(len(agents), hearing.n_agents), agents.new_zeros(len(edges.source)))
    if slope is None:
        slope = agents.new_zeros(len(agents), agents.shape[2])
    sizes = (hearing.n_agents, hearing.reach, hearing.itself)
    return Heard(*DotProductAttention.apply(agents, bins, slope, *far, edges.first, edges.source, sizes))


def weights(heard: Heard, hearing: Hearing) -> Tensor:
    """Give the weights over all nodes, agents first, ``(B, H, N, N + M)``."""
    if isinstance(hearing.heard, Tensor):
        bins = functional.pad(heard.of_bins, (0, hearing.n_slots - heard.of_bins.shape[-1]))
    else:
        by_slot = heard.of_agents.new_zeros(len(heard.of_agents), hearing.n_slots, heard.of_agents.shape[1])
        by_slot[hearing.heard.target, hearing.heard.slot] = heard.of_bins
        bins = by_slot.mT
    return torch.cat([heard.of_agents, bins], dim=-1).unflatten(0, (-1, hearing.n_agents)).transpose(1, 2)


def _masked(
    agents: Tensor, bins: Tensor, absent: Tensor, hearing: Hearing, far: Distances | None, slope: Tensor | None
) -> Heard:
    n_agents = hearing.n_agents
    query, key, value = agents.unflatten(0, (-1, n_agents)).unbind(2)  # (B, N, H, C)
    bin_key, bin_value = bins.unflatten(0, _slots(absent)).unbind(2)  # (B, M, H, C)
    apart = _apart(n_agents, hearing.reach, hearing.itself, absent.device, absent.dtype)
    scores = torch.cat(
        [
            torch.einsum("bihc,bjhc->bihj", query, key) + apart,
            torch.einsum("bihc,bmhc->bihm", query, bin_key) + absent,
        ],
        dim=-1,
    )
    if far is not None and slope is not None:
        by_environment = torch.cat([far.agents.unflatten(0, (-1, n_agents)), far.bins], dim=-1).unsqueeze(2)
        scores = scores + slope.unflatten(0, (-1, n_agents)).unsqueeze(-1) * by_environment
    shares = _softmax(scores * (1.0 / math.sqrt(query.shape[-1])))
    of_agents, of_bins = shares.split([n_agents, absent.shape[-1]], dim=-1)
    values = torch.einsum("bihj,bjhc->bihc", of_agents, value) + torch.einsum("bihm,bmhc->bihc", of_bins, bin_value)
    pooled = torch.zeros_like(shares[..., 0]) if far is None else (shares * by_environment).sum(-1)
    return Heard(*(part.flatten(0, 1) for part in (values, pooled, of_agents, of_bins)))


def _softmax(scores: Tensor) -> Tensor:
    """Softmax over the last dimension, and zero where all of it is -inf: an agent that hears nothing."""
    peak = scores.detach().amax(-1, keepdim=True).clamp_min(torch.finfo(scores.dtype).min)
    shares = (scores - peak).exp()
    return shares / shares.sum(-1, keepdim=True).clamp_min(1.0)  # the largest is 1


@lru_cache
def _apart(n_agents: int, reach: int, itself: bool, device: torch.device, dtype: torch.dtype) -> Tensor:
    """0 where an agent hears another one, else -inf: ``(N, 1, N)``, target first. Made once, and not to be changed."""
    none = torch.full((n_agents, n_agents), -math.inf, device=device, dtype=dtype)
    apart = none.triu(reach + 1) + none.tril(-reach - 1)
    return (apart if itself else apart + none.triu().tril()).unsqueeze(1)


def _slots(absent: Tensor) -> tuple[int, int]:
    return absent.shape[0], absent.shape[-1]


def _length(vectors: Tensor) -> Tensor:
    return torch.linalg.vector_norm(vectors, dim=-1)
