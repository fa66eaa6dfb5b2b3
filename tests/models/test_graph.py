import math

import torch
from hypothesis import given, settings
from observations import COUNTS, LEADS, SEEDS, observation
from tensordict import TensorDict

from softgm_bench.envs import entries
from softgm_bench.models import graph


def by_hand():
    """Two agents, three slots; slot 1 is active and agent 1 senses it."""
    td = TensorDict({}, batch_size=())
    td[entries.AGENT_POSITION] = torch.tensor([[1.0, 2, 3], [4, 5, 6]])
    td[entries.AGENT_VELOCITY] = torch.tensor([[0.1, 0.2, 0.3], [0.4, 0.5, 0.6]])
    td[entries.PREVIOUS_ACTION] = torch.tensor([[-0.5, 0.5], [0.25, -0.25]])
    td[entries.EDGE] = torch.tensor([[False, False, False], [False, True, False]])
    descriptor = torch.zeros(3, 9)
    descriptor[1] = torch.tensor([7.0, 8, 9, 0, 0, 1, 0.05, 1.2, 0.5])
    td[entries.SLOT_DESCRIPTOR] = descriptor
    td[entries.SLOT_ACTIVE] = torch.tensor([False, True, False])
    td[entries.TIP] = torch.tensor([10.0, 20, 30])
    td[entries.TARGET] = torch.tensor([100.0, 200, 300])
    return td


def test_agent_features_are_the_papers():
    position, velocity, action = [1.0, 2, 3], [0.1, 0.2, 0.3], [0, -0.5, 0.5]
    to_target, to_tip = [99.0, 198, 297], [9.0, 18, 27]
    expected = torch.tensor(position + velocity + action + to_target + to_tip + [0.0] * 7)
    features = graph.agent_features(by_hand())
    assert features.shape == (2, 22)
    torch.testing.assert_close(features[0], expected)


def test_obstacle_features_are_the_papers():
    centre, axis, radius_length_position = [7.0, 8, 9], [0.0, 0, 1], [0.05, 1.2, 0.5]
    to_target, to_tip = [93.0, 192, 291], [3.0, 12, 21]
    expected = torch.tensor(centre + axis + radius_length_position + to_target + to_tip + [0.0] * 7)
    features = graph.slot_features(by_hand())
    assert features.shape == (3, 22)
    torch.testing.assert_close(features[1], expected)
    assert not features[0].any()
    assert not features[2].any()


def test_adjacency_is_incoming_and_slots_hear_nobody():
    expected = torch.zeros(5, 5, dtype=torch.bool)
    expected[0, 1] = expected[1, 0] = True  # the chain
    expected[1, 3] = True  # agent 1 hears slot 1
    assert torch.equal(graph.full_adjacency(by_hand()), expected)
    assert graph.node_types(by_hand()).tolist() == [graph.AGENT, graph.AGENT, graph.PAD, graph.OBSTACLE, graph.PAD]


def test_chain_adjacency_joins_neighbours_both_ways():
    assert graph.chain_adjacency(1).tolist() == [[False]]
    assert graph.chain_adjacency(3).int().tolist() == [[0, 1, 0], [1, 0, 1], [0, 1, 0]]


def test_velocity_scale_changes_the_velocity_alone():
    plain, scaled = graph.agent_channels(by_hand()), graph.agent_channels(by_hand(), velocity_scale=0.5)
    torch.testing.assert_close(scaled[:, 3:6], 0.5 * plain[:, 3:6])
    assert torch.equal(scaled[:, [0, 1, 2, *range(6, 15)]], plain[:, [0, 1, 2, *range(6, 15)]])


@settings(max_examples=30, deadline=None)
@given(LEADS, COUNTS, SEEDS)
def test_pad_nodes_are_zero_whatever_their_descriptor(lead, sizes, seed):
    td = observation(lead, *sizes, seed=seed)
    inactive = ~td[entries.SLOT_ACTIVE].unsqueeze(-1)
    td[entries.SLOT_DESCRIPTOR] = torch.where(inactive, 3.0, td[entries.SLOT_DESCRIPTOR])
    features = graph.slot_features(td)
    assert features.shape == (*lead, sizes[1], 22)
    assert not (features * inactive).any()


@settings(max_examples=30, deadline=None)
@given(LEADS, COUNTS, SEEDS)
def test_flat_and_graph_views_carry_the_same_content(lead, sizes, seed):
    td = observation(lead, *sizes, seed=seed)
    n_agents, n_slots = sizes
    flat = graph.flat_observation(td)
    assert flat.shape == (*lead, n_agents, graph.flat_features(n_slots))
    own, slots, edges = flat.split([15, 15 * n_slots, n_slots], dim=-1)
    # The graph from the flat view ...
    assert torch.equal(graph.pad_channels(own), graph.agent_features(td))
    for agent in range(n_agents):
        rebuilt = slots[..., agent, :].unflatten(-1, (n_slots, 15)) if n_slots else slots[..., agent, :]
        assert torch.equal(rebuilt.reshape(*lead, n_slots, 15), graph.slot_features(td)[..., :15])
    assert torch.equal(edges.bool(), graph.full_adjacency(td)[..., :n_agents, n_agents:])
    # ... and the flat view from the graph.
    nodes = torch.cat([graph.agent_features(td), graph.slot_features(td)], dim=-2)[..., :15]
    shared = nodes[..., n_agents:, :].flatten(-2).unsqueeze(-2).expand(*lead, n_agents, 15 * n_slots)
    incoming = graph.full_adjacency(td)[..., :n_agents, n_agents:].float()
    assert torch.equal(torch.cat([nodes[..., :n_agents, :], shared, incoming], dim=-1), flat)


@settings(max_examples=30, deadline=None)
@given(LEADS, COUNTS, SEEDS)
def test_sense_gathers_every_edge_once_sorted_by_target(lead, sizes, seed):
    td = observation(lead, *sizes, seed=seed)
    n_agents, n_slots = sizes
    sensed = graph.sense(td)
    edge = td[entries.EDGE].reshape(math.prod(lead), n_agents, n_slots)
    rebuilt = torch.zeros_like(edge)
    rebuilt[sensed.target // n_agents, sensed.target % n_agents, sensed.slot] = True
    assert torch.equal(rebuilt, edge)
    assert len(sensed.target) == edge.sum()
    assert (sensed.target.diff() >= 0).all()
    assert torch.equal(sensed.first.diff(), edge.sum(-1).flatten())
    # One node for each sensed slot, with that slot's features.
    assert len(sensed.channels) == edge.any(dim=1).sum()
    features = graph.slot_channels(td).reshape(math.prod(lead), n_slots, 15)[sensed.target // n_agents, sensed.slot]
    assert torch.equal(sensed.channels[sensed.source], features)
