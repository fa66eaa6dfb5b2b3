import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import assert_equal_to_rounding

from softgm_bench.models import edge_kernel, graph
from softgm_bench.models.edge_kernel import EdgeAttention
from softgm_bench.models.gat import NEGATIVE_SLOPE, GraphAttention

HEADS, CHANNELS, FEATURES = 2, 3, 5


def random_edges(graphs, n_agents, n_nodes, generator):
    """Edges from ``n_nodes`` nodes of each environment to its agents, about half of all; the nodes that have one."""
    drawn = torch.rand(graphs, n_agents, n_nodes, generator=generator) < 0.5
    environment, agent, node = drawn.nonzero().unbind(1)
    target = environment * n_agents + agent
    first = torch.searchsorted(target, torch.arange(graphs * n_agents + 1))
    used, source = (environment * n_nodes + node).unique(return_inverse=True)
    return used, source, target, node, first


@pytest.mark.parametrize(("n_agents", "n_nodes"), [(1, 4), (3, 2), (3, 1)])
def test_its_gradient_is_right(n_agents, n_nodes):
    generator = torch.Generator().manual_seed(0)
    used, source, _, _, first = random_edges(2, n_agents, n_nodes, generator)
    agents, nodes = (2 * n_agents, HEADS), len(used)
    inputs = [
        torch.randn(shape, dtype=torch.float64, generator=generator).requires_grad_()
        for shape in ((nodes, FEATURES), (HEADS, FEATURES), (HEADS,), agents, agents)
    ]
    heard = lambda *arguments: EdgeAttention.apply(*arguments, first, source, n_agents, NEGATIVE_SLOPE)[:2]  # noqa: E731
    assert torch.autograd.gradcheck(heard, inputs)


@settings(max_examples=40, deadline=None)
@given(
    st.integers(1, 5),
    st.integers(1, 4),
    st.integers(1, 6),
    st.booleans(),
    st.integers(0, 2**31),
    st.sampled_from([torch.float32, torch.float64]),
)
def test_it_equals_the_tensor_operations_forward_and_backward(graphs, n_agents, n_nodes, offset, seed, dtype):
    generator = torch.Generator().manual_seed(seed)
    layer = GraphAttention(FEATURES, HEADS * CHANNELS, HEADS, gatv2=False).to(dtype)
    used, *others = random_edges(graphs, n_agents, n_nodes, generator)
    edges = graph.Sensed(torch.empty(0), *others)
    shift = torch.randn(HEADS * CHANNELS, dtype=dtype, generator=generator) if offset else None
    agents = torch.randn(graphs * n_agents, FEATURES, dtype=dtype, generator=generator)
    nodes = torch.randn(len(used), FEATURES, dtype=dtype, generator=generator)
    results = []
    for compiles in (True, False):
        layer._compiles = lambda _, compiles=compiles: compiles
        layer.zero_grad()
        inputs = [tensor.clone().requires_grad_() for tensor in (agents, nodes)]
        own = layer.project_agents(inputs[0], None)
        out, own_weights, weights = layer.edges_to_agent(own, inputs[1], (layer.weight, shift), edges, n_agents)
        (out * torch.arange(1.0, 1.0 + out.shape[1], dtype=dtype)).square().sum().backward()
        gradients = [torch.zeros_like(nodes) if one.grad is None else one.grad for one in inputs]
        results.append([out, own_weights, weights, *gradients, layer.weight.grad.clone()])
        if len(edges.source):
            results[-1].extend([layer.source.grad.clone(), layer.target.grad.clone()])
    assert_equal_to_rounding(*results)


def test_the_layer_takes_the_kernel_on_a_cpu_and_only_for_the_papers_scores(monkeypatch):
    calls = []
    kernel = edge_kernel.mix
    monkeypatch.setattr(edge_kernel, "mix", lambda *arguments: calls.append(1) or kernel(*arguments))
    used, *others = random_edges(2, 3, 8, torch.Generator().manual_seed(0))
    edges = graph.Sensed(torch.empty(0), *others)
    for gatv2, expected in ((False, 1), (True, 1)):
        layer = GraphAttention(4, 6, 2, gatv2)
        own = layer.project(torch.randn(6, 4), layer.joint_weight())
        layer.edges_to_agent(own, torch.randn(len(used), 4), (layer.weight, None), edges, 3)
        assert len(calls) == expected
