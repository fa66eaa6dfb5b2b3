import contextlib
import itertools

import pytest
import torch
from hypothesis import given, settings, strategies
from observations import (
    COUNTS,
    LEADS,
    SEEDS,
    SIZES,
    observation,
    randomise,
    relabelled,
    softgm_config,
    with_unsensed_slots_of,
)
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from dense import force_dense
from round_trips import RoundTrips
from softgm_bench.envs import entries
from softgm_bench.models import SoftGMEncoder, graph

SWITCHES = [
    {"stage1": stage1, "stage2": stage2, "gatv2": gatv2, "residual": residual}
    for stage1, stage2, gatv2, residual in itertools.product([True, False], repeat=4)
] + [{"remember": True, "gatv2": gatv2, "residual": residual} for gatv2, residual in ((False, True), (True, False))]


def encoder(dtype=torch.float32, seed=0, **changes):
    torch.manual_seed(seed)
    return randomise(SoftGMEncoder(softgm_config(**changes), SIZES)).to(dtype)


@pytest.mark.parametrize("switches", SWITCHES, ids=str)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
def test_sparse_equals_dense(switches, dtype, tolerance):
    torch.manual_seed(0)
    model = SoftGMEncoder(softgm_config(velocity_scale=0.5, hidden=128, heads=4, **switches), SIZES).to(dtype)
    td = observation((2, 5), 4, 6, dtype=dtype)
    sparse, weights = model.forward_with_attention(td)
    dense, expected = model.forward_dense(td)
    # four roundings of the largest entry, where that is more: some processors' sums need it in float32
    rounding = 4 * torch.finfo(dtype).eps * dense.abs().max().item()
    torch.testing.assert_close(sparse, dense, rtol=tolerance, atol=max(tolerance, rounding))
    assert weights.keys() == expected.keys()
    for stage in expected:
        torch.testing.assert_close(weights[stage], expected[stage], rtol=tolerance, atol=tolerance)
    assert torch.equal(model(td), sparse)


@settings(max_examples=30, deadline=None)
@given(LEADS, COUNTS, SEEDS)
def test_sparse_equals_dense_for_any_sizes(lead, sizes, seed):
    n_agents, n_slots = sizes
    model = encoder(torch.float64, seed)
    td = observation(lead, *sizes, seed=seed, dtype=torch.float64)
    sparse, weights = model.forward_with_attention(td)
    dense, expected = model.forward_dense(td)
    assert sparse.shape == (*lead, n_agents, 8)
    assert weights["stage1"].shape == (*lead, 2, 2, n_agents, n_agents + n_slots)
    assert weights["stage2"].shape == (*lead, 2, 2, n_agents, n_agents)
    torch.testing.assert_close(sparse, dense, rtol=1e-12, atol=1e-12)
    for stage in expected:
        torch.testing.assert_close(weights[stage], expected[stage], rtol=1e-12, atol=1e-12)
        torch.testing.assert_close(weights[stage].sum(-1), torch.ones_like(weights[stage][..., 0]))


@pytest.mark.parametrize("remember", [False, True])
@pytest.mark.parametrize("masked", [False, True])
def test_what_nobody_senses_any_more_is_heard_by_those_alone_that_remember(remember, masked):
    model = encoder(torch.float64, remember=remember)
    td = observation((3,), 4, 6, sensed=0.0, discovered=1.0, dtype=torch.float64)
    other = td.clone()
    other[entries.SLOT_DESCRIPTOR] = other[entries.SLOT_DESCRIPTOR].roll(1, 0)
    with force_dense() if masked else contextlib.nullcontext():
        changed = (model(td) - model(other)).abs().amax(dim=(0, 2))
        other[entries.SLOT_ACTIVE] = torch.zeros_like(other[entries.SLOT_ACTIVE])
        without = model(other) - model(other.clone().set(entries.SLOT_DESCRIPTOR, td[entries.SLOT_DESCRIPTOR]))
    assert (changed > 0).all() if remember else (changed == 0).all()
    assert not without.any()  # what was not discovered is heard by nobody


@pytest.mark.parametrize("used", [0, 3, 6])
def test_slots_that_are_empty_everywhere_are_left_out_where_all_are_remembered(used):
    model = encoder(torch.float64, remember=True)
    td = observation((5,), 4, 6, discovered=1.0, dtype=torch.float64)
    unused = torch.arange(6) >= used
    td[entries.EDGE] = td[entries.EDGE] & ~unused
    td[entries.SLOT_ACTIVE] = td[entries.SLOT_ACTIVE] & ~unused
    td[entries.SLOT_DESCRIPTOR] = td[entries.SLOT_DESCRIPTOR] * ~unused.unsqueeze(-1)
    assert graph.without_empty_slots(td)[entries.EDGE].shape == (5, 4, used)
    torch.testing.assert_close(model(td), model.forward_dense(td)[0], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("gatv2", [False, True])
def test_gradients_equal_those_of_the_dense_form(gatv2):
    model = encoder(torch.float64, gatv2=gatv2)
    td = observation((7,), 4, 6, dtype=torch.float64)
    parameters = list(model.parameters())
    sparse = torch.autograd.grad(model(td).square().sum(), parameters)
    dense = torch.autograd.grad(model.forward_dense(td)[0].square().sum(), parameters)
    for one, other in zip(sparse, dense, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-10, atol=1e-10)


@settings(max_examples=30, deadline=None)
@given(COUNTS, SEEDS)
def test_slots_without_an_edge_change_no_bit(sizes, seed):
    model = encoder(seed=seed)
    td = observation((5,), *sizes, seed=seed)
    other = observation((5,), *sizes, seed=seed + 1)
    changed = with_unsensed_slots_of(td, other)
    assert torch.equal(model(td), model(changed))


@settings(max_examples=30, deadline=None)
@given(COUNTS, SEEDS)
def test_relabelling_slots_changes_nothing(sizes, seed):
    model = encoder(torch.float64, seed)
    td = observation((5,), *sizes, seed=seed, dtype=torch.float64)
    other = relabelled(td, torch.randperm(sizes[1]))
    torch.testing.assert_close(model(td), model(other), rtol=1e-12, atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(COUNTS, SEEDS)
def test_a_batch_of_one_equals_a_batch_of_many(sizes, seed):
    model = encoder(torch.float64, seed)
    td = observation((2, 3), *sizes, seed=seed, dtype=torch.float64)
    together = model(td)
    for index in itertools.product(range(2), range(3)):
        torch.testing.assert_close(model(td[index]), together[index], rtol=1e-12, atol=1e-12)


def test_no_edge_at_all_equals_no_slots():
    model = encoder()
    empty, without = observation((3,), 4, 6, sensed=0.0), observation((3,), 4, 0, sensed=0.0)
    for key in (entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.PREVIOUS_ACTION, entries.TIP, entries.TARGET):
        without[key] = empty[key]
    assert torch.equal(model(empty), model(without))


def test_an_edge_matters_only_with_stage_one():
    td = observation((3,), 4, 6, sensed=1.0, discovered=1.0)
    blind = td.clone()
    blind[entries.EDGE] = torch.zeros_like(td[entries.EDGE])
    assert not torch.allclose(encoder()(td), encoder()(blind))
    assert torch.equal(encoder(stage1=False)(td), encoder(stage1=False)(blind))


@pytest.mark.parametrize(
    "entry", [entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.PREVIOUS_ACTION, entries.EDGE]
)
@pytest.mark.parametrize("moved", range(6))
def test_an_agent_reaches_as_many_neighbours_as_stage_two_has_layers(entry, moved):
    td = observation((3,), 6, 5, sensed=0.5, discovered=1.0)
    other = td.clone()
    other[entry][:, moved] = ~td[entry][:, moved] if entry == entries.EDGE else td[entry][:, moved] + 1
    for layers in (1, 2):
        model = encoder(torch.float64, layers=layers)
        changed = ((model(td.double()) - model(other.double())).abs() > 1e-13).any(dim=-1).any(dim=0)
        assert changed.tolist() == [abs(agent - moved) <= layers for agent in range(6)]


@settings(max_examples=30, deadline=None)
@given(strategies.integers(1, 5), strategies.integers(1, 4), strategies.sampled_from([1, 2]), SEEDS)
def test_agents_further_than_the_layers_reach_do_not_notice_that_the_chain_goes_on(n_agents, more, layers, seed):
    longer = observation((2,), n_agents + more, 4, seed=seed, dtype=torch.float64)
    shorter = longer.clone()
    shorter["agents"] = longer["agents"].apply(lambda value: value[:, :n_agents])
    model = encoder(torch.float64, layers=layers)
    deaf = max(n_agents - layers, 0)
    long, short = model(longer), model(shorter)
    torch.testing.assert_close(long[:, :deaf], short[:, :deaf], rtol=0.0, atol=1e-13)
    assert ((long[:, deaf:n_agents] - short[:, deaf:]).abs() > 1e-13).any(dim=-1).all()


@settings(max_examples=30, deadline=None)
@given(COUNTS, SEEDS)
def test_a_chain_that_is_counted_from_the_other_end_gives_the_same_embeddings_in_that_order(sizes, seed):
    td = observation((2,), *sizes, seed=seed, dtype=torch.float64)
    reversed_td = td.clone()
    reversed_td["agents"] = td["agents"].apply(lambda value: value.flip(1))
    model = encoder(torch.float64)
    torch.testing.assert_close(model(reversed_td).flip(1), model(td), rtol=0.0, atol=1e-12)


def test_without_stage_two_an_agent_hears_no_agent():
    td = observation((3,), 6, 5)
    other = td.clone()
    other[entries.AGENT_POSITION][:, 2] += 1
    model = encoder(stage2=False)
    same = (model(td) == model(other)).all(dim=-1).all(dim=0)
    assert same.tolist() == [True, True, False, True, True, True]


@pytest.mark.parametrize("entry", [entries.TIP, entries.TARGET])
def test_tip_and_target_are_shared_by_all_agents(entry):
    td = observation((3,), 6, 5)
    other = td.clone()
    other[entry] += 1
    assert (encoder()(td) != encoder()(other)).any(dim=-1).all()


def test_every_parameter_but_the_type_pad_is_trained():
    model = encoder()
    model(observation((9,), 4, 6)).square().sum().backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        used = parameter.grad.abs() > 0
        if name == "types.weight":
            assert used.any(dim=1).tolist() == [True, True, False]
        elif name == "input.weight":  # all columns but the 7 reserved zeros
            assert used.any(dim=0).tolist() == [True] * 15 + [False] * 7 + [True] * 3
        else:
            assert used.any(), name


def test_parameters_may_be_batched_with_vmap():
    """As the losses do with several critics."""
    models = [encoder(torch.float64, seed) for seed in range(2)]
    td = observation((3,), 4, 6, dtype=torch.float64)
    parameters, buffers = torch.func.stack_module_state(models)

    def call(parameters, buffers):
        return torch.func.functional_call(models[0], (parameters, buffers), (td,))

    together = torch.vmap(call)(parameters, buffers)
    for model, out in zip(models, together, strict=True):
        torch.testing.assert_close(out, model(td), rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("switches", SWITCHES, ids=str)
@pytest.mark.parametrize(("dtype", "tolerance"), [(torch.float32, 1e-6), (torch.float64, 1e-12)])
@pytest.mark.parametrize(
    ("lead", "n_slots", "sensed"), [((2, 5), 6, 0.4), ((3,), 6, 0.0), ((), 6, 1.0), ((2, 3), 0, 0.0)], ids=str
)
def test_masked_slots_equal_packed_edges(switches, dtype, tolerance, lead, n_slots, sensed):
    """Forward, gradients and attention of the way that devices go which nobody may wait for."""
    torch.manual_seed(0)
    model = SoftGMEncoder(softgm_config(velocity_scale=0.5, hidden=128, heads=4, **switches), SIZES).to(dtype)
    td = observation(lead, 4, n_slots, dtype=dtype, sensed=sensed, discovered=float(sensed > 0.0))
    parameters = list(model.parameters())

    def results():
        out, weights = model.forward_with_attention(td)
        return out, weights, torch.autograd.grad(out.square().mean(), parameters, allow_unused=True)

    packed, expected, gradients = results()
    with force_dense():
        masked, weights, others = results()
    rounding = 4 * torch.finfo(dtype).eps * packed.abs().max().item()
    torch.testing.assert_close(masked, packed, rtol=tolerance, atol=max(tolerance, rounding))
    assert weights.keys() == expected.keys()
    for stage in expected:
        torch.testing.assert_close(weights[stage], expected[stage], rtol=tolerance, atol=tolerance)
    for one, other in zip(gradients, others, strict=True):
        if (
            one is None or other is None
        ):  # only where there is no edge at all are packed obstacles no part of the result
            assert one is other or not (one if other is None else other).any()
        else:
            torch.testing.assert_close(other, one, rtol=tolerance, atol=tolerance)


@pytest.mark.parametrize("gatv2", [False, True])
def test_what_is_sensed_changes_no_shape_where_nobody_may_look(gatv2):
    model = encoder(gatv2=gatv2)

    class Shapes(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            out = func(*args, **(kwargs or {}))
            seen[-1].append((func, [t.shape for t in tree_leaves(out) if isinstance(t, torch.Tensor)]))
            return out

    seen = []
    for sensed in (0.0, 0.3, 1.0):
        seen.append([])
        model.zero_grad()
        with force_dense(), Shapes(), RoundTrips() as trips:
            model(observation((5,), 4, 6, sensed=sensed)).sum().backward()
        assert trips.found == []
    # random observations are drawn with the same operations
    assert seen[0] == seen[1] == seen[2]
