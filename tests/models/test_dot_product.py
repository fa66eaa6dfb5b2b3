import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from observations import COUNTS, LEADS, SEEDS, observation
from torch.nn import functional

from dense import force_dense
from softgm_bench.envs import entries
from softgm_bench.models import dot_product, graph

HEADS, CHANNELS = 2, 3
HEARD = pytest.mark.parametrize(("reach", "itself"), [(1, False), (1, True), (2, True), (None, True)])


def case(td, reach, itself, discovered=False, seed=0):
    """Who hears what, at what distance, and random projections of agents and bins, which depend on the node alone."""
    generator = torch.Generator().manual_seed(seed)
    dtype = td[entries.TIP].dtype
    hearing = dot_product.listen(td, reach, itself, discovered)
    nodes = graph.agent_channels(td).flatten(0, -2)
    of_agents = torch.randn(graph.CHANNELS, 3 * HEADS * CHANNELS, generator=generator, dtype=dtype)
    of_bins = torch.randn(graph.CHANNELS, 2 * HEADS * CHANNELS, generator=generator, dtype=dtype)
    slope = torch.randn(graph.CHANNELS, HEADS, generator=generator, dtype=dtype)
    agents = (0.3 * nodes @ of_agents).unflatten(-1, (3, HEADS, CHANNELS))
    bins = (0.3 * hearing.bins @ of_bins).unflatten(-1, (2, HEADS, CHANNELS))
    return agents, bins, hearing, dot_product.distances(hearing, nodes[:, :3]), nodes @ slope


def permitted(td, reach, itself, discovered=False):
    """Of every agent and every node, whether it is heard: bool ``(B, N, N + M)``."""
    heard = graph.heard_slots(td, discovered)
    n_agents, n_slots = heard.shape[-2:]
    apart = (torch.arange(n_agents) - torch.arange(n_agents).unsqueeze(1)).abs()
    near = (apart <= (n_agents if reach is None else reach)) & ((apart > 0) | itself)
    heard = heard.reshape(-1, n_agents, n_slots)
    return torch.cat([near.expand(len(heard), n_agents, n_agents), heard], dim=-1)


@HEARD
@pytest.mark.parametrize("discovered", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_it_is_torchs_attention_with_a_mask(reach, itself, discovered, masked):
    td = observation((3,), 4, 6, dtype=torch.float64)
    if masked:
        with force_dense():
            agents, bins, hearing, _, _ = case(td, reach, itself, discovered)
    else:
        agents, bins, hearing, _, _ = case(td, reach, itself, discovered)
    heard = dot_product.attend(agents, bins, hearing)
    with force_dense():  # of all slots
        _, slots, _, _, _ = case(td, reach, itself, discovered)
    query, key, value = agents.unflatten(0, (3, 4)).unbind(2)
    key, value = (
        torch.cat([one, other], dim=1)
        for one, other in zip((key, value), slots.unflatten(0, (3, 6)).unbind(2), strict=True)
    )
    mask = permitted(td, reach, itself, discovered).unsqueeze(1)
    query, key, value = (part.transpose(1, 2) for part in (query, key, value))
    expected = functional.scaled_dot_product_attention(query, key, value, attn_mask=mask)
    torch.testing.assert_close(heard.values, expected.transpose(1, 2).flatten(0, 1), rtol=1e-12, atol=1e-12)
    weights = dot_product.weights(heard, hearing)
    assert weights.shape == (3, HEADS, 4, 10)
    assert torch.equal(weights > 0, mask.expand_as(weights))
    torch.testing.assert_close(weights @ value, expected, rtol=1e-12, atol=1e-12)


@settings(max_examples=40, deadline=None)
@given(LEADS, COUNTS, SEEDS, st.sampled_from([1, 2, None]), st.booleans(), st.booleans())
def test_compiled_loops_equal_masked_tensors_forward_and_backward(lead, sizes, seed, reach, itself, far):
    td = observation(lead, *sizes, seed=seed, dtype=torch.float64)
    td = td.apply(lambda value: value.requires_grad_() if value.is_floating_point() else value)
    read = [td[key] for key in (entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.SLOT_DESCRIPTOR)]

    def results():
        agents, bins, hearing, distances, slope = case(td, reach, itself, seed=seed)
        heard = dot_product.attend(agents, bins, hearing, *((distances, slope) if far else ()))
        loss = heard.values.square().sum() + heard.distances.sin().sum()
        gradients = torch.autograd.grad(loss, read, allow_unused=True)
        found = [torch.zeros_like(one) if of is None else of for one, of in zip(read, gradients, strict=True)]
        return heard.values, heard.distances, dot_product.weights(heard, hearing), *found

    compiled = results()
    with force_dense():
        plain = results()
    for one, other in zip(compiled, plain, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-10)


@pytest.mark.parametrize("masked", [False, True])
def test_who_hears_nothing_gets_nothing_and_a_finite_gradient(masked):
    td = observation((3,), 1, 4, sensed=0.0)
    position = td[entries.AGENT_POSITION].requires_grad_()
    if masked:
        with force_dense():
            arguments = case(td, 1, itself=False)
    else:
        arguments = case(td, 1, itself=False)
    heard = dot_product.attend(*arguments)
    assert not heard.values.any()
    assert not heard.distances.any()
    heard.values.sum().backward()
    assert position.grad.isfinite().all()


def test_scores_of_any_size_give_weights_that_sum_to_one():
    td = observation((3,), 4, 6)
    for scale in (1.0, 1e2, 1e4):
        agents, bins, hearing, _, _ = case(td, 1, itself=True)
        heard = dot_product.attend(scale * agents, scale * bins, hearing)
        total = dot_product.weights(heard, hearing).sum(-1)
        torch.testing.assert_close(total, torch.ones_like(total))
        assert heard.values.isfinite().all()


def test_distances_are_those_from_an_agent_to_what_it_hears():
    td = observation((2,), 3, 5, sensed=0.6, discovered=1.0, dtype=torch.float64)
    position = td[entries.AGENT_POSITION].flatten(0, 1)
    hearing = dot_product.listen(td, 1, itself=False, discovered=False)
    far = dot_product.distances(hearing, position)
    with force_dense():
        every = dot_product.listen(td, 1, itself=False, discovered=False)
        of_slots = dot_product.distances(every, position)
    assert torch.equal(far.agents, of_slots.agents)
    for row, (environment, agent) in enumerate((e, a) for e in range(2) for a in range(3)):
        here = td[entries.AGENT_POSITION][environment, agent]
        for other in range(3):
            there = td[entries.AGENT_POSITION][environment, other]
            assert math.isclose(far.agents[row, other], math.dist(here, there), abs_tol=1e-12)
        for slot in range(5):
            centre = td[entries.SLOT_DESCRIPTOR][environment, slot, :3]
            assert math.isclose(of_slots.bins[environment, agent, slot], math.dist(here, centre), abs_tol=1e-12)
    edges = hearing.heard
    torch.testing.assert_close(far.bins, of_slots.bins[edges.target // 3, edges.target % 3, edges.slot])
