"""Both CPU backends against PyElastica, and what a batch promises to each of its environments."""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest
import torch
from pyelastica_oracle import UP, Array, Post, Trajectory, as_cylinders, simulate

from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, RodState, straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

TWO_POSTS = tuple(Post((0.35, y, -0.2), UP, 1.2, 0.05) for y in (-0.16, 0.16))
# The eight columns of the wall that the arm can reach here.
WALL = tuple(Post((0.4, y, -0.2), UP, 1.4, 0.04) for y in np.arange(-2, 6) * 0.08)
# Its lower end stands in the arm's way, so that the capsule and a slanted frame are exercised.
SLANTED_POST = (Post((0.13, 0.0, 0.7), (0.6, 0.0, 0.8), 0.3, 0.04),)


@dataclass(frozen=True)
class Case:
    seconds: float
    parameters: RodParameters = field(default_factory=RodParameters)
    seed: int = 0
    peak: float = 25.0  # of the random torque, N m per m
    push: tuple[float, float] = (0.0, 0.0)  # constant torque about d1 and d2, that is towards +x and +y, N m per m
    posts: tuple[Post, ...] = ()
    tip_force: tuple[float, float, float] | None = None

    @property
    def steps(self) -> int:
        return round(self.seconds / self.parameters.control_dt)

    @property
    def force(self) -> Array | None:
        if self.tip_force is None:
            return None
        force = np.zeros((3, self.parameters.n_nodes))
        force[:, -1] = self.tip_force
        return force


CASES = {
    "free, 60 elements": Case(1.0),
    "free, 24 elements": Case(1.0, RodParameters(n_elements=24), seed=1),
    "two posts": Case(1.0, seed=2, peak=10.0, push=(10.0, 5.0), posts=TWO_POSTS),
    "wall": Case(1.0, seed=2, peak=10.0, push=(16.0, 2.0), posts=WALL),
    "slanted post": Case(0.4, seed=4, peak=5.0, push=(20.0, 0.0), posts=SLANTED_POST),
    "friction": Case(
        0.6,
        RodParameters(friction_coefficient=0.5, velocity_damping_coefficient=50.0),
        seed=4,
        peak=5.0,
        push=(20.0, 0.0),
        posts=SLANTED_POST,
    ),
    "uniform damping": Case(0.3, RodParameters(damping_protocol="uniform_damping_constant"), seed=5, peak=3.0),
    "gravity and tip force": Case(
        0.3, RodParameters(gravity=(0.5, 0.0, -9.81)), seed=6, peak=10.0, tip_force=(3.0, -2.0, 1.0)
    ),
}
TOUCHING = [name for name, case in CASES.items() if case.posts]


@pytest.fixture(params=["torch", "numba"])
def make_backend(request: pytest.FixtureRequest) -> Callable:
    torch.set_num_threads(1)
    if request.param == "torch":
        return TorchBackend
    return pytest.importorskip("softgm_bench.rod.numba_backend").NumbaBackend


def smooth_couple(case: Case) -> Callable[[int], Array]:
    """Sums of random sines in time and arc length about d1 and d2, N m per element; never above ``peak`` plus push."""
    generator = np.random.default_rng(case.seed)
    n, terms = case.parameters.n_elements, 3
    arc = (np.arange(n) + 0.5) / n
    frequency = generator.uniform(1.0, 8.0, (2, terms, 1))
    phase = generator.uniform(0.0, 2.0 * np.pi, (2, terms, 1)) + generator.uniform(0.0, 4.0, (2, terms, 1)) * arc
    weight = generator.dirichlet(np.ones(terms), 2)[:, :, None]

    def couple(step: int) -> Array:
        time = step * case.parameters.control_dt
        torque = np.zeros((3, n))
        torque[:2] = case.peak * (weight * np.sin(frequency * time + phase)).sum(1)
        torque[:2] += np.array(case.push)[:, None]
        return torque * case.parameters.base_length / n

    return couple


@cache
def oracle(name: str) -> Trajectory:
    case = CASES[name]
    return simulate(case.parameters, smooth_couple(case), case.steps, case.posts, case.force)


def batch_of_one(array: Array | None) -> torch.Tensor | None:
    return None if array is None else torch.as_tensor(array)[None]


@pytest.mark.parametrize("name", CASES)
def test_trajectory_equals_pyelastica(make_backend: Callable, name: str):
    case, expected = CASES[name], oracle(name)
    couple, cylinders = smooth_couple(case), as_cylinders([case.posts]) if case.posts else None
    backend, state = make_backend(case.parameters), straight_rods(case.parameters, 1)
    worst = dict.fromkeys(("position", "director", "velocity", "omega"), 0.0)
    for step in range(case.steps):
        state = backend.control_step(
            state, batch_of_one(couple(step)), force=batch_of_one(case.force), cylinders=cylinders
        )
        for quantity in worst:
            difference = np.abs(getattr(state, quantity)[0].numpy() - getattr(expected, quantity)[step]).max()
            worst[quantity] = max(worst[quantity], difference)
    print({quantity: f"{difference:.1e}" for quantity, difference in worst.items()})
    # Measured: positions to 5e-14 at worst; the stiffness amplifies the round-off of the rates.
    assert worst["position"] < 1e-11
    assert worst["director"] < 1e-11
    assert worst["velocity"] < 1e-8
    assert worst["omega"] < 1e-8


@pytest.mark.parametrize("name", TOUCHING)
def test_contact_cases_do_touch(name: str):
    assert oracle(name).contact_force.max() > 10.0


@pytest.mark.parametrize("name", [name for name in CASES if name not in ("uniform damping", "gravity and tip force")])
def test_cases_move_the_tip_far(name: str):
    tip = oracle(name).position[:, :, -1]
    assert np.ptp(tip, axis=0).max() > 0.1


def test_friction_case_differs_from_the_same_case_without_friction():
    case = CASES["friction"]
    smooth = simulate(RodParameters(), smooth_couple(case), case.steps, case.posts)
    assert np.abs(smooth.position - oracle("friction").position).max() > 1e-3


@pytest.fixture(scope="module")
def batch() -> tuple[RodParameters, RodState, torch.Tensor, torch.Tensor, Cylinders]:
    """Three environments with nothing in common, in motion; in the outer two, three cylinders touch one node."""
    parameters = RodParameters(substeps=30)
    cases = [CASES["slanted post"], CASES["free, 60 elements"], CASES["two posts"]]
    couple = torch.stack([torch.as_tensor(smooth_couple(case)(1)) for case in cases])
    force = 0.1 * torch.randn(3, 3, parameters.n_nodes, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    state = TorchBackend(parameters).control_step(straight_rods(parameters, 3), couple, force, substeps=300)

    def bars(i: int) -> list[Post]:
        node = state.position[i, :, 40].numpy()
        starts = node + np.array([[0.07, -0.5, 0.0], [-0.08, -0.5, 0.01], [0.06, -0.5, -0.03]])
        return [Post(tuple(start), (0.0, 1.0, 0.0), 1.0, 0.04) for start in starts]

    cylinders = as_cylinders([tuple(bars(0)), (), (*TWO_POSTS, *bars(2))])
    return parameters, state, couple, force, cylinders


def assert_identical(actual: RodState, expected: RodState) -> None:
    for name in ("position", "director", "velocity", "omega"):
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name


def test_batch_touches(batch: tuple, make_backend: Callable):
    parameters, state, couple, force, cylinders = batch
    backend = make_backend(parameters)
    touched = backend.control_step(state, couple, force, cylinders)
    free = backend.control_step(state, couple, force)
    change = (touched.position - free.position).abs().amax((1, 2))
    assert change[0] > 1e-5
    assert change[1] == 0.0
    assert change[2] > 1e-5


def test_environment_in_a_batch_moves_exactly_as_alone(batch: tuple, make_backend: Callable):
    parameters, state, couple, force, cylinders = batch
    backend = make_backend(parameters)
    many = torch.arange(21) % 3
    together = backend.control_step(state[many], couple[many], force[many], cylinders[many])
    for i in range(3):
        one = slice(i, i + 1)
        alone = backend.control_step(state[one], couple[one], force[one], cylinders[one])
        for k in range(i, 21, 3):
            assert_identical(together[k : k + 1], alone)


def test_masked_cylinders_change_no_bit(batch: tuple, make_backend: Callable):
    parameters, state, couple, force, cylinders = batch
    backend = make_backend(parameters)
    padded = backend.control_step(state, couple, force, cylinders)
    assert_identical(backend.control_step(state[1:2], couple[1:2], force[1:2]), padded[1:2])
    unpadded = cylinders[:1].apply(lambda values: values[:, :3])
    assert_identical(backend.control_step(state[:1], couple[:1], force[:1], unpadded), padded[:1])


@pytest.mark.parametrize("broken", [0, 1, 2])
def test_nan_in_one_environment_leaves_the_others_identical(batch: tuple, make_backend: Callable, broken: int):
    parameters, state, couple, force, cylinders = batch
    backend = make_backend(parameters)
    expected = backend.control_step(state, couple, force, cylinders)
    poisoned = state.clone()
    poisoned.position[broken, :, 5] = float("nan")
    actual = backend.control_step(poisoned, couple, force, cylinders)
    others = [i for i in range(3) if i != broken]
    assert_identical(actual[others], expected[others])
    assert actual.position[broken].isnan().any()
