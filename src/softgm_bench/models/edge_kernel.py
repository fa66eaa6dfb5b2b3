"""Graph attention from obstacle nodes to agents that sense them, forward and backward, in compiled loops for the CPU.

An obstacle node's message is linear in its features, so the weighted sum may be taken of the features, and the message
made of the sum: a matrix product for each agent and head instead of one for each node, of which there are several times
as many. As tensor operations that sum would be a pass over all edges for each head; here an agent's few edges are
worked through while their nodes lie in the cache. A node is sensed in its own environment alone, so environments may
be worked on in parallel. ``GraphAttention.edges_to_agent`` says what is computed; T agents are those of all
environments, K nodes those that some agent senses, E edges go from nodes to agents, H heads share F features.
"""

import math
from typing import Any

import numba
import torch
from torch import Tensor
from torch.nn import functional

from softgm_bench.models.chain_kernel import FAST, add_scaled, arrays, dot
from softgm_bench.rod.compiling import njit


@njit(parallel=True, error_model="numpy", fastmath=FAST)
def mix(nodes, sources, targets, own, first, source, n_agents, slope, own_weights, weights, mixed):
    """Write the weights of every agent's self-loop and edges, and the weighted sums of nodes.

    Args:
        nodes: features, ``(K, F)``.
        sources: their part of a score, ``(K, H)``.
        targets: the agents' part of it, ``(T, H)``.
        own: scores of self-loops before the leaky ReLU, ``(T, H)``.
        first: the first edge of each agent, and E, ``(T + 1,)``.
        source: the node of each edge, ``(E,)``.
        n_agents: N, agents of an environment.
        slope: of the leaky ReLU below zero.
        own_weights: of self-loops, ``(T, H)``.
        weights: of edges, ``(E, H)``.
        mixed: weighted sums, without the self-loop, ``(H, T, F)``: each head multiplies its own by a matrix of its own.
    """
    n_heads = own.shape[1]
    for graph in numba.prange(own.shape[0] // n_agents):
        for row in range(graph * n_agents, (graph + 1) * n_agents):
            for head in range(n_heads):
                peak = _leaky(own[row, head], slope)
                own_weights[row, head] = peak
                for edge in range(first[row], first[row + 1]):
                    weights[edge, head] = _leaky(targets[row, head] + sources[source[edge], head], slope)
                    peak = max(peak, weights[edge, head])
                own_weights[row, head] = math.exp(own_weights[row, head] - peak)
                total = own_weights[row, head]
                for edge in range(first[row], first[row + 1]):
                    weights[edge, head] = math.exp(weights[edge, head] - peak)
                    total += weights[edge, head]
                own_weights[row, head] /= total
                mixed[head, row, :] = 0.0
                for edge in range(first[row], first[row + 1]):
                    weights[edge, head] /= total
                    add_scaled(weights[edge, head], nodes[source[edge]], mixed[head, row])


@njit(parallel=True, error_model="numpy", fastmath=FAST)
def differentiate(inputs, rows, first, source, n_agents, slope, own_weights, weights, results, gradients):
    """Write the gradients of ``mix``'s first four arguments from those of ``own_weights`` and ``mixed``.

    Args:
        inputs: those arguments.
        rows: what makes ``sources`` of nodes, ``(H, F)``: a node's gradient is that by both ways.
        first: with the five after it and the weights, as ``mix`` has them.
        source: the node of each edge.
        n_agents: N.
        slope: of the leaky ReLU below zero.
        own_weights: of self-loops.
        weights: of edges.
        results: gradients of ``own_weights`` and ``mixed``.
        gradients: what is written, in the order and the shapes of the inputs; every node must have an edge.
    """
    nodes, sources, targets, own = inputs
    of_own_weights, of_mixed = results
    d_nodes, d_sources, d_targets, d_own = gradients
    n_heads = own.shape[1]
    for graph in numba.prange(own.shape[0] // n_agents):
        agents = range(graph * n_agents, (graph + 1) * n_agents)
        for edge in range(first[agents.start], first[agents.stop]):
            d_nodes[source[edge]] = 0.0
            d_sources[source[edge]] = 0.0
        for row in agents:
            for head in range(n_heads):
                new = of_mixed[head, row]
                mean = own_weights[row, head] * of_own_weights[row, head]  # of the weights' gradients
                for edge in range(first[row], first[row + 1]):
                    mean += weights[edge, head] * dot(new, nodes[source[edge]])
                of_score = own_weights[row, head] * (of_own_weights[row, head] - mean)
                d_own[row, head] = of_score * _steepness(own[row, head], slope)
                d_targets[row, head] = 0.0
                for edge in range(first[row], first[row + 1]):
                    node, weight = source[edge], weights[edge, head]
                    of_score = weight * (dot(new, nodes[node]) - mean)
                    of_score *= _steepness(targets[row, head] + sources[node, head], slope)
                    d_targets[row, head] += of_score
                    d_sources[node, head] += of_score
                    add_scaled(weight, new, d_nodes[node])
                    add_scaled(of_score, rows[head], d_nodes[node])


@numba.njit(inline="always", error_model="numpy", fastmath=FAST)
def _leaky(value, slope):
    return value if value >= 0.0 else slope * value


@numba.njit(inline="always", error_model="numpy", fastmath=FAST)
def _steepness(value, slope):
    return slope if value <= 0.0 else 1.0


class EdgeAttention(torch.autograd.Function):
    """``apply(nodes, rows, offset, targets, own, first, source, N, slope)``: own weights, mixed, weights of edges.

    ``rows`` ``(H, F)`` and ``offset`` ``(H,)``, or None, give ``mix``'s ``sources``; the other arguments are those of
    ``mix``, ``first`` and ``source`` int64. The weights of edges are for reading; no gradient flows through them.
    """

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> Any:
        """Compute all three."""
        nodes, rows, offset, *others, n_agents, slope = arguments
        nodes, rows, targets, own, first, source = (one.detach().contiguous() for one in (nodes, rows, *others))
        sources = functional.linear(nodes, rows, offset)
        slope = own.numpy().dtype.type(slope)
        own_weights, weights = torch.empty_like(own), own.new_empty(len(source), own.shape[1])
        mixed = own.new_empty(own.shape[1], own.shape[0], nodes.shape[1])
        inputs = arrays((nodes, sources, targets, own, first, source))
        mix(*inputs, n_agents, slope, *arrays((own_weights, weights, mixed)))
        ctx.save_for_backward(nodes, sources, targets, own, rows, first, source, own_weights, weights)
        ctx.n_agents, ctx.slope, ctx.has_offset = n_agents, slope, offset is not None
        ctx.mark_non_differentiable(weights)
        return own_weights, mixed, weights

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        """The gradients with respect to the first five arguments."""
        tensors = ctx.saved_tensors
        *inputs, rows, first, source, own_weights, weights = arrays(tensors)
        results = tuple(arrays(gradient.contiguous() for gradient in gradients[:2]))
        found = [torch.empty_like(tensor) for tensor in tensors[:4]]
        edges = (rows, first, source, ctx.n_agents, ctx.slope)
        differentiate(tuple(inputs), *edges, own_weights, weights, results, tuple(arrays(found)))
        of_nodes, of_sources, *others = found
        of_offset = of_sources.sum(0) if ctx.has_offset else None
        return of_nodes, of_sources.mT @ tensors[0], of_offset, *others, None, None, None, None
