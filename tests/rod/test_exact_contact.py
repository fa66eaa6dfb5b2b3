"""The exact contact model: its forces against independent integrals, and what it promises about meshes."""

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad_vec
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from torch import Tensor

from softgm_bench.rod.contact import contact_forces, element_length, element_radius
from softgm_bench.rod.exact_contact import contact_interval, exact_contact_forces
from softgm_bench.rod.numba_contact import make_touch
from softgm_bench.rod.numba_layout import make_layout
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.state import Cylinders, straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

SEEDS = st.integers(0, 2**32 - 1)
KAPPA, NU = 5e4 * 60.0, 50.0 * 60.0  # of the defaults, per metre
MESHES = (30, 60, 120)
SIDEWAYS, SLANTED = (0.0, 1.0, 0.0), (0.0, 0.8, 0.6)


def arm(n_elements: int, **changes: object) -> RodParameters:
    return RodParameters(**{"n_elements": n_elements, "contact_model": "exact", **changes})


def tensor(values) -> Tensor:
    return torch.as_tensor(np.asarray(values, dtype=np.float64))


def cylinders_of(start, axis, length, radius) -> Cylinders:
    """One environment; ``start`` and ``axis`` are (n, 3), ``length`` and ``radius`` (n,)."""
    axis = np.asarray(axis, dtype=np.float64)
    return Cylinders(
        start=tensor(start)[None],
        axis=tensor(axis / np.linalg.norm(axis, axis=-1, keepdims=True))[None],
        length=tensor(length)[None],
        radius=tensor(radius)[None],
        mask=torch.ones(1, len(length), dtype=torch.bool),
        batch_size=[1],
    )


def crossing(axis, penetration: float = 1e-3, height: float = 0.513) -> Cylinders:
    """A post of radius 0.03 m beside a straight rod, crossing in the middle of its length of 1 m."""
    direction = np.array(axis) / np.linalg.norm(axis)
    return cylinders_of([np.array([0.08 - penetration, 0.0, height]) - 0.5 * direction], [direction], [1.0], [0.03])


def volume(parameters: RodParameters) -> Tensor:
    return tensor(rod_constants(parameters).volume)


def forces_of(position: Tensor, velocity: Tensor, cylinders: Cylinders, parameters: RodParameters) -> Tensor:
    model = exact_contact_forces if parameters.contact_model == "exact" else contact_forces
    return model(position, velocity, element_radius(position, volume(parameters)), cylinders, parameters)


def straight_forces(cylinders: Cylinders, parameters: RodParameters, velocity=(0.0, 0.0, 0.0)) -> Tensor:
    """On a straight rod that moves as a whole, ``(3, n_nodes)``."""
    position = straight_rods(parameters, 1).position
    return forces_of(position, tensor(velocity)[None, :, None].expand_as(position), cylinders, parameters)[0]


def pressed_scene(seed: int, parameters: RodParameters, n_cylinders: int = 4) -> tuple[Tensor, Tensor, Cylinders]:
    """A smoothly bent moving rod and cylinders of any direction that press on it, nowhere by more than half."""
    generator = np.random.default_rng(seed)
    z = np.linspace(0.0, 1.0, parameters.n_nodes)
    waves = np.sin(np.outer(np.arange(1, 4), z) * math.pi) * z
    position = np.stack([*(generator.normal(0.0, 0.06, (2, 3)) @ waves), z])
    velocity = generator.normal(0.0, 0.5, (3, 3)) @ waves
    rows = []
    while len(rows) < n_cylinders:
        axis, aside = generator.normal(size=(2, 3))
        axis /= np.linalg.norm(axis)
        aside = np.cross(axis, aside)
        length, radius = generator.uniform(0.1, 0.6), generator.uniform(0.02, 0.06)
        depth = generator.uniform(0.5, 1.0) * 0.05 + radius
        start = position[:, generator.integers(1, parameters.n_nodes)] + depth / np.linalg.norm(aside) * aside
        start -= generator.uniform(0.0, length) * axis
        points = np.linspace(start, start + length * axis, 100)[:, :, None]
        if np.linalg.norm(points - position, axis=1).min() > 0.5 * (0.05 + radius):
            rows.append((start, axis, length, radius))
    return (
        tensor(position)[None],
        tensor(velocity)[None],
        cylinders_of(*(list(column) for column in zip(*rows, strict=True))),
    )


def force_and_place(forces: Tensor, height: Tensor) -> tuple[float, float]:
    """Total force along x and the height at which it acts."""
    return forces[0].sum().item(), ((forces[0] * height).sum() / forces[0].sum()).item()


def test_force_of_a_parallel_cylinder_is_the_same_on_any_mesh_and_pyelasticas_on_the_papers():
    beside = cylinders_of([[0.079, 0.0, -0.5]], [[0.0, 0.0, 1.0]], [2.0], [0.03])
    totals = [straight_forces(beside, arm(n))[0].sum().item() for n in MESHES]
    assert totals == pytest.approx([-KAPPA * 1e-3] * 3, rel=1e-10)
    pyelastica = [straight_forces(beside, arm(n, contact_model="pyelastica"))[0].sum().item() for n in MESHES]
    assert pyelastica == pytest.approx([-0.5 * KAPPA * 1e-3, -KAPPA * 1e-3, -2.0 * KAPPA * 1e-3], rel=1e-10)


@pytest.mark.parametrize("axis", [SIDEWAYS, SLANTED, (0.0, 0.2, 1.0)])
@pytest.mark.parametrize("penetration", [1e-3, 1e-2])
def test_force_of_a_crossing_post_is_the_same_on_any_mesh(axis: tuple, penetration: float):
    post = crossing(axis, penetration)
    sine2 = (axis[1] / np.linalg.norm(axis)) ** 2
    aside, reach = 0.08 - penetration, 0.08
    half = math.sqrt((reach**2 - aside**2) / sine2)

    def density(z: float) -> np.ndarray:
        distance = math.sqrt(aside**2 + sine2 * (z - 0.513) ** 2)
        return KAPPA * (reach - distance) * aside / distance

    expected = -quad_vec(density, 0.513 - half, 0.513 + half, epsrel=1e-12)[0]
    for n in MESHES:
        force, place = force_and_place(straight_forces(post, arm(n)), torch.linspace(0.0, 1.0, n + 1).double())
        assert force == pytest.approx(expected, rel=2e-5)
        assert place == pytest.approx(0.513, abs=1e-6)


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.0, 1.0, 1.0), (0.02, 0.0, 1.0)])
def test_force_of_a_cylinders_end_is_the_same_on_any_mesh_within_a_per_cent(axis: tuple):
    end = cylinders_of([[0.079, 0.0, 0.513]], [axis], [0.4], [0.03])
    reference = straight_forces(end, arm(3000))[0].sum().item()
    totals = [straight_forces(end, arm(n))[0].sum().item() for n in MESHES]
    assert totals == pytest.approx([reference] * 3, rel=0.01)
    assert totals[1:] == pytest.approx([reference] * 2, rel=0.0015)


def test_force_and_its_place_do_not_notice_nodes_that_slide_past_a_post():
    """PyElastica's force doubles and its place wanders by more than half an element."""
    shifts, wander = np.linspace(0.0, 1.0 / 24.0, 101), {}
    for model in ("exact", "pyelastica"):
        parameters = arm(24, contact_model=model)
        position = straight_rods(parameters, 1).position
        rows = []
        for shift in shifts:
            slid = position + tensor([0.0, 0.0, shift])[:, None]
            forces = forces_of(slid, torch.zeros_like(slid), crossing(SIDEWAYS), parameters)[0]
            rows.append(force_and_place(forces, slid[0, 2]))
        force, place = np.array(rows).T
        wander[model] = (force.min() / force.max(), np.abs(place - 0.513).max())
    assert wander["exact"][0] == pytest.approx(1.0, abs=1e-4)
    assert wander["exact"][1] < 1e-6
    assert wander["pyelastica"][0] > 1.5
    assert wander["pyelastica"][1] > 0.5 / 24.0


@pytest.mark.parametrize("seed", range(5))
def test_forces_are_continuous_in_a_sliding_rod(seed: int):
    parameters = arm(24)
    position, velocity, cylinders = pressed_scene(seed, parameters)
    largest = forces_of(position, velocity, cylinders, parameters).norm(dim=1).max()
    steps = torch.arange(200).double()[:, None, None] * 5e-4
    tangent = position[..., -1:] - position[..., :1]
    for width in (1.0, 0.01):
        moved = position + width * steps * tangent
        forces = forces_of(moved, velocity.expand_as(moved), cylinders.expand(200), parameters)
        jump = forces.diff(dim=0).norm(dim=1).max() / largest
        assert jump < 0.3 * width**0.5  # damping grows as the root of the penetration


@pytest.mark.parametrize("seed", range(10))
def test_undamped_force_at_given_radii_is_minus_the_gradient_of_its_energy(seed: int):
    parameters = arm(24)
    position, velocity, cylinders = pressed_scene(seed, parameters)
    radius = element_radius(position, volume(parameters))
    position.requires_grad_()
    xi = (torch.arange(400).double() + 0.5) / 400.0
    start, edge = position[0, :, None, :-1], position.diff(dim=-1)[0, :, None]
    energy = torch.zeros(())
    for c in range(4):
        axis, length = cylinders.axis[0, c, :, None, None], cylinders.length[0, c]
        offset = start + xi[:, None] * edge - cylinders.start[0, c, :, None, None]
        along = (offset * axis).sum(0).clamp(torch.zeros(()).double(), length)
        distance = (offset - along * axis).norm(dim=0)
        penetration = (radius[0] + cylinders.radius[0, c] - distance).clamp(min=0.0)
        energy = energy + 0.5 * KAPPA * penetration.square().sum() / 400.0 / 24.0
    (gradient,) = torch.autograd.grad(energy, position)
    undamped = arm(24, contact_damping=0.0)
    force = exact_contact_forces(position.detach(), velocity, radius, cylinders, undamped)
    assert force.abs().max() > 1.0
    assert (force + gradient).norm() < 0.01 * force.norm()


def density_by_search(x: np.ndarray, v: np.ndarray, radius: float, cylinder: tuple) -> np.ndarray:
    """Force of one cylinder per metre at one point of the rod; closest point of the axis by minimisation."""
    start, axis, length, width = cylinder
    along = minimize_scalar(
        lambda t: ((start + t * axis - x) ** 2).sum(), bounds=(0.0, length), options={"xatol": 1e-12}
    ).x
    gap = x - start - along * axis
    distance = np.linalg.norm(gap)
    if distance >= radius + width:
        return np.zeros(3)
    normal = gap / distance
    return (KAPPA * (radius + width - distance) - NU * (v @ normal)) * normal


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_forces_equal_an_adaptive_integral_with_a_numerical_search(seed: int):
    parameters = arm(24)
    position, velocity, cylinders = pressed_scene(seed, parameters, 2)
    x, v = position[0].numpy(), velocity[0].numpy()
    radius = element_radius(position, volume(parameters))[0].numpy()
    expected = np.zeros_like(x)
    for c in range(2):
        cylinder = tuple(values[0, c].numpy() for values in (cylinders.start, cylinders.axis, cylinders.length))
        width = cylinders.radius[0, c].item()
        for k in range(24):

            def moments(xi: float, k: int = k, shape: tuple = (*cylinder, width)) -> np.ndarray:
                point, speed = (values[:, k] * (1.0 - xi) + values[:, k + 1] * xi for values in (x, v))
                return np.outer(density_by_search(point, speed, radius[k], shape), [1.0 - xi, xi])

            expected[:, k : k + 2] += quad_vec(moments, 0.0, 1.0, epsabs=1e-2, limit=100)[0] / 24.0
    actual = forces_of(position, velocity, cylinders, parameters)[0].numpy()
    assert np.abs(actual).max() > 1.0
    assert np.abs(actual - expected).max() < 0.01 * np.abs(expected).max()


@settings(max_examples=200, deadline=None)
@given(seed=SEEDS, aligned=st.sampled_from(["no", "parallel", "perpendicular", "point"]))
def test_contact_interval_is_where_a_dense_sampling_is_inside(seed: int, aligned: str):
    generator = np.random.default_rng(seed)
    axis = generator.normal(size=3)
    axis /= np.linalg.norm(axis)
    start, edge = generator.normal(0.0, 0.5, 3), generator.normal(size=3)
    if aligned == "parallel":
        edge = generator.normal() * axis
    elif aligned == "perpendicular":
        edge -= (edge @ axis) * axis
    elif aligned == "point":
        edge *= 0.0
    length, reach = generator.uniform(0.1, 1.0), generator.uniform(0.1, 0.8)
    enter, leave = contact_interval(
        tensor(start)[:, None], tensor(edge)[:, None], tensor(axis)[:, None], tensor([length]), tensor([reach])
    )
    xi = np.linspace(0.0, 1.0, 4001)
    x = start + xi[:, None] * edge
    along = np.clip(x @ axis, 0.0, length)
    inside = np.linalg.norm(x - along[:, None] * axis, axis=1) < reach
    if inside.any():
        assert enter.item() == pytest.approx(xi[inside].min(), abs=3e-4)
        assert leave.item() == pytest.approx(xi[inside].max(), abs=3e-4)
    else:
        assert not leave - enter > 3e-2  # a grazing contact between two samples is this short


@pytest.mark.parametrize(
    ("velocity", "expected"),
    [
        ((1e-3, 0.0, 0.0), (-KAPPA * 1e-3 - NU * 1e-3, 0.0)),  # approach is damped
        ((-2.0, 0.0, 0.0), (-KAPPA * 1e-3 + NU * 2.0, -0.0)),  # a fast retreat is held back: the damper pulls
        ((0.0, 1e-3, 0.0), (-KAPPA * 1e-3, -2.0 * 30.0 * 60.0 * 1e-3)),  # slow slip: viscous
        ((0.0, -100.0, 0.0), (-KAPPA * 1e-3, 0.4 * KAPPA * 1e-3)),  # fast slip: Coulomb
    ],
)
@pytest.mark.parametrize("model", ["exact", "pyelastica"])
def test_total_force_beside_a_parallel_cylinder_is_the_hand_computed_one_in_both_models(velocity, expected, model):
    parameters = arm(60, contact_model=model, friction_coefficient=0.4, velocity_damping_coefficient=30.0)
    beside = cylinders_of([[0.079, 0.0, -0.5]], [[0.0, 0.0, 1.0]], [2.0], [0.03])
    total = straight_forces(beside, parameters, velocity).sum(1)
    torch.testing.assert_close(total, tensor([*expected, 0.0]), rtol=1e-9, atol=1e-9)


FRICTION = arm(6, friction_coefficient=0.4, velocity_damping_coefficient=30.0)


@settings(deadline=None, max_examples=50)
@given(seed=SEEDS, turn=st.integers(0, 2**32 - 1))
def test_forces_turn_and_move_with_the_scene(seed: int, turn: int):
    position, velocity, cylinders = pressed_scene(seed, FRICTION)
    rotation = tensor(Rotation.random(rng=np.random.default_rng(turn)).as_matrix())
    shift = tensor(np.random.default_rng(turn).normal(size=3))
    turned = cylinders.clone()
    turned.start, turned.axis = cylinders.start @ rotation.T + shift, cylinders.axis @ rotation.T
    actual = forces_of(rotation @ position + shift[:, None], rotation @ velocity, turned, FRICTION)
    expected = rotation @ forces_of(position, velocity, cylinders, FRICTION)
    # Damping grows as the root of the penetration: round-off of a grazing contact is enlarged to its root.
    torch.testing.assert_close(actual, expected, rtol=1e-6, atol=1e-6 * (1.0 + expected.abs().max().item()))


@pytest.mark.parametrize("seed", range(4))
def test_gradients_of_forces_equal_finite_differences(seed: int):
    position, velocity, cylinders = pressed_scene(seed, FRICTION)
    position.requires_grad_()
    velocity.requires_grad_()
    scale = 1e-3  # brings the stiffness' derivatives near 1
    assert forces_of(position, velocity, cylinders, FRICTION).abs().max() > 1.0
    assert torch.autograd.gradcheck(
        lambda x, v: scale * forces_of(x, v, cylinders, FRICTION), (position, velocity), eps=1e-8, rtol=1e-3, atol=1e-3
    )


@pytest.mark.parametrize(
    ("start", "axis"),
    [
        ((0.08, 0.0, 0.2), (0.0, 0.0, 1.0)),  # parallel and touching
        ((0.0, 0.0, 0.2), (0.0, 0.0, 1.0)),  # on the rod's own axis: no direction to push
        ((0.0, 0.0, 1.02), (0.0, 0.0, 1.0)),  # continues the rod
        ((0.0, -0.25, 0.5), (0.0, 1.0, 0.0)),  # its axis crosses the rod's
        ((0.1, -0.25, 0.5), (0.0, 1.0, 0.0)),  # grazes
        ((9.0, 9.0, 9.0), (0.6, 0.0, 0.8)),  # far away
    ],
)
def test_forces_and_gradients_at_rest_are_finite_in_degenerate_places(start: tuple, axis: tuple):
    position = straight_rods(FRICTION, 1).position.requires_grad_()
    velocity = torch.zeros_like(position).requires_grad_()
    forces = forces_of(position, velocity, cylinders_of([start], [axis], [0.5], [0.05]), FRICTION)
    assert forces.isfinite().all()
    forces.square().sum().backward()
    assert position.grad.isfinite().all()
    assert velocity.grad.isfinite().all()


@settings(max_examples=30, deadline=None)
@given(seed=SEEDS, masked=st.lists(st.booleans(), min_size=8, max_size=8))
def test_masked_cylinders_change_no_bit_and_are_never_read(seed: int, masked: list[bool]):
    position, velocity, cylinders = pressed_scene(seed, FRICTION, 8)
    gone = torch.tensor(masked)
    poisoned = cylinders.clone()
    for values in (poisoned.start, poisoned.axis, poisoned.length, poisoned.radius):
        values[:, gone] = float("nan")
    poisoned.mask[:, gone] = False
    position.requires_grad_()
    forces = forces_of(position, velocity, poisoned, FRICTION)
    kept = cylinders.apply(lambda values: values[:, ~gone])
    assert torch.equal(forces, forces_of(position, velocity, kept, FRICTION))
    if not all(masked):
        forces.sum().backward()
        assert position.grad.isfinite().all()


def numba_forces(position: Tensor, velocity: Tensor, cylinders: Cylinders, parameters: RodParameters, real: type):
    """What ``make_touch`` adds to an empty buffer, ``(3, n_nodes)``."""
    n = parameters.n_elements
    layout = make_layout(n, real)
    s = np.zeros(layout.size, real)
    for i in range(3):
        s[(layout.px, layout.py, layout.pz)[i] :][: n + 1] = position[0, i]
        s[(layout.vx, layout.vy, layout.vz)[i] :][: n + 1] = velocity[0, i]
    s[layout.length :][:n] = element_length(position)[0]
    s[layout.rest :][:n] = rod_constants(parameters).rest_length
    p = parameters
    per_element = np.array([p.contact_stiffness, p.contact_damping, 0.0, p.velocity_damping_coefficient])
    contact = (per_element / p.contact_length + [0.0, 0.0, p.friction_coefficient, 0.0]).astype(real)
    touch = make_touch(layout, real, "exact", False)
    for c in range(cylinders.mask.shape[1]):
        edge = cylinders.axis[0, c] * cylinders.length[0, c]
        row = np.array([*cylinders.start[0, c], *edge, cylinders.radius[0, c], 0.0], dtype=real)
        for k in range(n):
            touch(s, k, row, contact, real(volume(parameters).max()))
    return torch.from_numpy(np.stack([s[f : f + n + 1] for f in (layout.fx, layout.fy, layout.fz)]))


@pytest.mark.parametrize(("real", "tolerance"), [(np.float64, 1e-12), (np.float32, 2e-3)])
def test_numba_and_torch_agree_on_random_scenes(real: type, tolerance: float):
    for seed in range(40):
        scene = pressed_scene(seed, FRICTION)
        expected = forces_of(*scene, FRICTION)[0]
        actual = numba_forces(*scene, FRICTION, real)
        assert actual.numpy().dtype == real
        assert (actual - expected).abs().max() <= tolerance * expected.abs().max(), seed


@pytest.mark.parametrize("axis", [(0.0, 0.0, 1.0), (0.0, 0.0, -1.0), SIDEWAYS, SLANTED, (1e-9, 0.0, 1.0)])
@pytest.mark.parametrize("start", [(0.07, 0.0, 0.2), (0.0, 0.0, 1.02), (0.0, 0.0, 0.3), (0.03, -0.25, 0.5)])
def test_numba_and_torch_agree_on_aligned_scenes(axis: tuple, start: tuple):
    position = straight_rods(FRICTION, 1).position
    scene = position, torch.ones_like(position), cylinders_of([start], [axis], [0.5], [0.05])
    expected = forces_of(*scene, FRICTION)[0]
    torch.testing.assert_close(numba_forces(*scene, FRICTION, np.float64), expected, rtol=1e-11, atol=1e-9)


def beam_deflection(parameters: RodParameters, tip_force: float, post: Cylinders) -> Tensor:
    """Where a clamped Euler-Bernoulli beam rests under a tip force and contact, ``(n_nodes,)``, m along x.

    Deflections under point forces are exact, so that only contact depends on the mesh. Newton's method.
    """
    n, position = parameters.n_elements, straight_rods(parameters, 1).position
    z = position[0, 2]
    near, far = torch.minimum(z[:, None], z), torch.maximum(z[:, None], z)
    bend = parameters.youngs_modulus * math.pi * parameters.base_radius**4 / 4.0
    compliance = near**2 * (3.0 * far - near) / (6.0 * bend)
    radius = torch.full((1, n), parameters.base_radius, dtype=torch.float64)
    model = exact_contact_forces if parameters.contact_model == "exact" else contact_forces

    def contact(deflection: Tensor) -> Tensor:
        bent = torch.stack([deflection, position[0, 1], z])[None]
        return model(bent, torch.zeros_like(bent), radius, post, parameters)[0, 0]

    deflection = torch.zeros_like(z)
    for _ in range(60):
        residual = deflection - compliance @ contact(deflection) - compliance[:, -1] * tip_force
        tangent = torch.autograd.functional.jacobian(contact, deflection, vectorize=True)
        change = torch.linalg.solve(torch.eye(n + 1).double() - compliance @ tangent, residual)
        if change.abs().max() < 1e-10:
            return deflection
        deflection = deflection - change * min(1.0, 2e-3 / change[n // 2].abs().item())  # do not jump over the post
    raise AssertionError("Newton's method did not converge")


def test_arm_pressed_against_a_soft_post_rests_at_the_same_place_on_any_mesh_unlike_pyelasticas():
    """The post stands in the middle; its penetration of a few millimetres is what the tip's place shows."""
    post = cylinders_of([[0.08, -0.5, 0.5]], [SIDEWAYS], [1.0], [0.03])
    tips = {}
    for model in ("exact", "pyelastica"):
        arms = [arm(n, contact_model=model, contact_stiffness=5e3) for n in MESHES]
        rests = [beam_deflection(parameters, 10.0, post) for parameters in arms]
        tips[model] = np.array([rest[-1] for rest in rests])
    spread = {model: np.ptp(values) / values.mean() for model, values in tips.items()}
    assert spread["exact"] < 0.005
    assert spread["pyelastica"] > 0.02


def test_torch_backend_uses_the_model_of_its_parameters():
    after = {}
    for model in ("exact", "pyelastica"):
        parameters = arm(6, contact_model=model, substeps=1)
        state = straight_rods(parameters, 1)
        post = crossing(SIDEWAYS)
        moved = TorchBackend(parameters).control_step(state, torch.zeros(1, 3, 6).double(), cylinders=post)
        mass = tensor(rod_constants(parameters).mass)
        decay = rod_constants(parameters).translational_decay
        expected = straight_forces(post, parameters)[0, 1:] / mass[1:] * parameters.dt * decay
        torch.testing.assert_close(moved.velocity[0, 0, 1:], expected, rtol=1e-9, atol=1e-15)
        after[model] = moved.velocity
    assert (after["exact"] - after["pyelastica"]).abs().max() > 1e-4
