"""Scaled dot-product attention of agents, forward and backward, with compiled loops over environments for the CPU.

As tensor operations it is some dozen passes over all queries, keys and values, and takes longer than the matrix
products that make them; here an environment's few kilobytes are worked through while they lie in the cache. A node is
heard in its own environment alone, so environments may be worked on in parallel. ``dot_product.attend`` says what is
computed; T agents are those of all environments, K bins those that some agent hears, E edges go from bins to agents.
"""

import math
from typing import Any

import numba
import torch
from torch import Tensor

from softgm_bench.models.chain_kernel import FAST, add_scaled, arrays, dot
from softgm_bench.rod.compiling import njit


@njit(parallel=True, error_model="numpy", fastmath=FAST)
def gather(agents, bins, slope, near, far, first, source, sizes, of_agents, of_bins, out, pooled):
    """Write weights, what agents hear and how far it is.

    Args:
        agents: query, key and value, ``(T, 3, H, C)``.
        bins: key and value, ``(K, 2, H, C)``.
        slope: what a distance of 1 adds to a score before scaling, ``(T, H)``.
        near: distances of an agent from the agents of its environment, ``(T, N)``.
        far: distances of the edges, ``(E,)``.
        first: the first edge of each agent, and E, ``(T + 1,)``.
        source: the bin of each edge, ``(E,)``.
        sizes: N, how many places away on the chain an agent is heard, whether an agent hears itself.
        of_agents: weights of agents, ``(T, H, N)``; must hold zeros.
        of_bins: weights of edges, ``(E, H)``.
        out: weighted sums of values, ``(T, H, C)``.
        pooled: weighted sums of distances, ``(T, H)``.
    """
    n_agents, reach, itself = sizes
    scale = out.dtype.type(1.0 / math.sqrt(out.shape[2]))
    for graph in numba.prange(out.shape[0] // n_agents):
        for agent in range(n_agents):
            row = graph * n_agents + agent
            low, high = max(agent - reach, 0), min(agent + reach + 1, n_agents)
            edges = range(first[row], first[row + 1])
            for head in range(out.shape[1]):
                query, weights = agents[row, 0, head], of_agents[row, head]
                peak = out.dtype.type(-math.inf)
                for other in range(low, high):
                    if other != agent or itself:
                        score = dot(query, agents[graph * n_agents + other, 1, head])
                        weights[other] = scale * (score + slope[row, head] * near[row, other])
                        peak = max(peak, weights[other])
                for edge in edges:
                    score = dot(query, bins[source[edge], 0, head])
                    of_bins[edge, head] = scale * (score + slope[row, head] * far[edge])
                    peak = max(peak, of_bins[edge, head])
                total = out.dtype.type(0.0)
                for other in range(low, high):
                    if other != agent or itself:
                        weights[other] = math.exp(weights[other] - peak)
                        total += weights[other]
                for edge in edges:
                    of_bins[edge, head] = math.exp(of_bins[edge, head] - peak)
                    total += of_bins[edge, head]
                new, distance = out[row, head], out.dtype.type(0.0)
                new[:] = 0.0
                for other in range(low, high):
                    if other != agent or itself:
                        weights[other] /= total
                        add_scaled(weights[other], agents[graph * n_agents + other, 2, head], new)
                        distance += weights[other] * near[row, other]
                for edge in edges:
                    of_bins[edge, head] /= total
                    add_scaled(of_bins[edge, head], bins[source[edge], 1, head], new)
                    distance += of_bins[edge, head] * far[edge]
                pooled[row, head] = distance


@njit(parallel=True, error_model="numpy", fastmath=FAST)
def differentiate(agents, bins, slope, near, far, first, source, sizes, of_agents, of_bins, results, gradients):
    """Write the gradients of ``gather``'s first five arguments from those of ``out`` and ``pooled``.

    Args:
        agents: with the seven after it, and the weights ``of_agents`` and ``of_bins``, as ``gather`` has them.
        results: gradients of ``out`` and ``pooled``.
        gradients: what is written, in the order and the shapes of the first five arguments; must hold zeros.
    """
    n_agents, reach, itself = sizes
    of_out, of_pooled = results
    d_agents, d_bins, d_slope, d_near, d_far = gradients
    n_heads, n_channels = of_out.shape[1:]
    scale = of_out.dtype.type(1.0 / math.sqrt(n_channels))
    for graph in numba.prange(of_out.shape[0] // n_agents):
        for agent in range(n_agents):
            row = graph * n_agents + agent
            low, high = max(agent - reach, 0), min(agent + reach + 1, n_agents)
            edges = range(first[row], first[row + 1])
            for head in range(n_heads):
                new, by_distance = of_out[row, head], of_pooled[row, head]
                mean = of_out.dtype.type(0.0)  # of the weights' gradients
                for other in range(low, high):
                    if other != agent or itself:
                        value = agents[graph * n_agents + other, 2, head]
                        mean += of_agents[row, head, other] * (dot(new, value) + by_distance * near[row, other])
                for edge in edges:
                    value = bins[source[edge], 1, head]
                    mean += of_bins[edge, head] * (dot(new, value) + by_distance * far[edge])
                query, d_query = agents[row, 0, head], d_agents[row, 0, head]
                along = of_out.dtype.type(0.0)
                for other in range(low, high):
                    if other != agent or itself:
                        index, weight = graph * n_agents + other, of_agents[row, head, other]
                        by_weight = dot(new, agents[index, 2, head]) + by_distance * near[row, other]
                        by_score = scale * weight * (by_weight - mean)
                        add_scaled(weight, new, d_agents[index, 2, head])
                        add_scaled(by_score, query, d_agents[index, 1, head])
                        add_scaled(by_score, agents[index, 1, head], d_query)
                        along += by_score * near[row, other]
                        d_near[row, other] += by_score * slope[row, head] + by_distance * weight
                for edge in edges:
                    index, weight = source[edge], of_bins[edge, head]
                    by_weight = dot(new, bins[index, 1, head]) + by_distance * far[edge]
                    by_score = scale * weight * (by_weight - mean)
                    add_scaled(weight, new, d_bins[index, 1, head])
                    add_scaled(by_score, query, d_bins[index, 0, head])
                    add_scaled(by_score, bins[index, 0, head], d_query)
                    along += by_score * far[edge]
                    d_far[edge] += by_score * slope[row, head] + by_distance * weight
                d_slope[row, head] += along


class DotProductAttention(torch.autograd.Function):
    """``apply(agents, bins, slope, near, far, first, source, sizes)``: ``out``, ``pooled`` and both weights.

    The arguments are those of ``gather``, ``first`` and ``source`` int64. The weights are for reading; no gradient
    flows through them.
    """

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Any:
        """Compute all four."""
        *tensors, sizes = arguments
        tensors = [tensor.detach().contiguous() for tensor in tensors]
        agents, far = tensors[0], tensors[4]
        n_heads = agents.shape[2]
        of_agents = agents.new_zeros(len(agents), n_heads, sizes[0])
        of_bins, out = agents.new_empty(len(far), n_heads), torch.empty_like(agents[:, 0])
        pooled = agents.new_empty(len(agents), n_heads)
        gather(*arrays(tensors), sizes, *arrays([of_agents, of_bins, out, pooled]))
        ctx.save_for_backward(*tensors, of_agents, of_bins)
        ctx.sizes = sizes
        ctx.mark_non_differentiable(of_agents, of_bins)
        return out, pooled, of_agents, of_bins

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        """The gradients with respect to the first five arguments."""
        *tensors, of_agents, of_bins = ctx.saved_tensors
        results = tuple(arrays([gradient.contiguous() for gradient in gradients[:2]]))
        found = [torch.zeros_like(tensor) for tensor in tensors[:5]]
        differentiate(*arrays(tensors), ctx.sizes, *arrays([of_agents, of_bins]), results, tuple(arrays(found)))
        return *found, None, None, None
