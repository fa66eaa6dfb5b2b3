"""Attention along a chain of agents, forward and backward, with compiled loops over graphs for the CPU.

As tensor operations, the weighted sums are a dozen passes over all messages; here a graph's few kilobytes are worked
through while they lie in the cache. Scores and softmax, a number per head each, stay tensor operations.
``GraphAttention.chain`` says what is computed.
"""

import math
from collections.abc import Iterable
from typing import Any

import numba
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from softgm_bench.rod.compiling import njit

NEIGHBOURS = 3  # the previous agent, the agent itself, the next one
FAST = {"reassoc", "contract", "nsz"}  # sums may be reordered: LLVM vectorises them then


@njit(parallel=True, error_model="numpy", fastmath=FAST)
def aggregate(values, weights, n_agents, out):
    """Write the weighted sums of messages, ``out`` ``(T, H C)``.

    ``values`` ``(T, H C + 2 H)``: message, score as a source, score as a target; ``weights`` ``(3, T, H)``.
    """
    n_heads = weights.shape[2]
    n_channels = out.shape[1] // n_heads
    for graph in numba.prange(out.shape[0] // n_agents):
        for agent in range(n_agents):
            row = graph * n_agents + agent
            for head in range(n_heads):
                start, stop = head * n_channels, (head + 1) * n_channels
                new, own = out[row, start:stop], values[row, start:stop]
                for channel in range(n_channels):
                    new[channel] = weights[1, row, head] * own[channel]
                if agent > 0:
                    add_scaled(weights[0, row, head], values[row - 1, start:stop], new)
                if agent < n_agents - 1:
                    add_scaled(weights[2, row, head], values[row + 1, start:stop], new)


@njit(parallel=True, error_model="numpy", fastmath=FAST)
def differentiate(values, weights, gradient, n_agents, of_values, of_weights):
    """Write the gradients of ``aggregate``'s messages and weights from that of its ``out``.

    Both results must hold zeros; ``of_values`` has the shape of ``values``, of which only messages are written.
    """
    n_heads = weights.shape[2]
    n_channels = gradient.shape[1] // n_heads
    for graph in numba.prange(gradient.shape[0] // n_agents):
        for agent in range(n_agents):
            row = graph * n_agents + agent
            for head in range(n_heads):
                start, stop = head * n_channels, (head + 1) * n_channels
                new = gradient[row, start:stop]
                for step in range(max(agent - 1, 0) - agent, min(agent + 1, n_agents - 1) - agent + 1):
                    add_scaled(weights[step + 1, row, head], new, of_values[row + step, start:stop])
                    of_weights[step + 1, row, head] = dot(new, values[row + step, start:stop])


@numba.njit(inline="always", error_model="numpy", fastmath=FAST)
def add_scaled(factor, source, target):
    """Add ``factor * source`` to ``target``, arrays of one length."""
    for index in range(source.size):
        target[index] += factor * source[index]


@numba.njit(inline="always", error_model="numpy", fastmath=FAST)
def dot(one, other):
    """Give the scalar product of two arrays of one length."""
    total = one.dtype.type(0.0)
    for index in range(one.size):
        total += one[index] * other[index]
    return total


def arrays(tensors: Iterable[Tensor]) -> list[np.ndarray]:
    """The memory of tensors on the CPU, for compiled loops."""
    return [tensor.numpy() for tensor in tensors]


class ChainAttention(torch.autograd.Function):
    """``apply(values, N, H, slope)``: new agents ``(T, H C)`` before the bias and weights ``(3, T, H)``.

    The weights are for reading; no gradient flows through them.
    """

    @staticmethod
    def forward(ctx: Any, values: Tensor, n_agents: int, n_heads: int, slope: float) -> Any:
        """Compute both."""
        values = values.detach().contiguous()
        out = values.new_empty(len(values), values.shape[1] - 2 * n_heads)
        pairs = _pairs(values, n_agents, n_heads)
        weights = functional.leaky_relu(pairs, slope).softmax(dim=0)
        aggregate(*arrays((values, weights)), n_agents, *arrays((out,)))
        ctx.save_for_backward(values, pairs, weights)
        ctx.n_agents, ctx.n_heads, ctx.slope = n_agents, n_heads, slope
        ctx.mark_non_differentiable(weights)
        return out, weights

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        """The gradient with respect to ``values``."""
        values, pairs, weights = ctx.saved_tensors
        of_values, of_weights = torch.zeros_like(values), torch.zeros_like(weights)
        gradient = gradients[0].contiguous()
        differentiate(*arrays((values, weights, gradient)), ctx.n_agents, *arrays((of_values, of_weights)))
        of_scores = weights * (of_weights - (weights * of_weights).sum(0))
        of_pairs = torch.where(pairs < 0.0, ctx.slope * of_scores, of_scores)

        of_source, of_target = of_values[:, -2 * ctx.n_heads :].unflatten(0, (-1, ctx.n_agents)).chunk(2, dim=-1)
        of_target.copy_(of_pairs.sum(0).view_as(of_target))
        before, own, after = of_pairs.unflatten(1, (-1, ctx.n_agents))
        of_source.copy_(own)
        of_source[:, :-1] += before[:, 1:]
        of_source[:, 1:] += after[:, :-1]
        return of_values, None, None, None


def _pairs(values: Tensor, n_agents: int, n_heads: int) -> Tensor:
    """The target's part plus the source's part of each score, -inf where there is no neighbour: ``(3, T, H)``."""
    source, target = values[:, -2 * n_heads :].unflatten(0, (-1, n_agents)).chunk(2, dim=-1)
    pairs = values.new_full((NEIGHBOURS, *target.shape), -math.inf)
    torch.add(target[:, 1:], source[:, :-1], out=pairs[0, :, 1:])
    torch.add(target, source, out=pairs[1])
    torch.add(target[:, :-1], source[:, 1:], out=pairs[2, :, :-1])
    return pairs.flatten(1, 2)
