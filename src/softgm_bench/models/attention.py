"""Attention weights as dense tensors, for figures and tests: rows are targets, columns are sources."""

import torch
from torch import Tensor

from softgm_bench.models.graph import Sensed


def entity_attention(own: Tensor, incoming: Tensor, sensed: Sensed, shape: tuple[int, int]) -> Tensor:
    """Stage 1's weights over all nodes.

    Args:
        own: weights of the self-loops of packed agents, ``(B N, H)``.
        incoming: weights of the edges, ``(E, H)``.
        sensed: the edges.
        shape: N and M.

    Returns:
        ``(B, H, N, N + M)``.
    """
    n_agents, n_slots = shape
    rows = torch.arange(own.shape[0], device=own.device)
    dense = own.new_zeros(own.shape[0], n_agents + n_slots, own.shape[1])
    dense[rows, rows % n_agents] = own
    dense[sensed.target, n_agents + sensed.slot] = incoming
    return dense.unflatten(0, (-1, n_agents)).movedim(-1, 1)


def slot_attention(own: Tensor, incoming: Tensor) -> Tensor:
    """Stage 1's weights over all nodes, where those of all slots are at hand.

    Args:
        own: weights of the self-loops of packed agents, ``(B N, H)``.
        incoming: weights of the slots, ``(B, N, H, M)``.

    Returns:
        ``(B, H, N, N + M)``.
    """
    agents = torch.diag_embed(own.unflatten(0, incoming.shape[:2]).transpose(1, 2))
    return torch.cat([agents, incoming.transpose(1, 2)], dim=-1)


def chain_attention(weights: Tensor) -> Tensor:
    """Stage 2's weights: from ``(3, B, N, H)`` (previous, own, next) to ``(B, H, N, N)``."""
    before, own, after = (part.movedim(-1, 1) for part in weights)
    dense = torch.diag_embed(own)
    if own.shape[-1] > 1:
        dense = dense + torch.diag_embed(before[..., 1:], -1) + torch.diag_embed(after[..., :-1], 1)
    return dense


def stack_layers(attention: dict[str, list[Tensor]], lead: torch.Size) -> dict[str, Tensor]:
    """Per stage, from L tensors ``(B, H, targets, sources)`` to one ``(..., L, H, targets, sources)``."""
    stacked = {stage: torch.stack(layers, 1) for stage, layers in attention.items() if layers}
    return {stage: weights.reshape(*lead, *weights.shape[1:]) for stage, weights in stacked.items()}
