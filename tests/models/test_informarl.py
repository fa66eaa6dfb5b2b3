import pytest
import torch
from hypothesis import given, settings
from observations import COUNTS, SEEDS, SIZES, informarl_config, observation, randomise
from torch.nn import functional

from softgm_bench.config import compose
from softgm_bench.envs import entries
from softgm_bench.models import graph
from softgm_bench.models.heads import TeamValue, build_value
from softgm_bench.models.informarl import InforMARLEncoder


def copied(layer):
    """torch_geometric's convolution with a layer's weights."""
    geometric = pytest.importorskip("torch_geometric.nn")
    heads, channels = layer.shape
    features = heads * channels
    convolution = geometric.TransformerConv(features, channels, heads=heads, edge_dim=1).double()
    with torch.no_grad():
        parts = (convolution.lin_query, convolution.lin_key, convolution.lin_value)
        for part, weight, bias in zip(
            parts, layer.attention.weight.chunk(3), layer.attention.bias.chunk(3), strict=True
        ):
            part.weight.copy_(weight)
            part.bias.copy_(bias)
        convolution.lin_skip.weight.copy_(layer.root.weight)
        convolution.lin_skip.bias.copy_(layer.root.bias)
        convolution.lin_edge.weight.copy_(layer.edge.reshape(features, 1))
    return convolution


def reference(model, td):
    """One environment at a time: torch_geometric's convolutions over all agents and all discovered bins."""
    embeddings = []
    for one in td:
        active = one[entries.SLOT_ACTIVE]
        agents, bins = graph.agent_channels(one), graph.slot_channels(one)[active]
        n_agents = len(agents)
        types = torch.tensor([graph.AGENT] * n_agents + [graph.OBSTACLE] * len(bins))
        nodes = torch.cat([torch.cat([agents, bins]), model.types(types)], dim=-1)
        for linear, norm in zip(model.embedding, model.norms, strict=True):
            nodes = norm(functional.relu(linear(nodes)))
        edges = [(i, j) for i in range(n_agents) for j in range(n_agents) if abs(i - j) == 1]
        rank = active.cumsum(0) - 1
        edges += [(n_agents + int(rank[slot]), agent) for agent, slot in one[entries.EDGE].nonzero().tolist()]
        index = torch.tensor(edges, dtype=torch.long).reshape(-1, 2).T
        place = torch.cat([agents, bins])[:, :3]
        length = (place[index[0]] - place[index[1]]).norm(dim=-1, keepdim=True)
        for layer in model.convolutions:
            nodes = functional.relu(copied(layer)(nodes, index, length))
        embeddings.append(nodes[:n_agents])
    return torch.stack(embeddings)


@settings(max_examples=10, deadline=None)
@given(COUNTS, SEEDS)
def test_it_is_torch_geometrics_transformer_convolution_over_the_graph(sizes, seed):
    torch.manual_seed(seed)
    model = randomise(InforMARLEncoder(informarl_config(), SIZES)).double()
    td = observation((3,), *sizes, seed=seed, dtype=torch.float64)
    expected = reference(model, td)
    torch.testing.assert_close(model(td), expected, rtol=1e-10, atol=1e-10)


def test_its_gradients_are_those_of_torch_geometrics():
    torch.manual_seed(0)
    model = InforMARLEncoder(informarl_config(), SIZES).double()
    td = observation((3,), dtype=torch.float64)
    outside = [*model.types.parameters(), *model.embedding.parameters(), *model.norms.parameters()]
    ours = torch.autograd.grad(model(td).square().sum(), outside)
    theirs = torch.autograd.grad(reference(model, td).square().sum(), outside)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)


def test_the_papers_critic_reads_the_mean_over_agents():
    config = compose(["algo=softgm", "model=informarl", "recipe=paper", "task=wall"])
    critic = build_value(config.model, SIZES, config.algo.critic)
    td = observation((3,))
    assert isinstance(critic, TeamValue)
    assert isinstance(critic.encoder, InforMARLEncoder)
    pooled = critic.encoder(td).mean(dim=-2)
    torch.testing.assert_close(critic(td)["state_value"], critic.function(pooled))


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"heads": 3}, "model.hidden is 8: it must be a multiple of model.heads, 3"), ({"layers": 0}, "at least 1")],
)
def test_settings_that_give_no_network_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        informarl_config(**changes)
