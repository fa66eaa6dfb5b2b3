import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rounding import assert_equal_to_rounding

from softgm_bench.models import chain_kernel
from softgm_bench.models.chain_kernel import ChainAttention
from softgm_bench.models.gat import NEGATIVE_SLOPE, GraphAttention

HEADS, CHANNELS = 2, 3


def values(graphs, n_agents, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    return torch.randn(graphs * n_agents, HEADS * CHANNELS + 2 * HEADS, dtype=dtype, generator=generator)


@pytest.mark.parametrize("n_agents", [1, 2, 5])
def test_its_gradient_is_right(n_agents):
    of_new_agents = lambda x: ChainAttention.apply(x, n_agents, HEADS, NEGATIVE_SLOPE)[0]  # noqa: E731
    assert torch.autograd.gradcheck(of_new_agents, values(3, n_agents).requires_grad_())


@settings(max_examples=40, deadline=None)
@given(st.integers(1, 9), st.integers(1, 8), st.integers(0, 2**31), st.sampled_from([torch.float32, torch.float64]))
def test_it_equals_the_tensor_operations_forward_and_backward(graphs, n_agents, seed, dtype):
    layer = GraphAttention(4, HEADS * CHANNELS, HEADS, gatv2=False).to(dtype)
    nodes = torch.randn(graphs * n_agents, 4, dtype=dtype, generator=torch.Generator().manual_seed(seed))
    results = []
    for compiles in (True, False):
        layer._compiles = lambda _, compiles=compiles: compiles
        layer.zero_grad()
        inputs = nodes.clone().requires_grad_()
        out, weights = layer.chain(layer.project(inputs, layer.joint_weight()), n_agents)
        (out * torch.arange(1.0, 1.0 + out.shape[1], dtype=dtype)).square().sum().backward()
        results.append([out, weights, inputs.grad, *(parameter.grad.clone() for parameter in layer.parameters())])
    assert_equal_to_rounding(*results)


def test_the_layer_takes_the_kernel_on_a_cpu_and_only_for_the_papers_scores(monkeypatch):
    calls = []
    kernel = chain_kernel.aggregate
    monkeypatch.setattr(chain_kernel, "aggregate", lambda *arguments: calls.append(1) or kernel(*arguments))
    for gatv2, expected in ((False, 1), (True, 1)):
        layer = GraphAttention(4, 6, 2, gatv2)
        layer.chain(layer.project(torch.randn(6, 4), layer.joint_weight()), 3)
        assert len(calls) == expected
