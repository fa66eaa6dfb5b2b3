"""Contact forces against PyElastica's function and by their geometry."""

import math

import numpy as np
import pytest
import torch
from elastica._contact_functions import _calculate_contact_forces_rod_cylinder
from elastica._linalg import _batch_norm
from hypothesis import example, given, settings
from hypothesis import strategies as st
from torch import Tensor

from softgm_bench.rod.contact import (
    contact_forces,
    element_length,
    element_radius,
    shortest_connection,
)
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.state import Cylinders, straight_rods

PARAMETERS = RodParameters(n_elements=6)
FRICTION = RodParameters(n_elements=6, friction_coefficient=0.4, velocity_damping_coefficient=30.0)
VOLUME = torch.as_tensor(rod_constants(PARAMETERS).volume)
SEEDS = st.integers(0, 2**32 - 1)

coordinate = st.floats(-2.0, 2.0, allow_subnormal=False)
point = st.tuples(coordinate, coordinate, coordinate)


def tensor(values) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64)


def cylinders_of(start, axis, length, radius, mask=None) -> Cylinders:
    """One environment; ``start`` and ``axis`` are (n, 3), ``length`` and ``radius`` (n,)."""
    start = tensor(np.array(start))[None]
    mask = torch.ones(start.shape[:2], dtype=torch.bool) if mask is None else torch.tensor(mask)[None]
    return Cylinders(
        start=start,
        axis=tensor(np.array(axis))[None],
        length=tensor(length)[None],
        radius=tensor(radius)[None],
        mask=mask,
        batch_size=[1],
    )


def first(cylinders: Cylinders, n: int) -> Cylinders:
    return cylinders.apply(lambda values: values[:, :n])


def random_scene(seed: int, n_cylinders: int = 5) -> tuple[Tensor, Tensor, Cylinders]:
    """A crooked moving rod among cylinders of any direction, most of which touch it."""
    generator = np.random.default_rng(seed)
    position = straight_rods(PARAMETERS, 1).position + tensor(generator.normal(0.0, 0.08, (1, 3, 7)))
    velocity = tensor(generator.normal(0.0, 2.0, (1, 3, 7)))
    axis = generator.normal(size=(n_cylinders, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    length = generator.uniform(0.05, 0.6, n_cylinders)
    # Some point of each cylinder's axis is close to the rod.
    near = np.stack([*generator.normal(0.0, 0.1, (2, n_cylinders)), generator.uniform(-0.1, 1.2, n_cylinders)], axis=1)
    start = near - generator.uniform(0.0, length)[:, None] * axis
    radius = generator.uniform(0.01, 0.1, n_cylinders)
    return position, velocity, cylinders_of(start, axis, length, radius)


def pyelastica_forces(position: Tensor, velocity: Tensor, cylinders: Cylinders, parameters: RodParameters) -> Tensor:
    x, v = position[0].numpy(), velocity[0].numpy()
    edge = np.diff(x)
    length = np.linalg.norm(edge, axis=0) + 1e-14
    radius = np.sqrt(VOLUME.numpy() / length / np.pi)
    forces = np.zeros_like(x)
    for start, axis, height, width in zip(
        *(values[0].numpy() for values in (cylinders.start, cylinders.axis, cylinders.length, cylinders.radius)),
        strict=True,
    ):
        _calculate_contact_forces_rod_cylinder(
            0.5 * (x[:, 1:] + x[:, :-1]),
            edge,
            start + 0.5 * height * axis,
            start,
            height * axis,
            radius + width,
            length + height,
            np.zeros_like(x),
            forces,
            np.zeros((3, 1)),
            np.zeros((3, 1)),
            np.eye(3),
            v,
            np.zeros((3, 1)),
            parameters.contact_stiffness,
            parameters.contact_damping,
            parameters.velocity_damping_coefficient,
            parameters.friction_coefficient,
        )
    return tensor(forces)[None]


def forces_of(position: Tensor, velocity: Tensor, cylinders: Cylinders, parameters: RodParameters = PARAMETERS):
    return contact_forces(position, velocity, element_radius(position, VOLUME), cylinders, parameters)


@settings(max_examples=200, deadline=None)
@given(seed=SEEDS, parameters=st.sampled_from([PARAMETERS, FRICTION]))
def test_forces_equal_pyelastica(seed: int, parameters: RodParameters):
    position, velocity, cylinders = random_scene(seed)
    expected = pyelastica_forces(position, velocity, cylinders, parameters)
    actual = forces_of(position, velocity, cylinders, parameters)
    torch.testing.assert_close(actual, expected, rtol=1e-9, atol=1e-9)


def test_random_scenes_do_touch():
    touched = [forces_of(*random_scene(seed)).abs().max() > 0.0 for seed in range(50)]
    assert sum(touched) > 40


@pytest.mark.parametrize("offset", [-0.6, -0.02, 0.3, 0.99, 1.05])
@pytest.mark.parametrize("tilt", [0.0, 5e-4, 2e-3])  # the parallel shortcut takes over below 1e-3
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_forces_of_nearly_parallel_cylinder_equal_pyelastica(offset: float, tilt: float, sign: float):
    position, velocity = straight_rods(PARAMETERS, 1).position, torch.ones(1, 3, 7, dtype=torch.float64)
    axis = sign * np.array([math.sin(tilt), 0.0, math.cos(tilt)])
    cylinders = cylinders_of([[0.08, 0.01, offset]], [axis], [0.5], [0.05])
    expected = pyelastica_forces(position, velocity, cylinders, PARAMETERS)
    torch.testing.assert_close(forces_of(position, velocity, cylinders), expected, rtol=1e-9, atol=1e-9)


@settings(deadline=None)
@given(seed=SEEDS, angle=st.floats(-7.0, 7.0))
def test_forces_turn_with_the_scene_about_z(seed: int, angle: float):
    position, velocity, cylinders = random_scene(seed)
    rotation = tensor(
        [[math.cos(angle), -math.sin(angle), 0.0], [math.sin(angle), math.cos(angle), 0.0], [0.0, 0.0, 1.0]]
    )
    turned = cylinders.clone()
    turned.start, turned.axis = cylinders.start @ rotation.T, cylinders.axis @ rotation.T
    actual = forces_of(rotation @ position, rotation @ velocity, turned, FRICTION)
    expected = rotation @ forces_of(position, velocity, cylinders, FRICTION)
    torch.testing.assert_close(actual, expected, rtol=1e-8, atol=1e-8)


@settings(deadline=None)
@given(seed=SEEDS, gap=st.floats(1e-9, 1.0), height=st.floats(-1.0, 1.5))
@example(seed=0, gap=1e-9, height=0.5)
def test_force_is_zero_outside_contact(seed: int, gap: float, height: float):
    position = straight_rods(PARAMETERS, 1).position
    velocity = tensor(np.random.default_rng(seed).normal(size=(1, 3, 7)))
    cylinders = cylinders_of([[0.05 + 0.03 + gap, -0.5, height]], [[0.0, 1.0, 0.0]], [1.0], [0.03])
    assert (forces_of(position, velocity, cylinders, FRICTION) == 0.0).all()


# A post along y passes the rod's axis at a distance of 0.06: 0.02 of penetration, felt by element 3 alone, whose
# segment starts at its midpoint and reaches from z = 0.583 to 0.75. Each of its nodes, 3 and 4, receives half.
CROSSING = ([[0.06, -0.5, 0.65]], [[0.0, 1.0, 0.0]], [1.0], [0.03])
SPRING = 0.5 * PARAMETERS.contact_stiffness * 0.02


@pytest.mark.parametrize(
    ("velocity", "expected"),
    [
        ((0.0, 0.0, 0.0), (-SPRING, 0.0, 0.0)),
        ((1.0, 0.0, 0.0), (-SPRING - 0.5 * PARAMETERS.contact_damping, 0.0, 0.0)),  # approach is damped
        ((0.0, 1.0, 0.0), (-SPRING, -30.0, 0.0)),  # slow slip: viscous
        ((0.0, -100.0, 0.0), (-SPRING, 0.4 * SPRING, 0.0)),  # fast slip: Coulomb
    ],
)
def test_force_of_a_crossing_post_is_the_hand_computed_one(velocity: tuple, expected: tuple):
    position = straight_rods(PARAMETERS, 1).position
    moving = tensor(velocity)[None, :, None].expand_as(position)
    forces = torch.zeros(1, 3, 7, dtype=torch.float64)
    forces[..., [3, 4]] = tensor(expected)[None, :, None]
    actual = forces_of(position, moving, cylinders_of(*CROSSING), FRICTION)
    torch.testing.assert_close(actual, forces, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("height", "nodes", "shares"), [(0.12, [0, 1], [2 / 3, 4 / 3]), (1.0, [5, 6], [4 / 3, 2 / 3])])
def test_outermost_elements_split_their_force_two_to_four(height: float, nodes: list[int], shares: list[float]):
    position = straight_rods(PARAMETERS, 1).position
    # Thin and barely touching, so that only the element straight across feels it.
    cylinders = cylinders_of([[0.05999, -0.5, height]], [[0.0, 1.0, 0.0]], [1.0], [0.01])
    force = forces_of(position, torch.zeros_like(position), cylinders)[0, 0]
    expected = torch.zeros(7, dtype=torch.float64)
    expected[nodes] = -0.5 * PARAMETERS.contact_stiffness * 1e-5 * tensor(shares)
    torch.testing.assert_close(force, expected, rtol=1e-6, atol=1e-9)


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS)
def test_masked_cylinders_are_never_read(seed: int):
    position, velocity, cylinders = random_scene(seed)
    poisoned = cylinders.clone()
    for values in (poisoned.start, poisoned.axis, poisoned.length, poisoned.radius):
        values[:, 3:] = float("nan")
    poisoned.mask[:, 3:] = False
    position.requires_grad_()
    forces = forces_of(position, velocity, poisoned)
    assert torch.equal(forces, forces_of(position, velocity, first(cylinders, 3)))
    forces.sum().backward()
    assert position.grad.isfinite().all()


def test_no_cylinders_mean_no_force():
    position, velocity, cylinders = random_scene(0)
    assert torch.equal(forces_of(position, velocity, first(cylinders, 0)), torch.zeros_like(position))


@pytest.mark.parametrize("seed", range(4))
def test_gradients_of_forces_equal_finite_differences(seed: int):
    position, velocity, cylinders = random_scene(seed)
    position.requires_grad_()
    velocity.requires_grad_()
    scale = 1e-3  # brings the stiffness' derivatives near 1
    assert torch.autograd.gradcheck(
        lambda x, v: scale * forces_of(x, v, cylinders, FRICTION), (position, velocity), eps=1e-8, rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize("parameters", [PARAMETERS, FRICTION])
@pytest.mark.parametrize(
    ("start", "axis"),
    [
        ((0.08, 0.0, 0.2), (0.0, 0.0, 1.0)),  # parallel and touching
        ((0.0, 0.0, 0.2), (0.0, 0.0, 1.0)),  # on the rod's own axis: no direction to push
        ((0.0, -0.25, 0.5), (0.0, 1.0, 0.0)),  # its axis crosses the rod's
        ((9.0, 9.0, 9.0), (0.6, 0.0, 0.8)),  # far away
    ],
)
def test_gradients_at_rest_are_finite_in_degenerate_places(parameters: RodParameters, start: tuple, axis: tuple):
    position = straight_rods(PARAMETERS, 1).position.requires_grad_()
    velocity = torch.zeros_like(position).requires_grad_()
    cylinders = cylinders_of([start], [axis], [0.5], [0.05])
    forces = forces_of(position, velocity, cylinders, parameters)
    assert forces.isfinite().all()
    forces.square().sum().backward()
    assert position.grad.isfinite().all()
    assert velocity.grad.isfinite().all()


@settings(max_examples=50, deadline=None)
@given(seed=SEEDS)
def test_shortest_connection_of_skew_segments_is_their_minimum_distance(seed: int):
    generator = np.random.default_rng(seed)
    start1, edge1, start2, edge2 = tensor(generator.normal(size=(4, 3, 1)))
    distance = shortest_connection(start1, edge1, start2, edge2).norm(dim=-2)[0]
    grid = torch.linspace(0.0, 1.0, 101, dtype=torch.float64)
    pairs = (start2 + edge2 * grid)[:, :, None] - (start1 + edge1 * grid)[:, None, :]
    sampled = pairs.norm(dim=0).min()
    assert distance <= sampled + 1e-12
    assert distance >= sampled - (edge1.norm() + edge2.norm()) / 200.0


def test_element_length_equals_pyelasticas_including_its_guard():
    position = random_scene(0)[0]
    expected = _batch_norm(np.diff(position[0].numpy())) + 1e-14
    np.testing.assert_allclose(element_length(position)[0].numpy(), expected, rtol=4e-16, atol=0.0)


@given(stretch=st.floats(0.2, 5.0))
def test_stretched_elements_keep_their_volume(stretch: float):
    position = stretch * straight_rods(PARAMETERS, 1).position
    radius = element_radius(position, VOLUME)
    torch.testing.assert_close(math.pi * radius**2 * stretch / 6.0, VOLUME[None], rtol=1e-9, atol=0.0)
