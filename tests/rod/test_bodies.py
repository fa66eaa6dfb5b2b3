"""Arms of one batch with bodies of their own move as PyElastica moves each of them by itself."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from parity_cases import CASES, CPU_BACKENDS, FRICTION, OBLIQUE_BAR, QUANTITIES, WALL, Array, Case

from pairwise import tiered
from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.bodies import Bodies, Scales, draw, scales
from softgm_bench.rod.parameters import DAMPING_PROTOCOLS, RodParameters, rod_constants
from softgm_bench.rod.pyelastica_oracle import History, as_cylinders, simulate
from softgm_bench.rod.randomise import FACTORS, RandomiseConfig
from softgm_bench.rod.state import RodState, straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

pytestmark = pytest.mark.usefixtures("one_thread")

RANGES = dict.fromkeys(FACTORS, (0.6, 1.6)) | {"base_radius": (0.85, 1.15), "density": (0.7, 1.6)}
RANDOM = RandomiseConfig("random", **RANGES)
SCENES = {
    "gravity, tip force, torque": CASES["gravity, tip force, torque"],
    "uniform damping": CASES["uniform damping"],
    "wall, friction": Case(0.4, FRICTION, seed=2, peak=10.0, push=(20.0, 2.0), posts=WALL),
    "bar that jerks, friction": replace(
        CASES["bars that jerk, friction"], seconds=0.4, posts=OBLIQUE_BAR, push=(25.0, 0.0)
    ),
}
TOUCHING = [name for name, case in SCENES.items() if case.posts]
BOUNDS = dict(zip(QUANTITIES, (1e-11, 1e-11, 1e-8, 1e-8), strict=True))  # as in test_parity


def bodies(count: int, seed: int = 0, config: RandomiseConfig = RANDOM) -> Bodies:
    drawn = draw(config, count, torch.Generator().manual_seed(seed))
    return Bodies(*drawn[:, : len(Bodies._fields)].unbind(-1))


@cache
def theirs(name: str, count: int) -> list[History]:
    """Each body's arm in PyElastica, built from its own parameters."""
    case = SCENES[name]
    force = None if case.force is None else lambda step: case.force
    arms = [bodies(count).arm(case.parameters, row) for row in range(count)]
    return [simulate(arm, case.couple(), case.steps, case.posts, force, False, case.velocity()) for arm in arms]


def ours(backend: str, name: str, count: int) -> dict[str, Array]:
    """All arms in one batch, built from the nominal parameters and the factors; ``(steps, count, ...)``."""
    case, drawn = SCENES[name], bodies(count)
    rod, state = make_backend(backend, case.parameters), straight_rods(case.parameters, count)
    cylinders = as_cylinders([case.posts] * count) if case.posts else None
    force = None if case.force is None else torch.as_tensor(case.force).expand(count, -1, -1)
    couple, velocity, states = case.couple(), case.velocity(), []
    for step in range(case.steps):
        moved_by = None if velocity is None else torch.as_tensor(velocity(step)).expand(count, -1, -1)
        loads = torch.as_tensor(couple(step)).expand(count, -1, -1)
        state = rod.control_step(state, loads, force, cylinders, cylinder_velocity=moved_by, bodies=drawn)
        states.append(state)
        if cylinders is not None and moved_by is not None:
            cylinders.start += case.parameters.control_dt * moved_by
    return {quantity: np.stack([getattr(state, quantity).numpy() for state in states]) for quantity in QUANTITIES}


@pytest.mark.parametrize("name", [tiered(name, quick=name not in TOUCHING) for name in SCENES])
@pytest.mark.parametrize("backend", [*CPU_BACKENDS, "pyelastica"])
def test_each_body_moves_as_its_own_arm_in_pyelastica(backend: str, name: str):
    count = 2 if backend == "torch" and name in TOUCHING else 3
    found, expected = ours(backend, name, count), theirs(name, 3)
    for row in range(count):
        for quantity, bound in BOUNDS.items():
            difference = np.abs(found[quantity][:, row] - getattr(expected[row], quantity)).max()
            assert difference < bound, (row, quantity, difference)
    tips = found["position"][-1, :, :, -1]
    assert np.abs(tips[0] - tips[1:]).max() > 0.01  # the bodies do differ


@pytest.mark.slow
@pytest.mark.parametrize("name", TOUCHING)
def test_the_scenes_with_cylinders_touch_them(name: str):
    assert all(one.contact_force.max() > 10.0 for one in theirs(name, 3))


SMALL = RodParameters(n_elements=5, substeps=20, gravity=(0.0, 1.0, -9.81), friction_coefficient=0.2)


@pytest.mark.parametrize("protocol", DAMPING_PROTOCOLS)
def test_the_scales_are_those_of_the_constants(protocol: str):
    nominal = replace(SMALL, damping_protocol=protocol)
    drawn, found = bodies(20), scales(bodies(20), nominal)
    before = rod_constants(nominal)
    for row in range(20):
        arm = drawn.arm(nominal, row)
        now, scale = rod_constants(arm), Scales(*(float(one[row]) for one in found))
        pairs = {
            "shear": (now.shear, before.shear),
            "bend": (now.bend, before.bend),
            "mass": (now.mass, before.mass),
            "inertia": (now.inertia, before.inertia),
            "volume": (now.volume, before.volume),
            "translational": (np.log(now.translational_decay), np.log(before.translational_decay)),
            "rotational": (now.rotational_decay_rate, before.rotational_decay_rate),
            "friction": (arm.friction_coefficient, nominal.friction_coefficient),
        }
        for name, (one, other) in pairs.items():
            np.testing.assert_allclose(one, getattr(scale, name) * other, rtol=1e-11, err_msg=name)
        assert arm.shear_modulus / arm.youngs_modulus == pytest.approx(0.4)


def pushed(parameters: RodParameters, count: int) -> torch.Tensor:
    couple = torch.zeros(count, 3, parameters.n_elements, dtype=torch.float64)
    couple[:, 0] = 5.0 / parameters.n_elements
    return couple


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_company_and_order_change_no_bit_and_who_rests_stays(backend: str):
    arm = RodParameters()
    rod, state, drawn = make_backend(backend, arm), straight_rods(arm, 4), bodies(4)
    together = rod.control_step(state, pushed(arm, 4), bodies=drawn, substeps=10)
    rows = torch.tensor([2, 0])
    some = rod.control_step(state[rows], pushed(arm, 2), bodies=drawn.of(rows), substeps=10)
    active = torch.tensor([True, False, True, False])
    part = rod.control_step(state, pushed(arm, 4), active=active, bodies=drawn, substeps=10)
    for name in QUANTITIES:
        assert torch.equal(getattr(some, name), getattr(together, name)[rows])
        assert torch.equal(getattr(part, name)[::2], getattr(together, name)[::2])
        assert torch.equal(getattr(part, name)[1::2], getattr(state, name)[1::2])


@pytest.mark.parametrize("backend", CPU_BACKENDS)
def test_a_factor_of_one_is_the_nominal_arm(backend: str):
    arm = RodParameters()
    rod, state = make_backend(backend, arm), straight_rods(arm, 2)
    ones = Bodies(*[torch.ones(2, dtype=torch.float64)] * len(Bodies._fields))
    given = {"couple": pushed(arm, 2), "substeps": 20}
    nominal, same = rod.control_step(state, **given), rod.control_step(state, **given, bodies=ones)
    for name in QUANTITIES:
        torch.testing.assert_close(getattr(same, name), getattr(nominal, name), rtol=1e-12, atol=1e-12)


def test_gradients_reach_the_factors_and_equal_finite_differences():
    nominal = replace(SMALL, substeps=3, velocity_damping_coefficient=10.0, friction_coefficient=0.3)
    rod = TorchBackend(nominal)
    state = rod.control_step(straight_rods(nominal, 1), pushed(nominal, 1), substeps=200)
    post = as_cylinders([[OBLIQUE_BAR[0]._replace(start=(0.06, -0.5, 0.9), axis=(0.0, 1.0, 0.0), length=1.0)]])
    assert (rod.control_step(state, pushed(nominal, 1), cylinders=post).velocity - state.velocity).abs().max() > 1e-3

    def advance(*factors: torch.Tensor) -> torch.Tensor:
        after = rod.control_step(state, pushed(nominal, 1), cylinders=post, bodies=Bodies(*factors))
        return torch.cat([getattr(after, name).flatten() for name in QUANTITIES])

    factors = [factor.clone().requires_grad_() for factor in bodies(1, seed=3)]
    assert torch.autograd.gradcheck(advance, factors, eps=1e-6, rtol=1e-4, atol=1e-5)


def test_checkpointed_motion_of_bodies_has_the_same_gradients():
    found = []
    for every in (None, 7):
        factors = [factor.clone().requires_grad_() for factor in bodies(2)]
        couple = pushed(SMALL, 2).requires_grad_()
        rod = TorchBackend(SMALL, checkpoint_every=every)
        tip = rod.control_step(straight_rods(SMALL, 2), couple, bodies=Bodies(*factors)).position[..., -1].sum()
        used = [factor for name, factor in zip(Bodies._fields, factors, strict=True) if "friction" not in name]
        found.append(torch.autograd.grad(tip, [couple, *used]))
    for one, other in zip(*found, strict=True):
        assert one.abs().max() > 0.0
        torch.testing.assert_close(one, other, rtol=1e-11, atol=1e-14)


@pytest.mark.parametrize("backend", ["numba", "pyelastica"])
def test_a_gradient_of_a_body_is_refused_where_there_is_none(backend: str):
    factors = [factor.requires_grad_() for factor in bodies(2)]
    with pytest.raises(ValueError, match=rf"body requires a gradient, and backend={backend} has none"):
        make_backend(backend, SMALL).control_step(straight_rods(SMALL, 2), pushed(SMALL, 2), bodies=Bodies(*factors))


@pytest.mark.parametrize("backend", [*CPU_BACKENDS, "pyelastica"])
def test_factors_that_do_not_fit_are_refused(backend: str):
    wrong = bodies(2)._replace(density=torch.ones(3, dtype=torch.float64))
    with pytest.raises(ValueError, match=r"bodies.density has shape \(3,\): it must be \(2,\)"):
        make_backend(backend, SMALL).control_step(straight_rods(SMALL, 2), pushed(SMALL, 2), bodies=wrong)


def test_factors_lie_in_their_ranges_log_uniformly_and_are_float32_numbers():
    drawn = draw(RANDOM, 4000, torch.Generator().manual_seed(0))
    assert drawn.shape == (4000, len(FACTORS))
    assert torch.equal(drawn, drawn.float().double())
    for name, values in zip(FACTORS, drawn.unbind(-1), strict=True):
        low, high = RANGES[name]
        assert low - 1e-7 <= values.min() < 1.02 * low
        assert 0.98 * high < values.max() <= high + 1e-7
        ranks = (values.log() - np.log(low)) / (np.log(high) - np.log(low))
        assert abs(ranks.mean() - 0.5) < 4 / (12 * 4000) ** 0.5
        assert abs(ranks.var() * 12 - 1) < 0.1
    assert torch.corrcoef(drawn.T).fill_diagonal_(0).abs().max() < 0.07


def test_other_ranges_change_no_rank_and_what_is_not_drawn_is_one():
    narrow = RandomiseConfig("narrow", density=(0.9, 1.2))
    wide, other = (draw(config, 50, torch.Generator().manual_seed(3)) for config in (RANDOM, narrow))
    column = FACTORS.index("density")
    assert torch.equal(wide[:, column].argsort(), other[:, column].argsort())
    rest = [index for index in range(len(FACTORS)) if index != column]
    assert (other[:, rest] == 1.0).all()


def test_simulators_of_bodies_that_are_gone_are_not_kept():
    rod, state = make_backend("pyelastica", SMALL), straight_rods(SMALL, 2)
    for seed in range(3):
        state = rod.control_step(state, pushed(SMALL, 2), bodies=bodies(2, seed), substeps=1)
        assert isinstance(state, RodState)
        assert len(rod._arms) == 2
