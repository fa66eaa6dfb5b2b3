"""Backends tell which rods were pushed within a step; until then obstacles make no difference at all."""

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

ARM = RodParameters(n_elements=12, substeps=40, dt=8e-4)
BACKENDS = ("numba", "torch", "pyelastica")


def posts(*places):
    """One upright post for each environment, ``(x, y)`` of its axis, 1 m high."""
    start = torch.tensor([[[x, y, 0.2]] for x, y in places], dtype=torch.float64)
    once = torch.ones(len(places), 1, dtype=torch.float64)
    axis = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64).expand_as(start).contiguous()
    return Cylinders(start, axis, once, 0.04 * once, mask=once > 0.0, batch_size=[len(places)])


def bending(num_envs, strength=2.0):
    couple = torch.zeros(num_envs, 3, ARM.n_elements, dtype=torch.float64)
    couple[:, 0] = strength
    return couple


FAR = (5.0, 5.0)


@pytest.mark.parametrize("backend", BACKENDS)
def test_a_pushed_rod_is_marked_and_others_keep_what_they_had(backend):
    rod = make_backend(backend, ARM)
    touched = torch.tensor([False, False, True, False])
    near = (0.05, 0.0)  # within reach of an arm that stands up straight from the origin
    active = torch.tensor([True, True, True, False])
    given = {"cylinders": posts(near, FAR, FAR, near), "active": active}
    expected = rod.control_step(straight_rods(ARM, 4), bending(4), **given)
    found = rod.control_step(straight_rods(ARM, 4), bending(4), **given, touched=touched)
    assert touched.tolist() == [True, False, True, False]
    assert torch.equal(found.position, expected.position)


@pytest.mark.parametrize("backend", BACKENDS)
@pytest.mark.parametrize("contact_model", ["pyelastica", "exact"])
@settings(deadline=None, max_examples=10)
@given(apart=st.floats(0.01, 0.5), angle=st.floats(0.0, 2.0 * math.pi), strength=st.floats(-6.0, 6.0))
def test_until_a_rod_is_touched_it_moves_as_if_nothing_was_there(backend, contact_model, apart, angle, strength):
    if backend == "pyelastica" and contact_model == "exact":
        return  # which PyElastica does not have
    rod = make_backend(backend, RodParameters(**(vars(ARM) | {"contact_model": contact_model})))
    state = free = straight_rods(ARM, 1)
    post, couple, touched = (
        posts((apart * math.cos(angle), apart * math.sin(angle))),
        bending(1, strength),
        torch.zeros(1, dtype=torch.bool),
    )
    for _ in range(6):
        state = rod.control_step(state, couple, cylinders=post, touched=touched)
        free = rod.control_step(free, couple)
        same = torch.equal(state.position, free.position) and torch.equal(state.omega, free.omega)
        assert same is not bool(touched)
        if touched:
            break


@pytest.mark.parametrize("backend", ["numba", "pyelastica"])
@settings(deadline=None, max_examples=10)
@given(seed=st.integers(0, 2**31))
def test_backends_agree_on_who_was_touched(backend, seed):
    generator = torch.Generator().manual_seed(seed)
    angle = 2.0 * math.pi * torch.rand(6, generator=generator)
    apart = 0.06 + 0.1 * torch.rand(6, generator=generator)
    beside = posts(*torch.stack([apart * angle.cos(), apart * angle.sin()], dim=-1).tolist())
    couple = 4.0 * torch.randn(6, 3, ARM.n_elements, generator=generator, dtype=torch.float64)
    drift = 0.5 * torch.randn(6, 1, 3, generator=generator, dtype=torch.float64)
    found, expected = torch.zeros(6, dtype=torch.bool), torch.zeros(6, dtype=torch.bool)
    given = {"cylinders": beside, "cylinder_velocity": drift}
    make_backend(backend, ARM).control_step(straight_rods(ARM, 6), couple, **given, touched=found)
    make_backend("torch", ARM).control_step(straight_rods(ARM, 6), couple, **given, touched=expected)
    assert torch.equal(found, expected)


@pytest.mark.parametrize("every", [None, 7])
def test_a_graph_for_gradients_marks_the_same(every):
    strength = torch.tensor(2.0, dtype=torch.float64, requires_grad=True)
    touched = torch.zeros(2, dtype=torch.bool)
    rod = TorchBackend(ARM, checkpoint_every=every)
    after = rod.control_step(
        straight_rods(ARM, 2), strength * bending(2), cylinders=posts((0.05, 0.0), FAR), touched=touched
    )
    after.position.sum().backward()
    assert touched.tolist() == [True, False]
    assert strength.grad.abs() > 0.0


def test_marks_of_another_shape_are_refused():
    with pytest.raises(ValueError, match="touched has shape"):
        make_backend("numba", ARM).control_step(
            straight_rods(ARM, 2), bending(2), touched=torch.zeros(3, dtype=torch.bool)
        )
