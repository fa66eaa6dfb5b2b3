"""Cylinders that move within a control step; trajectories are compared with PyElastica's in ``test_parity``."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from parity_cases import TWO_POSTS
from test_contact import FRICTION, PARAMETERS, VOLUME, random_scene

from softgm_bench.rod.contact import contact_forces, element_radius
from softgm_bench.rod.exact_contact import exact_contact_forces
from softgm_bench.rod.numba_backend import NumbaBackend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.pyelastica_oracle import as_cylinders
from softgm_bench.rod.state import Cylinders, RodState, straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

pytestmark = pytest.mark.usefixtures("one_thread")

ARM = RodParameters()
FIELDS = ("position", "director", "velocity", "omega")
SEEDS = st.integers(0, 2**32 - 1)
speed = st.floats(-1.0, 1.0, allow_subnormal=False)


def leaning(step: int = 0) -> torch.Tensor:
    couple = torch.zeros(2, 3, ARM.n_elements, dtype=torch.float64)
    couple[:, 0], couple[1, 1] = 24.0 / ARM.n_elements, 4.0 / ARM.n_elements
    return couple


def posts() -> Cylinders:
    """Two environments, the second of which has the first post alone."""
    return as_cylinders([TWO_POSTS, TWO_POSTS[:1]])


def identical(one: RodState, other: RodState) -> bool:
    return all(torch.equal(getattr(one, name), getattr(other, name)) for name in FIELDS)


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, parameters=st.sampled_from([PARAMETERS, FRICTION]), velocity=st.tuples(speed, speed, speed))
def test_a_cylinder_that_moves_with_the_rod_is_not_damped(seed, parameters, velocity):
    """Nor does it rub: what is left is the spring, as between a rod and a cylinder that both rest."""
    position, _, cylinders = random_scene(seed)
    radius = element_radius(position, VOLUME)
    own = torch.tensor(velocity, dtype=torch.float64)
    of_rod, of_cylinders = own[None, :, None].expand_as(position), own.expand_as(cylinders.start)
    for forces in (contact_forces, exact_contact_forces):
        still = forces(position, torch.zeros_like(position), radius, cylinders, parameters)
        assert torch.equal(forces(position, of_rod, radius, cylinders, parameters, of_cylinders), still)


@settings(max_examples=60, deadline=None)
@given(seed=SEEDS, parameters=st.sampled_from([PARAMETERS, FRICTION]), velocity=st.tuples(speed, speed, speed))
def test_contact_depends_on_the_relative_velocity_alone(seed, parameters, velocity):
    position, moving, cylinders = random_scene(seed)
    radius = element_radius(position, VOLUME)
    own = torch.tensor(velocity, dtype=torch.float64)
    for forces in (contact_forces, exact_contact_forces):
        found = forces(position, moving, radius, cylinders, parameters, own.expand_as(cylinders.start))
        expected = forces(position, moving - own[None, :, None], radius, cylinders, parameters)
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("model", ["pyelastica", "exact"])
def test_with_velocity_zero_cylinders_stand_still_bit_for_bit(model: str):
    rod = TorchBackend(RodParameters(n_elements=20, contact_model=model, substeps=250))
    cylinders, state = posts(), straight_rods(rod.parameters, 2)
    cylinders.start[..., 0], cylinders.start[..., 1] = 0.105, 0.02
    couple = torch.zeros(2, 3, 20, dtype=torch.float64)
    couple[:, 0] = 1.2
    still = rod.control_step(state, couple, cylinders=cylinders)
    assert not identical(still, rod.control_step(state, couple))
    zero = torch.zeros_like(cylinders.start)
    assert identical(still, rod.control_step(state, couple, cylinders=cylinders, cylinder_velocity=zero))


def test_a_step_in_pieces_is_the_step_at_once():
    """Where the cylinders are follows from the time since the step began, not from the number of steps."""
    rod, cylinders, state = NumbaBackend(ARM), posts(), straight_rods(ARM, 2)
    cylinders.start[..., 0], cylinders.start[..., 1] = 0.15, 0.02
    velocity = torch.tensor([-0.5, 0.1, 0.0], dtype=torch.float64).expand_as(cylinders.start)
    at_once = rod.control_step(state, leaning(), cylinders=cylinders, substeps=400, cylinder_velocity=velocity)
    assert not identical(at_once, rod.control_step(state, leaning(), substeps=400))
    pieces = state
    for _ in range(4):
        pieces = rod.control_step(pieces, leaning(), cylinders=cylinders, substeps=100, cylinder_velocity=velocity)
        cylinders.start += 100 * ARM.dt * velocity
    assert (pieces.position - at_once.position).abs().max() < 1e-11


def test_a_post_that_comes_from_afar_pushes_an_arm_that_rests():
    """Nothing of the arm moves until then: what is not due is due by the post's own way."""
    rod, cylinders, state = NumbaBackend(ARM), posts(), straight_rods(ARM, 2)
    cylinders.start[..., 0], cylinders.start[..., 1] = 0.3, 0.0
    velocity = torch.tensor([-1.0, 0.0, 0.0], dtype=torch.float64).expand_as(cylinders.start).clone()
    velocity[1, 1] = torch.nan  # masked
    none = torch.zeros(2, 3, ARM.n_elements, dtype=torch.float64)
    given = {"couple": none, "cylinders": cylinders, "cylinder_velocity": velocity}
    before = rod.control_step(state, **given, substeps=480)  # 0.192 s: 0.008 m are left
    assert (before.position - state.position).abs().max() < 1e-13
    found, expected = (backend.control_step(state, **given, substeps=540) for backend in (rod, TorchBackend(ARM)))
    assert (found.position - state.position).abs().amax(dim=(1, 2)).min() > 1e-3
    assert (found.position - expected.position).abs().max() < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_exact_model_moves_cylinders_as_in_the_torch_backend(dtype: torch.dtype):
    parameters = RodParameters(contact_model="exact", friction_coefficient=0.4, velocity_damping_coefficient=20.0)
    cylinders, state = posts().to(torch.float64), straight_rods(parameters, 2)
    cylinders.start[..., 0], cylinders.start[..., 1] = 0.11, 0.02
    velocity = torch.tensor([-0.3, 0.2, 0.1], dtype=torch.float64).expand_as(cylinders.start)
    given = {"couple": leaning(), "cylinders": cylinders, "cylinder_velocity": velocity, "substeps": 150}
    expected = TorchBackend(parameters).control_step(state, **given)
    assert (expected.position - state.position).abs().max() > 1e-3
    found = NumbaBackend(parameters).control_step(state.to(dtype), **given)
    assert (found.position - expected.position).abs().max() < {torch.float64: 1e-12, torch.float32: 1e-5}[dtype]


def test_gradients_reach_the_velocity_and_are_those_without_checkpoints():
    parameters = RodParameters(n_elements=6, substeps=30)
    cylinders, state = posts()[:1], straight_rods(parameters, 1)
    cylinders.start[..., 0], cylinders.start[..., 1] = 0.1, 0.0
    gradients = []
    for every in (None, 7):
        velocity = torch.full_like(cylinders.start, -0.4).requires_grad_()
        couple = torch.zeros(1, 3, 6, dtype=torch.float64)
        after = TorchBackend(parameters, every).control_step(
            state, couple, cylinders=cylinders, cylinder_velocity=velocity
        )
        gradients.append(torch.autograd.grad(after.position.sum(), velocity)[0])
    assert gradients[0].abs().max() > 0.0
    torch.testing.assert_close(gradients[0], gradients[1], rtol=1e-12, atol=0.0)


def test_velocities_that_belong_to_no_cylinder_are_refused():
    state, couple = straight_rods(ARM, 2), torch.zeros(2, 3, ARM.n_elements, dtype=torch.float64)
    with pytest.raises(ValueError, match="without cylinders"):
        TorchBackend(ARM).control_step(state, couple, cylinder_velocity=torch.zeros(2, 2, 3))
    with pytest.raises(ValueError, match=r"cylinder_velocity has shape \(2, 3\): it must be \(2, 2, 3\)"):
        TorchBackend(ARM).control_step(state, couple, cylinders=posts(), cylinder_velocity=torch.zeros(2, 3))
