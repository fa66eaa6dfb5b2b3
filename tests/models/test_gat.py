import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from observations import SEEDS, randomise

from softgm_bench.models import graph
from softgm_bench.models.attention import chain_attention
from softgm_bench.models.gat import GraphAttention, edge_softmax

BOTH = pytest.mark.parametrize("gatv2", [False, True])


def random_case(gatv2, seed, n_nodes=7, dtype=torch.float64):
    """A layer with random parameters, nodes, and an adjacency with self-loops."""
    torch.manual_seed(seed)
    layer = randomise(GraphAttention(5, 6, 2, gatv2)).to(dtype)
    adjacency = (torch.rand(3, n_nodes, n_nodes) < 0.4) | torch.eye(n_nodes, dtype=torch.bool)
    return layer, torch.randn(3, n_nodes, 5, dtype=dtype), adjacency


def test_a_layer_computed_by_hand():
    layer = GraphAttention(2, 2, 1, gatv2=False)
    with torch.no_grad():
        layer.weight.copy_(torch.eye(2))
        layer.target.copy_(torch.tensor([[1.0, 0.0]]))
        layer.source.copy_(torch.tensor([[0.0, 1.0]]))
        layer.bias.copy_(torch.tensor([10.0, 20.0]))
    nodes = torch.tensor([[1.0, 0.0], [0.0, 2.0], [-4.0, 0.0]])
    adjacency = torch.eye(3, dtype=torch.bool)
    adjacency[0, 1] = adjacency[2, 1] = True
    out, attention = layer(nodes, adjacency)
    # Node 0: scores 1 + 0 (itself) and 1 + 2: softmax 1 / (1 + e^2) = 0.119203 and 0.880797.
    torch.testing.assert_close(attention[0, 0], torch.tensor([0.119203, 0.880797, 0.0]))
    torch.testing.assert_close(out[0], torch.tensor([10 + 0.119203, 20 + 1.761594]))
    # Node 1 hears itself.
    torch.testing.assert_close(out[1], torch.tensor([10.0, 22.0]))
    # Node 2: scores -4 and -4 + 2, after LeakyReLU(0.2) -0.8 and -0.4: weights 0.401312 and 0.598688.
    torch.testing.assert_close(attention[0, 2], torch.tensor([0.0, 0.598688, 0.401312]))
    torch.testing.assert_close(out[2], torch.tensor([10 - 1.605248, 20 + 1.197375]))


@BOTH
@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_attention_sums_to_one_over_permitted_edges_and_is_zero_elsewhere(gatv2, seed):
    layer, nodes, adjacency = random_case(gatv2, seed)
    _, attention = layer(nodes, adjacency)
    torch.testing.assert_close(attention.sum(-1), torch.ones(3, 2, 7, dtype=torch.float64))
    assert ((attention > 0) == adjacency.unsqueeze(-3)).all()


@BOTH
@settings(max_examples=20, deadline=None)
@given(seed=SEEDS)
def test_relabelling_nodes_relabels_the_result(gatv2, seed):
    layer, nodes, adjacency = random_case(gatv2, seed)
    order = torch.randperm(7)
    out, _ = layer(nodes, adjacency)
    relabelled, _ = layer(nodes[:, order], adjacency[:, order][:, :, order])
    torch.testing.assert_close(relabelled, out[:, order])


@BOTH
@settings(max_examples=20, deadline=None)
@given(seed=SEEDS, n_edges=st.integers(0, 12), compiles=st.booleans())
def test_edge_list_equals_dense(gatv2, seed, n_edges, compiles):
    n_agents, n_entities = 4, 3
    layer, nodes, _ = random_case(gatv2, seed)
    agents, entities = nodes[0, :n_agents], nodes[0, n_agents:]
    pairs = torch.randperm(n_agents * n_entities)[:n_edges].sort().values
    target, source = pairs // n_entities, pairs % n_entities
    adjacency = torch.eye(7, dtype=torch.bool)
    adjacency[target, n_agents + source] = True
    expected, attention = layer(nodes[0], adjacency)

    own = layer.project(agents, layer.joint_weight())
    edges = graph.Sensed(entities, source, target, source, torch.searchsorted(target, torch.arange(n_agents + 1)))
    layer._compiles = lambda _: compiles and not gatv2
    out, own_weights, edge_weights = layer.edges_to_agent(own, entities, (layer.weight, None), edges, n_agents)
    torch.testing.assert_close(out, expected[:n_agents], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(own_weights.mT, attention.diagonal(dim1=-2, dim2=-1)[:, :n_agents])
    torch.testing.assert_close(edge_weights.mT, attention[:, target, n_agents + source])


@BOTH
@pytest.mark.parametrize("n_agents", [1, 2, 6])
def test_chain_equals_dense(gatv2, n_agents):
    layer, nodes, _ = random_case(gatv2, seed=1, n_nodes=n_agents)
    adjacency = graph.chain_adjacency(n_agents) | torch.eye(n_agents, dtype=torch.bool)
    expected, attention = layer(nodes, adjacency)
    projection = layer.project(nodes.flatten(0, 1), layer.joint_weight())
    out, weights = layer.chain(projection, n_agents)
    torch.testing.assert_close(out, expected.flatten(0, 1), rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(chain_attention(weights), attention, rtol=1e-12, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(SEEDS, st.sampled_from([1.0, 30.0, 1e4]))
def test_edge_softmax_equals_softmax_at_any_scale(seed, scale):
    torch.manual_seed(seed)
    own, incoming = scale * torch.randn(4, 2, dtype=torch.float64), scale * torch.randn(9, 2, dtype=torch.float64)
    target = torch.randint(4, (9,)).sort().values
    own_weights, edge_weights = edge_softmax(own, incoming, target)
    for row in range(4):
        mine = target == row
        expected = torch.cat([own[row : row + 1], incoming[mine]]).softmax(0)
        torch.testing.assert_close(torch.cat([own_weights[row : row + 1], edge_weights[mine]]), expected)


def test_edge_softmax_has_the_gradient_of_softmax():
    own = torch.randn(3, 2, dtype=torch.float64, requires_grad=True)
    incoming = torch.randn(5, 2, dtype=torch.float64, requires_grad=True)
    target = torch.tensor([0, 0, 1, 1, 1])
    assert torch.autograd.gradcheck(lambda a, b: edge_softmax(a, b, target), (own, incoming))


def test_heads_must_divide_the_width():
    with pytest.raises(ValueError, match="not a multiple"):
        GraphAttention(4, 6, 4, gatv2=False)


@BOTH
def test_layer_equals_torch_geometric(gatv2):
    geometric = pytest.importorskip("torch_geometric.nn")
    layer, nodes, adjacency = random_case(gatv2, seed=3)
    convolution = (geometric.GATv2Conv if gatv2 else geometric.GATConv)(5, 3, heads=2, add_self_loops=False).double()
    with torch.no_grad():
        if gatv2:  # lin_l transforms sources, lin_r targets
            convolution.lin_l.weight.copy_(layer.weight)
            convolution.lin_r.weight.copy_(layer.target)
            convolution.lin_l.bias.zero_()
            convolution.lin_r.bias.zero_()
            convolution.att.copy_(layer.source.unsqueeze(0))
        else:
            convolution.lin.weight.copy_(layer.weight)
            convolution.att_src.copy_(layer.source.unsqueeze(0))
            convolution.att_dst.copy_(layer.target.unsqueeze(0))
        convolution.bias.copy_(layer.bias)
    for one, permitted in zip(nodes, adjacency, strict=True):
        target, source = permitted.nonzero(as_tuple=True)
        expected = convolution(one, torch.stack([source, target]))
        torch.testing.assert_close(layer(one, permitted)[0], expected, rtol=1e-12, atol=1e-12)
