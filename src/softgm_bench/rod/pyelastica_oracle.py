"""PyElastica 1.0.0 itself, an optional extra, is the oracle of a rod's trajectory and is driven as our backends are.

``simulate`` lets it run from rest, undisturbed, for tests and benchmarks; ``pyelastica_backend`` makes it one of the
backends. Both move an ``Arm``.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import elastica as ea
import elastica.contact_forces
import numpy as np
import torch
from numpy.typing import NDArray

from softgm_bench.rod.compiling import njit
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders

Array = NDArray[np.float64]
UP = (0.0, 0.0, 1.0)
ROUNDING = 1e-4  # m by which a cylinder must be out of reach, far more than what rounding could make of it


class Post(NamedTuple):
    """A post is one cylinder: the centre of one end, the unit vector to the other, length and radius, in m."""

    start: tuple[float, float, float]
    axis: tuple[float, float, float]
    length: float
    radius: float


class History(NamedTuple):
    """A history has one entry per control step, taken at its end.

    Attributes:
        position: m, ``(steps, 3, n_nodes)``.
        director: rows d1, d2, d3, ``(steps, 3, 3, n_elements)``.
        velocity: m/s, ``(steps, 3, n_nodes)``.
        omega: in the material frame, rad/s, ``(steps, 3, n_elements)``.
        contact_force: the largest force of the cylinders on any node within the step, N, ``(steps,)``.
        missed: contacts (cylinder and substep) that PyElastica's pruning did not, or would not, let through.
    """

    position: Array
    director: Array
    velocity: Array
    omega: Array
    contact_force: Array
    missed: int


class _Simulator(ea.BaseSystemCollection, ea.Constraints, ea.Forcing, ea.Damping, ea.Contact):
    pass


class Loads:
    """These loads act in the current control step: couple ``(3, n_elements)`` in N m, force ``(3, n_nodes)`` in N."""

    def __init__(self, couple: Array, force: Array | None = None) -> None:
        """Begin with this couple and this force; None: there is none."""
        self.couple, self.force = couple, force


class _Given(ea.NoForces):
    def __init__(self, loads: Loads):
        super().__init__()
        self.loads = loads

    def apply_forces(self, system, time=0.0):
        if self.loads.force is not None:
            system.external_forces += self.loads.force

    def apply_torques(self, system, time=0.0):
        system.external_torques += self.loads.couple


class Carriage:
    """A cylinder's centre is at ``centre`` (3,) in m at time 0 and moves at ``velocity`` (3,) in m/s."""

    def __init__(self, post: Post) -> None:
        """Begin at rest."""
        self.post = post
        self.put(np.array(post.start), np.zeros(3))

    def put(self, start: Array, velocity: Array) -> None:
        """Be with the post's start at ``start``, and go on at this velocity."""
        self.centre = start + np.array(self.post.axis) * self.post.length / 2
        self.velocity = velocity


class _Carried(ea.ConstraintBase):
    """The cylinder is where its carriage is and never turns."""

    def __init__(self, carriage: Carriage, **kwargs):
        super().__init__(**kwargs)
        self.carriage, self.director = carriage, self.system.director_collection.copy()

    def constrain_values(self, system, time):
        system.position_collection[..., 0] = self.carriage.centre + time * self.carriage.velocity
        system.director_collection[...] = self.director
        self.constrain_rates(system, time)  # contact, which comes next, sees the velocity of this step

    def constrain_rates(self, system, time):
        system.velocity_collection[..., 0] = self.carriage.velocity
        system.omega_collection[...] = 0.0


class _LargestContactForce(ea.NoForces):
    """Appended after the contacts: notes how much they added to weight and loads."""

    def __init__(self, record: list[float], weight: Array, loads: Loads):
        super().__init__()
        self.record, self.weight, self.loads = record, weight, loads

    def apply_forces(self, system, time=0.0):
        known = self.weight if self.loads.force is None else self.weight + self.loads.force
        self.record[-1] = max(self.record[-1], float(np.abs(system.external_forces - known).max()))


class _Pruning:
    """Compute every pair within reach and count the contacts that PyElastica's bounding boxes would have skipped.

    With ``apply`` those contacts are counted as well, but what they add to the forces is taken back: PyElastica as
    shipped.
    """

    def __init__(self, apply: bool):
        self.apply, self.skips, self.missed = apply, False, 0
        module = elastica.contact_forces
        self._prune = module._prune_using_aabbs_rod_cylinder
        self._forces = module._calculate_contact_forces_rod_cylinder

    def prune(self, *arguments) -> int:
        if _out_of_reach(*arguments):
            return 1
        self.skips = bool(self._prune(*arguments))
        return 0

    def forces(self, *arguments) -> None:
        if not self.skips:
            self._forces(*arguments)
            return
        external_forces = arguments[8]
        before = external_forces.copy()
        self._forces(*arguments)
        self.missed += not np.array_equal(before, external_forces)
        if self.apply:
            external_forces[...] = before


@njit(error_model="numpy")
def _out_of_reach(position, radius, length, centre, director, cylinder_radius, cylinder_length):
    """Whether a cylinder is too far for any contact, so that computing it would add nothing.

    An element touches from its midpoint along its whole edge: no point of it is nearer than its midpoint by more than
    its length.
    """
    for k in range(radius.shape[0]):
        along = square = 0.0
        for i in range(3):
            apart = 0.5 * (position[i, k] + position[i, k + 1]) - centre[i, 0]
            along += apart * director[2, i, 0]
            square += apart * apart
        beyond = max(abs(along) - 0.5 * cylinder_length, 0.0)
        reach = radius[k] + cylinder_radius + length[k] + ROUNDING
        if not max(square - along * along, 0.0) + beyond * beyond > reach * reach:  # or what is not finite
            return False
    return True


@contextmanager
def watched_pruning(apply: bool) -> Iterator[_Pruning]:
    """Switch PyElastica's pruning off, or with ``apply`` on, and count in ``missed`` the contacts that it misses."""
    module, pruning = elastica.contact_forces, _Pruning(apply)
    module._prune_using_aabbs_rod_cylinder = pruning.prune
    module._calculate_contact_forces_rod_cylinder = pruning.forces
    try:
        yield pruning
    finally:
        module._prune_using_aabbs_rod_cylinder = pruning._prune
        module._calculate_contact_forces_rod_cylinder = pruning._forces


def straight_rod(parameters: RodParameters) -> ea.CosseratRod:
    """Build the arm at rest, as ``straight_rods`` has it."""
    return ea.CosseratRod.straight_rod(
        parameters.n_elements,
        np.zeros(3),
        np.array([0.0, 0.0, 1.0]),
        np.array([0.0, 1.0, 0.0]),
        parameters.base_length,
        parameters.base_radius,
        parameters.density,
        youngs_modulus=parameters.youngs_modulus,
        shear_modulus=parameters.shear_modulus,
    )


def build(
    parameters: RodParameters,
    loads: Loads,
    posts: Sequence[Post] = (),
    rods: int = 1,
    carriages: Sequence[Carriage] = (),
) -> tuple[_Simulator, ea.CosseratRod]:
    """Build a simulator with clamps, dampers, loads and contacts, still to be finalised, and return its first arm too.

    Several ``rods`` stand in the same place under the same loads, touch the same posts and don't see each other. Posts
    are fixed, or moved by their ``carriages``.
    """
    simulator, arms = _Simulator(), [straight_rod(parameters) for _ in range(rods)]
    for rod in arms:
        simulator.append(rod)
        simulator.constrain(rod).using(ea.OneEndFixedBC, constrained_position_idx=(0,), constrained_director_idx=(0,))
        simulator.dampen(rod).using(
            ea.AnalyticalLinearDamper,
            time_step=parameters.dt,
            **{parameters.damping_protocol: parameters.damping_constant},
        )
        if any(parameters.gravity):
            simulator.add_forcing_to(rod).using(ea.GravityForces, acc_gravity=np.array(parameters.gravity))
        simulator.add_forcing_to(rod).using(_Given, loads=loads)
    moved_by: Sequence[Carriage | None] = carriages or [None] * len(posts)
    for post, carriage in zip(posts, moved_by, strict=True):
        _add_cylinder(simulator, arms, post, carriage, parameters)
    return simulator, arms[0]


class Arm:
    """An arm at rest among posts, in a simulator of its own, is moved by whole control steps."""

    def __init__(self, parameters: RodParameters, posts: Sequence[Post] = (), carried: bool = False) -> None:
        """Build the simulator; posts are fixed, or ``carried``."""
        self._parameters = parameters
        self._loads = Loads(np.zeros((3, parameters.n_elements)))
        self._carriages = [Carriage(post) for post in posts] if carried else []
        self._simulator, self._rod = build(parameters, self._loads, posts, carriages=self._carriages)
        self._largest = [0.0]
        if posts:
            weight = np.array(parameters.gravity)[:, None] * self._rod.mass
            self._simulator.add_forcing_to(self._rod).using(
                _LargestContactForce, record=self._largest, weight=weight, loads=self._loads
            )
        self._simulator.finalize()
        self._stepper, self._time = ea.PositionVerlet(), np.float64(0.0)

    @property
    def state(self) -> tuple[Array, ...]:
        """Give PyElastica's own position, director, velocity and omega, as ``History`` has them without the time.

        They are its whole state between two steps: what is written into them is where the next step begins.
        """
        return tuple(getattr(self._rod, f"{name}_collection") for name in ("position", "director", "velocity", "omega"))

    def carry(self, start: Sequence[Array | tuple[float, ...]], velocity: Array) -> None:
        """Put the carried posts' starts somewhere, m, from where they move on, m/s, ``(posts, 3)`` each."""
        self._time = np.float64(0.0)  # so that no bit depends on what this simulator moved before
        for carriage, at, rate in zip(self._carriages, start, velocity, strict=True):
            carriage.put(np.array(at), np.array(rate))

    def control_step(self, couple: Array, force: Array | None = None, substeps: int | None = None) -> float:
        """Move by a control step under a couple ``(3, n_elements)`` in N m and a force ``(3, n_nodes)`` in N.

        Returns:
            The largest force of the posts on any node within the step, N.
        """
        self._loads.couple, self._loads.force = couple, force
        self._largest[0] = 0.0
        for _ in range(self._parameters.substeps if substeps is None else substeps):
            self._time = self._stepper.step(self._simulator, self._time, np.float64(self._parameters.dt))
        return self._largest[0]


def simulate(
    parameters: RodParameters,
    couple: Callable[[int], Array],
    steps: int,
    posts: Sequence[Post] = (),
    force: Callable[[int], Array] | None = None,
    pruning: bool = False,
    post_velocity: Callable[[int], Array] | None = None,
) -> History:
    """Run ``steps`` control steps; ``couple(step)`` is ``(3, n_elements)`` and ``force(step)`` ``(3, n_nodes)``.

    ``post_velocity(step)`` is the posts', m/s, ``(posts, 3)``; without it they stand still.
    PyElastica skips cylinders by bounding boxes, which miss contacts: only with ``pruning`` it does so here.
    """
    arm, forces, states = Arm(parameters, posts, carried=post_velocity is not None), [], []
    start = np.array([post.start for post in posts])
    with watched_pruning(pruning) as watched:
        for step in range(steps):
            if post_velocity is not None:
                arm.carry(list(start), post_velocity(step))
                start = start + parameters.control_dt * post_velocity(step)
            forces.append(arm.control_step(couple(step), None if force is None else force(step)))
            states.append([array.copy() for array in arm.state])
    position, director, velocity, omega = (np.stack(series) for series in zip(*states, strict=True))
    return History(position, director, velocity, omega, np.array(forces), watched.missed)


def _add_cylinder(
    simulator: _Simulator,
    rods: Sequence[ea.CosseratRod],
    post: Post,
    carriage: Carriage | None,
    parameters: RodParameters,
) -> None:
    axis = np.array(post.axis)
    normal = np.eye(3)[np.abs(axis).argmin()]
    normal = normal - (normal @ axis) * axis
    cylinder = ea.Cylinder(
        np.array(post.start), axis, normal / np.linalg.norm(normal), post.length, post.radius, density=1000.0
    )
    simulator.append(cylinder)
    if carriage is None:
        base = {"constrained_position_idx": (0,), "constrained_director_idx": (0,)}
        simulator.constrain(cylinder).using(ea.OneEndFixedBC, **base)
    else:
        simulator.constrain(cylinder).using(_Carried, carriage=carriage)
    for rod in rods:
        simulator.detect_contact_between(rod, cylinder).using(
            ea.RodCylinderContact,
            k=parameters.contact_stiffness,
            nu=parameters.contact_damping,
            velocity_damping_coefficient=parameters.velocity_damping_coefficient,
            friction_coefficient=parameters.friction_coefficient,
        )


def posts_of(cylinders: Cylinders, row: int) -> tuple[Post, ...]:
    """Make posts of the cylinders that exist in one environment."""
    columns = (getattr(cylinders, name)[row][cylinders.mask[row]].double().tolist() for name in Post._fields)
    return tuple(
        Post(tuple(start), tuple(axis), length, radius) for start, axis, length, radius in zip(*columns, strict=True)
    )


def as_cylinders(per_environment: Sequence[Sequence[Post]], dtype: torch.dtype = torch.float64) -> Cylinders:
    """Make our backends' cylinders of each environment's posts, padded with masked ones to the longest list."""
    size = max(map(len, per_environment))
    filler = Post((0.0, 0.0, 0.0), UP, 1.0, 1.0)  # as wide as the arm is long: an unread mask would show
    padded = [[*posts, *[filler] * (size - len(posts))] for posts in per_environment]
    fields = {
        name: torch.tensor([[getattr(post, name) for post in posts] for posts in padded], dtype=dtype)
        for name in Post._fields
    }
    mask = torch.tensor([[i < len(posts) for i in range(size)] for posts in per_environment])
    return Cylinders(**fields, mask=mask, batch_size=[len(padded)])
