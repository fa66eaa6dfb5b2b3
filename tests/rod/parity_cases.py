"""The scenes in which both backends are compared with PyElastica: one list for the tests and the published table."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np
import torch

from softgm_bench.rod.actuation import Actuation
from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.pyelastica_oracle import UP, Array, History, Post, as_cylinders, simulate
from softgm_bench.rod.state import straight_rods

CPU_BACKENDS = ("torch", "numba")
QUANTITIES = ("position", "director", "velocity", "omega")


@dataclass(frozen=True)
class Case:
    """A straight arm at rest that is loaded from t = 0. Torques are about d1 and d2, N m per m of arm.

    ``torque`` is ``none``, ``constant`` (``push`` alone), ``smooth`` (random sines of time and arc length up to
    ``peak``, plus ``push``) or ``bang-bang`` (``peak`` with a random sign that is drawn anew every 0.12 s). With
    ``n_agents`` the last two give the amplitudes of that many control points instead of a field along the arm.

    Posts stand still or move, with a velocity that is constant in a control step: ``sway`` along y (a sine), ``drift``
    along y at a constant speed, there and back, ``press`` towards -x, or ``jerk`` (each post another velocity in
    another direction every third step).
    """

    seconds: float = 0.52
    parameters: RodParameters = field(default_factory=RodParameters)
    torque: str = "smooth"
    peak: float = 25.0
    push: tuple[float, float] = (0.0, 0.0)  # towards +x and +y
    n_agents: int | None = None
    seed: int = 0
    posts: tuple[Post, ...] = ()
    post_motion: str | None = None
    tip_force: tuple[float, float, float] | None = None
    moves: bool = True

    @property
    def steps(self) -> int:
        """Number of control steps."""
        return round(self.seconds / self.parameters.control_dt)

    @property
    def force(self) -> Array | None:
        """External force on the nodes, N, ``(3, n_nodes)``."""
        if self.tip_force is None:
            return None
        force = np.zeros((3, self.parameters.n_nodes))
        force[:, -1] = self.tip_force
        return force

    def velocity(self) -> Callable[[int], Array] | None:
        """Velocity of the posts in m/s, ``(posts, 3)``, as a function of the control step; None: they stand still."""
        if self.post_motion is None:
            return None
        count, time = len(self.posts), self.parameters.control_dt
        drawn = np.random.default_rng(self.seed).uniform(-0.6, 0.6, (100, count, 3))
        along: dict[str, Callable[[int], Array]] = {
            "sway": lambda step: 0.5 * np.cos(8.0 * time * step) * np.array([0.0, 1.0, 0.0]),
            "drift": lambda step: np.array([0.0, 0.2 if step // 8 % 2 == 0 else -0.2, 0.0]),
            "press": lambda step: np.array([-0.3, 0.0, 0.0]),
            "jerk": lambda step: drawn[step // 3],
        }
        return lambda step: np.broadcast_to(along[self.post_motion](step), (count, 3)).copy()

    def couple(self) -> Callable[[int], Array]:
        """External couple on the elements, N m, ``(3, n_elements)``, as a function of the control step."""
        p = self.parameters
        amplitude = _amplitude(self)
        if self.n_agents is not None:
            actuation = Actuation(p, self.n_agents, max_torque=1.0)
            return lambda step: actuation.couple(torch.as_tensor(amplitude(step).T)[None])[0].numpy()
        tangential = np.zeros((1, p.n_elements))
        return lambda step: np.concatenate([amplitude(step), tangential]) * p.base_length / p.n_elements


def _amplitude(case: Case) -> Callable[[int], Array]:
    """Torque about d1 and d2 at every control point, or at every element: ``(2, points)`` of the control step."""
    generator = np.random.default_rng(case.seed)
    points = case.n_agents or case.parameters.n_elements
    push = np.repeat(np.array(case.push)[:, None], points, axis=1)
    if case.torque in ("none", "constant"):
        return lambda step: push
    if case.torque == "bang-bang":
        sign = generator.choice([-1.0, 1.0], (100, 2, points))
        return lambda step: case.peak * sign[step // 3] + push
    terms = 3
    frequency = generator.uniform(1.0, 8.0, (2, terms, 1))
    start = generator.uniform(0.0, 2.0 * np.pi, (2, terms, 1))
    phase = start + generator.uniform(0.0, 4.0, (2, terms, 1)) * (np.arange(points) + 0.5) / points
    weight = generator.dirichlet(np.ones(terms), 2)[:, :, None]
    time = case.parameters.control_dt
    return lambda step: case.peak * (weight * np.sin(frequency * time * step + phase)).sum(1) + push


def _wall() -> tuple[Post, ...]:
    """The wall of the paper's scenario c: 16 columns of which four are cut by an opening, 20 cylinders."""
    columns = []
    for y in -0.6 + 0.08 * np.arange(16):
        if abs(y - 0.08) <= 0.15:
            columns += [Post((0.4, y, -0.2), UP, 0.55, 0.04), Post((0.4, y, 0.65), UP, 0.55, 0.04)]
        else:
            columns.append(Post((0.4, y, -0.2), UP, 1.4, 0.04))
    return tuple(columns)


def _bar(middle: tuple[float, float, float], axis: tuple[float, float, float], length: float, radius: float) -> Post:
    """A cylinder given by the middle of its axis."""
    direction = np.array(axis) / np.linalg.norm(axis)
    return Post(tuple(np.array(middle) - 0.5 * length * direction), tuple(direction), length, radius)


ONE_POST = (Post((0.3, 0.05, -0.2), UP, 1.2, 0.05),)
TWO_POSTS = tuple(Post((0.35, y, -0.2), UP, 1.2, 0.05) for y in (-0.16, 0.16))
WALL = _wall()
# Its lower end stands in the arm's way, so that the capsule and a slanted frame are exercised.
SLANTED_POST = (Post((0.13, 0.0, 0.7), (0.6, 0.0, 0.8), 0.3, 0.04),)
OBLIQUE_BAR = (_bar((0.2, 0.0, 0.55), (0.4, 1.0, -0.7), 0.9, 0.04),)
# Leans by 7 degrees, which is where PyElastica's bounding box of such a cylinder has no width along x.
LEANING_POST = (_bar((0.3, 0.05, 0.8), (0.125, 0.0, 1.0), 0.8, 0.05),)
OBLIQUE_ENDS = (
    _bar((0.22, 0.22, 0.6), (0.3, -1.0, 0.2), 0.4, 0.05),
    _bar((0.22, -0.27, 0.75), (-0.1, 1.0, 0.6), 0.5, 0.03),
)

FRICTION = RodParameters(friction_coefficient=0.5, velocity_damping_coefficient=50.0)
STIFF = RodParameters(youngs_modulus=2e6, shear_modulus=2e6 / 3.0, dt=2e-4, substeps=200)
FINE = RodParameters(n_elements=100, dt=2e-4, substeps=200)

CASES = {
    "no load": Case(torque="none", moves=False),
    "constant torque": Case(torque="constant", push=(12.0, -8.0)),
    "smooth torque": Case(1.0),
    "bang-bang torque": Case(1.0, torque="bang-bang", n_agents=6),
    "uniform damping": Case(parameters=RodParameters(damping_protocol="uniform_damping_constant"), seed=5, peak=3.0),
    "gravity": Case(parameters=RodParameters(gravity=(0.5, 0.0, -9.81)), torque="none"),
    "gravity, tip force, torque": Case(
        parameters=RodParameters(gravity=(0.5, 0.0, -9.81)), seed=6, peak=10.0, tip_force=(3.0, -2.0, 1.0)
    ),
    "tip force": Case(torque="none", tip_force=(4.0, -3.0, 2.0)),
    "stiff": Case(parameters=STIFF, seed=7, peak=80.0),
    "thin": Case(parameters=RodParameters(base_radius=0.03), seed=8, peak=4.0),
    "11 elements": Case(parameters=RodParameters(n_elements=11), seed=1),
    "20 elements": Case(1.0, RodParameters(n_elements=20), seed=1),
    "100 elements": Case(parameters=FINE, seed=1),
    **{f"{n} control points": Case(n_agents=n, seed=n) for n in (2, 4, 6, 9)},
    "one post": Case(seed=3, peak=5.0, push=(20.0, 2.0), posts=ONE_POST),
    "two posts": Case(1.0, seed=2, peak=10.0, push=(10.0, 5.0), posts=TWO_POSTS),
    "wall": Case(1.0, seed=2, peak=10.0, push=(16.0, 2.0), posts=WALL),
    "wall, friction": Case(1.0, FRICTION, seed=2, peak=10.0, push=(16.0, 2.0), posts=WALL),
    "wall, bang-bang torque": Case(
        1.0, torque="bang-bang", n_agents=6, seed=9, peak=15.0, push=(12.0, 0.0), posts=WALL
    ),
    "slanted post, its end": Case(seed=4, peak=5.0, push=(20.0, 0.0), posts=SLANTED_POST),
    "slanted post, friction": Case(0.6, FRICTION, seed=4, peak=5.0, push=(20.0, 0.0), posts=SLANTED_POST),
    "oblique bar, mid-span": Case(seed=10, peak=5.0, push=(20.0, 0.0), posts=OBLIQUE_BAR),
    "leaning post": Case(seed=10, peak=5.0, push=(20.0, 2.0), posts=LEANING_POST),
    "two oblique ends, friction": Case(0.6, FRICTION, seed=11, peak=4.0, push=(20.0, 0.0), posts=OBLIQUE_ENDS),
    "20 elements, one post": Case(
        parameters=RodParameters(n_elements=20), seed=3, peak=5.0, push=(20.0, 2.0), posts=ONE_POST
    ),
    "post that sways": Case(1.0, seed=3, peak=5.0, push=(20.0, 2.0), posts=ONE_POST, post_motion="sway"),
    "post that presses": Case(seed=3, peak=5.0, push=(12.0, 2.0), posts=ONE_POST, post_motion="press"),
    "wall that drifts, friction": Case(
        1.0, FRICTION, seed=2, peak=10.0, push=(16.0, 2.0), posts=WALL, post_motion="drift"
    ),
    "bars that jerk, friction": Case(
        0.8, FRICTION, seed=12, peak=5.0, push=(20.0, 0.0), posts=OBLIQUE_BAR + SLANTED_POST, post_motion="jerk"
    ),
}


def pyelastica_trajectory(case: Case, pruning: bool = False) -> History:
    """What PyElastica computes; ``pruning`` as shipped, or every pair of element and cylinder."""
    force = None if case.force is None else lambda step: case.force
    return simulate(case.parameters, case.couple(), case.steps, case.posts, force, pruning, case.velocity())


def together(cases: dict[str, Case]) -> Iterable[dict[str, Case]]:
    """Cases that fit into one batch: the same arm; all with cylinders or all without; all of these still or moving."""
    groups: dict[tuple[RodParameters, bool, bool], dict[str, Case]] = {}
    for name, case in cases.items():
        groups.setdefault((case.parameters, bool(case.posts), bool(case.post_motion)), {})[name] = case
    return groups.values()


def our_trajectories(backend: str, cases: dict[str, Case]) -> dict[str, dict[str, Array]]:
    """Run cases of the same arm as one batch: by name and quantity, ``(steps, ...)``."""
    parameters = next(iter(cases.values())).parameters
    rod, state = make_backend(backend, parameters), straight_rods(parameters, len(cases))
    posts = [case.posts for case in cases.values()]
    cylinders = as_cylinders(posts) if any(posts) else None
    none = np.zeros((3, parameters.n_nodes))
    force = torch.as_tensor(np.stack([none if case.force is None else case.force for case in cases.values()]))
    couples = [case.couple() for case in cases.values()]
    states = []
    for step in range(max(case.steps for case in cases.values())):
        couple = torch.as_tensor(np.stack([couple(step) for couple in couples]))
        velocity = _velocities(cases, step)
        state = rod.control_step(state, couple, force=force, cylinders=cylinders, cylinder_velocity=velocity)
        states.append(state)
        if cylinders is not None and velocity is not None:
            cylinders.start += parameters.control_dt * velocity
    return {
        name: {
            quantity: np.stack([getattr(state, quantity)[i].numpy() for state in states[: case.steps]])
            for quantity in QUANTITIES
        }
        for i, (name, case) in enumerate(cases.items())
    }


def _velocities(cases: dict[str, Case], step: int) -> torch.Tensor | None:
    """Velocities of all cases' posts, padded as ``as_cylinders`` does; None where none moves."""
    if not any(case.post_motion for case in cases.values()):
        return None
    velocity = torch.zeros((len(cases), max(len(case.posts) for case in cases.values()), 3), dtype=torch.float64)
    for row, case in enumerate(cases.values()):
        if (given := case.velocity()) is not None:
            velocity[row, : len(case.posts)] = torch.as_tensor(given(step))
    return velocity


def largest_difference(ours: dict[str, Array], theirs: History, quantity: str = "position") -> float:
    """Largest absolute difference over all steps and components."""
    return float(np.abs(ours[quantity] - getattr(theirs, quantity)).max())
