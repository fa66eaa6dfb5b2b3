"""What InforMARL's encoder and the transformer over sections have in common with SoftGM: who hears what."""

import itertools

import pytest
import torch
from hypothesis import given, settings
from observations import (
    COUNTS,
    LEADS,
    SEEDS,
    SIZES,
    informarl_config,
    observation,
    randomise,
    relabelled,
    transformer_config,
    with_unsensed_slots_of,
)
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves

from dense import force_dense
from round_trips import RoundTrips
from softgm_bench.envs import entries
from softgm_bench.models.informarl import InforMARLEncoder
from softgm_bench.models.section_transformer import SectionTransformerEncoder

KINDS = {
    "informarl": (InforMARLEncoder, informarl_config, {}),
    "informarl_remember": (InforMARLEncoder, informarl_config, {"remember": True}),
    "transformer": (SectionTransformerEncoder, transformer_config, {}),
    "transformer_remember": (SectionTransformerEncoder, transformer_config, {"remember": True}),
    "transformer_all": (SectionTransformerEncoder, transformer_config, {"everyone": True}),
}
EVERY = pytest.mark.parametrize("kind", KINDS)
SENSING = pytest.mark.parametrize("kind", ["informarl", "transformer", "transformer_all"])
DECENTRAL = pytest.mark.parametrize("kind", ["informarl", "informarl_remember", "transformer", "transformer_remember"])


def encoder(kind, dtype=torch.float64, seed=0, **changes):
    model, config, own = KINDS[kind]
    torch.manual_seed(seed)
    return randomise(model(config(**(own | changes)), SIZES)).to(dtype)


@EVERY
@settings(max_examples=15, deadline=None)
@given(LEADS, COUNTS, SEEDS)
def test_masked_slots_equal_packed_edges(kind, lead, sizes, seed):
    """Forward, gradients and attention of the way that devices go which nobody may wait for."""
    model = encoder(kind, seed=seed)
    td = observation(lead, *sizes, seed=seed, dtype=torch.float64)
    parameters = list(model.parameters())

    def results():
        out, weights = model.forward_with_weights(td)
        gradients = torch.autograd.grad(out[..., 0].square().mean(), parameters, allow_unused=True)
        return out, weights, gradients

    packed, attention, gradients = results()
    with force_dense():
        masked, others, theirs = results()
    n_agents, n_slots = sizes
    assert packed.shape == (*lead, n_agents, 8)
    assert attention.shape == (*lead, 2, 2, n_agents, n_agents + n_slots)
    torch.testing.assert_close(masked, packed, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(others, attention, rtol=1e-9, atol=1e-9)
    for one, other in zip(gradients, theirs, strict=True):
        one, other = (torch.zeros(()) if gradient is None else gradient for gradient in (one, other))
        torch.testing.assert_close(other, one.expand_as(other), rtol=1e-8, atol=1e-8)


@EVERY
def test_single_precision_gives_the_same_up_to_its_rounding(kind):
    td = observation((2, 5), 4, 6)
    single, double = encoder(kind, torch.float32)(td), encoder(kind)(td.double())
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-4)


@SENSING
@settings(max_examples=20, deadline=None)
@given(COUNTS, SEEDS)
def test_slots_without_an_edge_change_no_bit(kind, sizes, seed):
    model = encoder(kind, torch.float32, seed)
    td = observation((5,), *sizes, seed=seed)
    other = observation((5,), *sizes, seed=seed + 1)
    changed = with_unsensed_slots_of(td, other)
    assert torch.equal(model(td), model(changed))
    with force_dense():
        assert torch.equal(model(td), model(changed))


@EVERY
def test_what_nobody_senses_any_more_is_heard_by_those_alone_that_remember(kind):
    model = encoder(kind)
    td = observation((3,), 4, 6, sensed=0.0, discovered=1.0, dtype=torch.float64)
    other = td.clone()
    other[entries.SLOT_DESCRIPTOR] = other[entries.SLOT_DESCRIPTOR].roll(1, 0)
    changed = (model(td) - model(other)).abs().amax(dim=(0, 2))
    assert (changed > 0).all() if kind.endswith("remember") else (changed == 0).all()
    other[entries.SLOT_ACTIVE] = torch.zeros_like(other[entries.SLOT_ACTIVE])
    blind = other.clone().set(entries.SLOT_DESCRIPTOR, td[entries.SLOT_DESCRIPTOR])
    assert torch.equal(model(other), model(blind))  # what was not discovered is heard by nobody


@EVERY
@settings(max_examples=15, deadline=None)
@given(COUNTS, SEEDS)
def test_relabelling_slots_changes_nothing(kind, sizes, seed):
    model = encoder(kind, seed=seed)
    td = observation((5,), *sizes, seed=seed, dtype=torch.float64)
    other = relabelled(td, torch.randperm(sizes[1]))
    torch.testing.assert_close(model(td), model(other), rtol=1e-10, atol=1e-10)


@EVERY
def test_a_chain_that_is_counted_from_the_other_end_gives_the_same_embeddings_in_that_order(kind):
    td = observation((2,), 5, 6, dtype=torch.float64)
    other = td.clone()
    other["agents"] = td["agents"].apply(lambda value: value.flip(1))
    model = encoder(kind)
    torch.testing.assert_close(model(other).flip(1), model(td), rtol=0.0, atol=1e-10)


@EVERY
def test_a_batch_of_one_equals_a_batch_of_many(kind):
    model = encoder(kind)
    td = observation((2, 3), dtype=torch.float64)
    together = model(td)
    for index in itertools.product(range(2), range(3)):
        torch.testing.assert_close(model(td[index]), together[index], rtol=1e-10, atol=1e-10)


@EVERY
def test_no_edge_at_all_equals_no_slots(kind):
    model = encoder(kind)
    empty = observation((3,), 4, 6, sensed=0.0, discovered=0.0, dtype=torch.float64)
    without = observation((3,), 4, 0, sensed=0.0, dtype=torch.float64)
    for key in (entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.PREVIOUS_ACTION, entries.TIP, entries.TARGET):
        without[key] = empty[key]
    assert torch.equal(model(empty), model(without))


@pytest.mark.parametrize("masked", [False, True])
@EVERY
def test_where_nothing_is_sensed_everything_is_finite_and_is_learnt_from(kind, masked):
    for n_agents, n_slots in ((1, 3), (3, 0), (3, 4)):
        model = encoder(kind, torch.float32)
        td = observation((4,), n_agents, n_slots, sensed=0.0)
        if masked:
            with force_dense():
                out = model(td)
        else:
            out = model(td)
        (out * torch.arange(8.0)).sum().backward()
        assert out.isfinite().all()
        gradients = [parameter.grad for parameter in model.parameters() if parameter.grad is not None]
        assert all(gradient.isfinite().all() for gradient in gradients)
        assert any(gradient.any() for gradient in gradients)


@DECENTRAL
@pytest.mark.parametrize("entry", [entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.PREVIOUS_ACTION])
@pytest.mark.parametrize("moved", [0, 3])
def test_an_agent_reaches_as_many_neighbours_as_there_are_layers(kind, entry, moved):
    td = observation((3,), 6, 5, sensed=0.5, discovered=1.0, dtype=torch.float64)
    other = td.clone()
    other[entry][:, moved] += 1.0
    for layers in (1, 2):
        model = encoder(kind, layers=layers)
        changed = ((model(td) - model(other)).abs() > 1e-12).any(dim=-1).any(dim=0)
        assert changed.tolist() == [abs(agent - moved) <= layers for agent in range(6)]


@pytest.mark.parametrize("kind", ["informarl", "transformer"])
def test_a_bin_reaches_one_agent_less_than_the_agent_that_senses_it(kind):
    td = observation((3,), 6, 5, sensed=0.0, discovered=1.0, dtype=torch.float64)
    other = td.clone()
    other[entries.EDGE][:, 2] = True
    for layers in (1, 2, 3):
        model = encoder(kind, layers=layers)
        changed = ((model(td) - model(other)).abs() > 1e-12).any(dim=-1).any(dim=0)
        assert changed.tolist() == [abs(agent - 2) < layers for agent in range(6)]


@EVERY
def test_a_bin_that_two_agents_sense_carries_no_message_between_them(kind):
    if kind == "transformer_all":
        pytest.skip("all sections hear each other")
    td = observation((3,), 6, 2, sensed=0.0, discovered=1.0, dtype=torch.float64)
    td[entries.EDGE][:, [0, 5]] = True
    other = td.clone()
    other[entries.AGENT_POSITION][:, 0] += 1.0
    assert torch.equal(encoder(kind)(td)[:, 5], encoder(kind)(other)[:, 5])


@EVERY
def test_every_parameter_is_trained(kind):
    model = encoder(kind)
    (model(observation((9,), 4, 6, dtype=torch.float64))[..., ::2].square().sum()).backward()
    for name, parameter in model.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.any(), name


@EVERY
def test_gradients_are_those_of_finite_differences(kind):
    model = encoder(kind)
    td = observation((2,), 3, 4, sensed=0.6, discovered=1.0, dtype=torch.float64)
    given = [td[key].clone().requires_grad_() for key in (entries.AGENT_POSITION, entries.SLOT_DESCRIPTOR)]
    weights = [parameter for name, parameter in model.named_parameters() if name.endswith(("types.weight", "0.bias"))]

    def call(position, descriptor, *_):
        changed = td.clone().set(entries.AGENT_POSITION, position).set(entries.SLOT_DESCRIPTOR, descriptor)
        return model(changed)

    assert torch.autograd.gradcheck(call, (*given, *weights), atol=1e-4)


@EVERY
def test_parameters_may_be_batched_with_vmap(kind):
    """As the losses do with several critics."""
    models = [encoder(kind, seed=seed) for seed in range(2)]
    td = observation((3,), 4, 6, dtype=torch.float64)
    parameters, buffers = torch.func.stack_module_state(models)

    def call(parameters, buffers):
        return torch.func.functional_call(models[0], (parameters, buffers), (td,))

    together = torch.vmap(call)(parameters, buffers)
    for model, out in zip(models, together, strict=True):
        torch.testing.assert_close(out, model(td), rtol=1e-10, atol=1e-10)


@EVERY
def test_what_is_sensed_changes_no_shape_where_nobody_may_look(kind):
    model = encoder(kind, torch.float32)

    class Shapes(TorchDispatchMode):
        def __torch_dispatch__(self, func, types, args=(), kwargs=None):
            out = func(*args, **(kwargs or {}))
            seen[-1].append((func, [t.shape for t in tree_leaves(out) if isinstance(t, torch.Tensor)]))
            return out

    with force_dense():
        model(observation((5,), 4, 6))  # constants are made once
    seen = []
    for sensed in (0.0, 0.3, 1.0):
        seen.append([])
        model.zero_grad()
        with force_dense(), Shapes(), RoundTrips() as trips:
            model(observation((5,), 4, 6, sensed=sensed)).sum().backward()
        assert trips.found == []
    # random observations are drawn with the same operations
    assert seen[0] == seen[1] == seen[2]


@EVERY
def test_a_device_without_values_gives_shapes(kind):
    model = encoder(kind, torch.float32).to("meta")
    out = model(observation((5,), 4, 6).to("meta"))
    assert out.shape == (5, 4, 8)
    out.sum().backward()
