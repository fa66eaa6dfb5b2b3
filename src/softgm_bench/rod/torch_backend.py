"""The differentiable reference of the rod's motion is PyElastica 1.0.0's equations in batched PyTorch.

Every function takes tensors whose first dimension is the environment and whose last is the node, element or Voronoi
region. There are no matrix products, whose rounding depends on the batch: on the CPU, no bit of an environment depends
on its neighbours.
"""

import math
from collections.abc import Callable
from functools import partial
from types import SimpleNamespace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from softgm_bench.rod.bodies import Bodies, scales
from softgm_bench.rod.contact import contact_forces, element_length, element_radius
from softgm_bench.rod.exact_contact import exact_contact_forces
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.recomputation import Recomputed
from softgm_bench.rod.state import Cylinders, RodState, check_inputs

_CONTACT_FORCES = {"pyelastica": contact_forces, "exact": exact_contact_forces}

# Taylor coefficients, enough for float64's round-off below _SERIES_BELOW (a squared angle).
_SERIES_BELOW = 0.09
_SINE = tuple((-1.0) ** n / math.factorial(2 * n + 1) for n in range(7))
_COSINE = tuple((-1.0) ** n / math.factorial(2 * n + 2) for n in range(7))
_ANGLE_OVER_SINE = tuple(4.0**n * math.factorial(n) ** 2 / math.factorial(2 * n + 1) for n in range(11))


class Motion(NamedTuple):
    """These are the fields of ``RodState`` as plain tensors with the same shapes."""

    position: Tensor
    director: Tensor
    velocity: Tensor
    omega: Tensor


class Geometry(NamedTuple):
    """These quantities follow from node positions (Gazzola et al. 2018, eqs 3.3 and 3.4).

    Attributes:
        tangent: ``(num_envs, 3, n_elements)``.
        dilatation: length over rest length, ``(num_envs, n_elements)``.
        voronoi_dilatation: ``(num_envs, n_elements - 1)``.
    """

    tangent: Tensor
    dilatation: Tensor
    voronoi_dilatation: Tensor


class Obstacles(NamedTuple):
    """These are the cylinders as a control step begins and, where they move, their constant velocity in it, m/s.

    Where it is asked for, ``touched``, ``(num_envs,)`` bool, takes down which rods they push.
    """

    cylinders: Cylinders
    velocity: Tensor | None
    touched: Tensor | None

    def of(self, rows: Tensor) -> "Obstacles":
        """Select environments."""
        velocity, touched = (None if value is None else value[rows] for value in (self.velocity, self.touched))
        return Obstacles(self.cylinders[rows], velocity, touched)

    def at(self, time: float) -> "Obstacles":
        """Give them ``time`` s into the step."""
        if self.velocity is None:
            return self
        moved = self.cylinders.copy()
        moved.start = self.cylinders.start + time * self.velocity
        return self._replace(cylinders=moved)


class TorchBackend:
    """This backend moves rods by position Verlet with a clamped base, analytical damping and contact.

    It computes on the state's device and in its dtype.

    Attributes:
        parameters: of every rod.
        checkpoint_every: substeps in a segment whose intermediate values are computed again in the backward pass.
    """

    def __init__(self, parameters: RodParameters, checkpoint_every: int | None = None) -> None:
        """Hold the parameters; tensors are made at the first step on a device.

        With ``checkpoint_every``, a graph for gradients keeps one state per segment and the backward pass the
        intermediate values of one segment at a time; without, it keeps those of every substep. Gradients are the same.

        Raises:
            ValueError: if a segment would have no substeps.
        """
        if checkpoint_every is not None and checkpoint_every < 1:
            raise ValueError(f"checkpoint_every is {checkpoint_every}: a segment needs at least 1 substep")
        self.parameters = parameters
        self.checkpoint_every = checkpoint_every
        self._constants = rod_constants(parameters)
        self._tensors: dict[tuple[torch.dtype, torch.device], SimpleNamespace] = {}

    def control_step(
        self,
        state: RodState,
        couple: Tensor,
        force: Tensor | None = None,
        cylinders: Cylinders | None = None,
        active: Tensor | None = None,
        substeps: int | None = None,
        cylinder_velocity: Tensor | None = None,
        bodies: Bodies | None = None,
        touched: Tensor | None = None,
    ) -> RodState:
        """Advance by one control step, with loads held constant.

        Args:
            state: never changed.
            couple: external couple in the material frame on each element, N m, ``(num_envs, 3, n_elements)``.
            force: external force in the world frame on each node besides gravity, N, ``(num_envs, 3, n_nodes)``.
            cylinders: obstacles, of the same ``num_envs``.
            active: bool, ``(num_envs,)``; environments where it is False come back unchanged, bit for bit.
            substeps: Verlet steps of ``parameters.dt``; ``parameters.substeps`` by default.
            cylinder_velocity: with which the cylinders move on from where they are now, m/s, without turning,
                ``(num_envs, n_cylinders, 3)``; constant in the step. By default they stand still.
            bodies: factors on the parameters, an arm for each environment; by default all are the nominal one.
            touched: ``(num_envs,)`` bool, in which rods that a cylinder pushes in any substep are marked; entries of
                others stay as they are. By default nobody is told.

        Returns:
            A new state.

        Raises:
            ValueError: if the arguments' shapes do not fit together.
        """
        check_inputs(self.parameters, state, couple, force, cylinders, active, cylinder_velocity, bodies, touched)
        motion = Motion(state.position, state.director, state.velocity, state.omega)
        obstacles = _obstacles(cylinders, cylinder_velocity, touched)
        if active is None:
            moved = self._advance(motion, couple, force, obstacles, substeps, bodies)
        else:
            # Resting environments aren't computed at all: one that has diverged can't poison gradients.
            chosen = active.nonzero().squeeze(-1)
            met = None if obstacles is None else obstacles.of(chosen)
            moved = self._advance(
                Motion(*(old[chosen] for old in motion)),
                couple[chosen],
                None if force is None else force[chosen],
                met,
                substeps,
                None if bodies is None else bodies.of(chosen),
            )
            moved = Motion(*(old.index_put((chosen,), new) for old, new in zip(motion, moved, strict=True)))
            if touched is not None and met is not None and met.touched is not None:
                touched[chosen] = met.touched
        return RodState(**moved._asdict(), batch_size=state.batch_size)

    def _advance(
        self,
        motion: Motion,
        couple: Tensor,
        force: Tensor | None,
        obstacles: Obstacles | None,
        substeps: int | None,
        bodies: Bodies | None,
    ) -> Motion:
        """``control_step`` on plain tensors, every environment moving."""
        weight = self._constants_of(bodies, motion.position).weight
        external_force = weight if force is None else weight + force

        def segment(
            begun: int,
            end: int,
            motion: Motion,
            couple: Tensor,
            force: Tensor,
            obstacles: Obstacles | None,
            bodies: Bodies | None,
        ) -> Motion:
            constants = self._constants_of(bodies, motion.position)
            for substep in range(begun, end):
                # contact acts in the middle of a substep
                now = None if obstacles is None else obstacles.at((substep + 0.5) * self.parameters.dt)
                motion = self._substep(motion, constants, couple, force, now)
            return motion

        substeps = self.parameters.substeps if substeps is None else substeps
        if self.checkpoint_every is None or not torch.is_grad_enabled():
            motion = segment(0, substeps, motion, couple, external_force, obstacles, bodies)
        else:
            for begun in range(0, substeps, self.checkpoint_every):
                end = min(begun + self.checkpoint_every, substeps)
                motion = _recomputed(partial(segment, begun, end), motion, couple, external_force, obstacles, bodies)
        if motion.director.dtype == torch.float32:
            motion = motion._replace(director=straightened(motion.director))
        return motion

    def _substep(
        self,
        motion: Motion,
        constants: SimpleNamespace,
        couple: Tensor,
        external_force: Tensor,
        obstacles: Obstacles | None,
    ) -> Motion:
        """One position-Verlet step in the order of PyElastica's ``SymplecticStepperMixin.step``."""
        dt = self.parameters.dt
        motion = constrain_values(kinematic_step(motion, 0.5 * dt), constants)

        now = geometry(motion.position, constants)
        stress = internal_stress(motion.director, now, constants)
        force = internal_forces(motion.director, stress, now) + external_force
        if obstacles is not None:
            radius = element_radius(motion.position, constants.volume)
            contact_forces_of = _CONTACT_FORCES[self.parameters.contact_model]
            given = (radius, obstacles.cylinders, self.parameters, obstacles.velocity, constants.friction)
            contact = contact_forces_of(motion.position, motion.velocity, *given)
            force = force + contact
            if obstacles.touched is not None:
                obstacles.touched.logical_or_((contact != 0.0).flatten(1).any(1))
        torque = internal_torques(motion, stress, now, constants) + couple

        motion = dynamic_step(motion, force, torque, now.dilatation, constants, dt)
        motion = dampen(constrain_rates(motion), now.dilatation, constants)
        return constrain_values(kinematic_step(motion, 0.5 * dt), constants)

    def _constants_of(self, bodies: Bodies | None, tensor: Tensor) -> SimpleNamespace:
        """The constants of the nominal rod, or of every environment's, in the tensor's dtype and on its device.

        The latter have ``num_envs`` in front and sizes of 1 by which they broadcast.
        """
        nominal = self._constants_like(tensor)
        if bodies is None:
            return nominal
        s = scales(Bodies(*(factor.to(tensor) for factor in bodies)), self.parameters)
        own = {name: factor[:, None] for name, factor in s._asdict().items()}  # (num_envs, 1), ones of 3 dimensions:
        wide = {name: factor[..., None] for name, factor in own.items()}
        return SimpleNamespace(
            **(
                vars(nominal)
                | {
                    "volume": own["volume"] * nominal.volume,
                    "mass": wide["mass"] * nominal.mass,
                    "weight": wide["mass"] * nominal.weight,
                    "inertia": wide["inertia"] * nominal.inertia,
                    "shear": wide["shear"] * nominal.shear,
                    "bend": wide["bend"] * nominal.bend,
                    "translational_decay": nominal.translational_decay ** wide["translational"],
                    "rotational_decay_rate": wide["rotational"] * nominal.rotational_decay_rate,
                    "friction": wide["friction"] * self.parameters.friction_coefficient,
                }
            )
        )

    def _constants_like(self, tensor: Tensor) -> SimpleNamespace:
        """The rod's constants, and the nodes' weight ``(3, n_nodes)``, in the tensor's dtype and on its device."""
        key = (tensor.dtype, tensor.device)
        if key not in self._tensors:
            fields = self._constants._asdict()
            fields["friction"] = None  # the parameters'
            fields["weight"] = np.array(self.parameters.gravity)[:, None] * self._constants.mass
            for name, value in fields.items():
                if isinstance(value, np.ndarray):
                    fields[name] = torch.as_tensor(value, dtype=tensor.dtype, device=tensor.device)
            self._tensors[key] = SimpleNamespace(**fields)
        return self._tensors[key]


def _obstacles(cylinders: Cylinders | None, velocity: Tensor | None, touched: Tensor | None) -> Obstacles | None:
    if cylinders is None or velocity is None:
        return None if cylinders is None else Obstacles(cylinders, None, touched)
    # what a masked cylinder holds may be anything, and a NaN in a discarded branch still poisons gradients
    return Obstacles(cylinders, torch.where(cylinders.mask[..., None], velocity, 0.0), touched)


def _recomputed(
    segment: Callable[..., Motion],
    motion: Motion,
    couple: Tensor,
    force: Tensor,
    obstacles: Obstacles | None,
    bodies: Bodies | None,
) -> Motion:
    """``segment`` of the other arguments with gradients for each of them, through ``Recomputed``."""
    shapes: tuple[Tensor, ...] = ()
    if obstacles is not None:
        cylinders, velocity, _ = obstacles
        shapes = (cylinders.start, cylinders.axis, cylinders.length, cylinders.radius)
        shapes += () if velocity is None else (velocity,)

    def run(*inputs: Tensor) -> Motion:
        seen, (position, director, moving, omega, couple, force) = None, inputs[:6]
        given, factors = inputs[6 : 6 + len(shapes)], inputs[6 + len(shapes) :]
        if obstacles is not None:
            mask, size = obstacles.cylinders.mask, obstacles.cylinders.batch_size
            own = Cylinders(*given[:4], mask=mask, batch_size=size)
            seen = Obstacles(own, given[4] if len(given) > 4 else None, obstacles.touched)
        motion = Motion(position, director, moving, omega)
        return segment(motion, couple, force, seen, Bodies(*factors) if factors else None)

    return Motion(*Recomputed.apply(run, *motion, couple, force, *shapes, *(bodies or ())))


def kinematic_step(motion: Motion, duration: float) -> Motion:
    """Move nodes and turn directors with constant rates (PyElastica's ``overload_operator_kinematic_numba``).

    Directors turn by Rodrigues' formula and aren't re-orthonormalised. PyElastica divides the axis by
    ``|omega| + 1e-14``. Dropping that 1e-14 changes an angle by at most ``duration * 1e-14``, far below round-off, and
    keeps the true derivative at rest, where PyElastica's formula has a spurious zero.
    """
    angle = (duration * motion.omega)[:, :, None]  # (num_envs, 3, 1, n_elements): one vector for all three columns
    sine, cosine = sine_and_cosine_terms((angle * angle).sum(1, keepdim=True))
    turned = torch.linalg.cross(motion.director, angle, dim=1)
    director = motion.director + sine * turned + cosine * torch.linalg.cross(turned, angle, dim=1)
    return motion._replace(position=motion.position + duration * motion.velocity, director=director)


def straightened(director: Tensor) -> Tensor:
    """Return directors made orthonormal again by one Newton step ``(3 - Q Q^T) Q / 2`` towards the nearest rotation.

    PyElastica leaves directors to themselves. In float64 they stay within 1e-13; in float32 what they lose in each of
    thousands of steps adds up, and the arm drifts with it.
    """
    gram = (director[:, :, None] * director[:, None]).sum(3)  # (num_envs, 3, 3, n_elements)
    return 1.5 * director - 0.5 * (gram[:, :, :, None] * director[:, None]).sum(2)


def dynamic_step(
    motion: Motion, force: Tensor, torque: Tensor, dilatation: Tensor, constants: SimpleNamespace, dt: float
) -> Motion:
    """Accelerate (Gazzola et al. 2018, eqs 3.8 and 3.9; PyElastica's ``_update_accelerations``).

    Args:
        motion: velocities of which change.
        force: total on each node, world frame, ``(num_envs, 3, n_nodes)``.
        torque: total on each element, material frame, ``(num_envs, 3, n_elements)``.
        dilatation: ``(num_envs, n_elements)``.
        constants: of the rod.
        dt: s.
    """
    return motion._replace(
        velocity=motion.velocity + dt * (force / constants.mass),
        omega=motion.omega + dt * (torque / constants.inertia * dilatation[:, None]),
    )


def constrain_values(motion: Motion, constants: SimpleNamespace) -> Motion:
    """Put node 0 and element 0 where they are at rest (``OneEndFixedBC.constrain_values``)."""
    base, frame = constants.position[:, :1], constants.director[..., :1]
    num_envs = motion.position.shape[0]
    return motion._replace(
        position=torch.cat([base.expand(num_envs, -1, -1), motion.position[..., 1:]], dim=-1),
        director=torch.cat([frame.expand(num_envs, -1, -1, -1), motion.director[..., 1:]], dim=-1),
    )


def constrain_rates(motion: Motion) -> Motion:
    """Stop node 0 and element 0 (``OneEndFixedBC.constrain_rates``)."""
    return motion._replace(
        velocity=torch.cat([torch.zeros_like(motion.velocity[..., :1]), motion.velocity[..., 1:]], dim=-1),
        omega=torch.cat([torch.zeros_like(motion.omega[..., :1]), motion.omega[..., 1:]], dim=-1),
    )


def dampen(motion: Motion, dilatation: Tensor, constants: SimpleNamespace) -> Motion:
    """Let the rates decay exactly over one step (``AnalyticalLinearDamper.dampen_rates``, both protocols)."""
    rate = constants.rotational_decay_rate
    exponent = rate * dilatation[:, None] if constants.decay_follows_dilatation else rate
    return motion._replace(
        velocity=motion.velocity * constants.translational_decay, omega=motion.omega * torch.exp(-exponent)
    )


def geometry(position: Tensor, constants: SimpleNamespace) -> Geometry:
    """Return tangents and dilatations of nodes ``(num_envs, 3, n_nodes)`` (``_compute_all_dilatations``)."""
    length = element_length(position)
    voronoi_length = 0.5 * (length[:, 1:] + length[:, :-1])
    return Geometry(
        tangent=(position[..., 1:] - position[..., :-1]) / length[:, None],
        dilatation=length / constants.rest_length,
        voronoi_dilatation=voronoi_length / constants.rest_voronoi_length,
    )


def internal_stress(director: Tensor, now: Geometry, constants: SimpleNamespace) -> Tensor:
    """Return the stress n_L = S sigma with sigma = e Q t - (0, 0, 1) (``_compute_shear_stretch_strains``).

    Returns:
        In the material frame, ``(num_envs, 3, n_elements)``.
    """
    stretched = now.dilatation[:, None] * to_material(director, now.tangent)
    shear, stretch = stretched[:, :2], stretched[:, 2:] - 1.0
    return constants.shear * torch.cat([shear, stretch], dim=1)


def internal_forces(director: Tensor, stress: Tensor, now: Geometry) -> Tensor:
    """Return differences of Q^T n_L / e, N, ``(num_envs, 3, n_nodes)`` (eq. 3.8; ``_compute_internal_forces``)."""
    return difference(to_world(director, stress) / now.dilatation[:, None])


def internal_torques(motion: Motion, stress: Tensor, now: Geometry, constants: SimpleNamespace) -> Tensor:
    """Return the couples on the elements in N m (eq. 3.9; ``_compute_internal_torques``).

    Returns:
        In the material frame, ``(num_envs, 3, n_elements)``.
    """
    kappa = curvature(motion.director, constants)
    couple = constants.bend * kappa
    inverse_cube = (1.0 / now.voronoi_dilatation**3)[:, None]
    bend_twist = difference(couple * inverse_cube) + quadrature(
        torch.linalg.cross(kappa, couple, dim=1) * constants.rest_voronoi_length * inverse_cube
    )
    shear_stretch = torch.linalg.cross(to_material(motion.director, now.tangent), stress, dim=1) * constants.rest_length
    edge_velocity = motion.velocity[..., 1:] - motion.velocity[..., :-1]
    dilatation_rate = (now.tangent * edge_velocity).sum(1) / constants.rest_length
    momentum = constants.inertia * motion.omega / now.dilatation[:, None]  # J omega / e
    transport = torch.linalg.cross(momentum, motion.omega, dim=1)
    unsteady = momentum * (dilatation_rate / now.dilatation)[:, None]
    return bend_twist + shear_stretch + transport + unsteady


def curvature(director: Tensor, constants: SimpleNamespace) -> Tensor:
    """Return the strain kappa, the rotation vector between neighbours over the Voronoi length (``_inv_rotate``).

    Args:
        director: Q, ``(num_envs, 3, 3, n_elements)``.
        constants: of the rod.

    Returns:
        ``(num_envs, 3, n_elements - 1)``.
    """
    here, following = director[..., :-1], director[..., 1:]
    # R = Q_{k+1} Q_k^T has R_ij = following_i . here_j; summed over the columns of Q, this is its axis * 2 sin(theta).
    axis = torch.linalg.cross(following, here, dim=1).sum(2)
    trace = (here * following).sum(2).sum(1)
    # (1 - cos(theta)) / 2. Round-off may leave it negative, where PyElastica clips: the smooth function needs no clip.
    half_versine = (3.0 - trace) * 0.25
    return 0.5 * angle_over_sine(half_versine)[:, None] * axis / constants.rest_voronoi_length


def sine_and_cosine_terms(square: Tensor) -> tuple[Tensor, Tensor]:
    """Return ``sin(x) / x`` and ``(1 - cos(x)) / x^2`` as functions of ``x^2``, smooth at 0."""
    near = square < _SERIES_BELOW
    series = torch.where(near, square, 0.0)
    far = torch.where(near, 1.0, square)
    x = far.sqrt()
    return (
        torch.where(near, _polynomial(_SINE, series), x.sin() / x),
        torch.where(near, _polynomial(_COSINE, series), (1.0 - x.cos()) / far),
    )


def angle_over_sine(half_versine: Tensor) -> Tensor:
    """Return ``theta / sin(theta)`` as a function of ``w = (1 - cos(theta)) / 2``, smooth at 0.

    PyElastica's ``arccos`` has no derivative at theta = 0; this function's is 2/3. It is finite at theta = pi.
    """
    near = half_versine < 0.25 * _SERIES_BELOW
    series = torch.where(near, half_versine, 0.0)
    far = torch.where(near, 0.5, half_versine).clamp(max=1.0 - torch.finfo(half_versine.dtype).eps)
    closed_form = torch.asin(far.sqrt()) / (far * (1.0 - far)).sqrt()
    return torch.where(near, _polynomial(_ANGLE_OVER_SINE, series), closed_form)


def to_material(director: Tensor, vector: Tensor) -> Tensor:
    """Return Q v for each element: ``(num_envs, 3, 3, n_elements)`` times ``(num_envs, 3, n_elements)``."""
    return (director * vector[:, None]).sum(2)


def to_world(director: Tensor, vector: Tensor) -> Tensor:
    """Return Q^T v for each element: ``(num_envs, 3, 3, n_elements)`` times ``(num_envs, 3, n_elements)``."""
    return (director * vector[:, :, None]).sum(1)


def difference(values: Tensor) -> Tensor:
    """Return neighbours' differences, zeros beyond the ends: ``(..., n)`` becomes ``(..., n + 1)``.

    PyElastica: ``_two_point_difference``.
    """
    zero = torch.zeros_like(values[..., :1])
    return torch.cat([values, zero], dim=-1) - torch.cat([zero, values], dim=-1)


def quadrature(values: Tensor) -> Tensor:
    """Return neighbours' means, zeros beyond the ends, ``(..., n)`` to ``(..., n + 1)`` (``_trapezoidal``)."""
    zero = torch.zeros_like(values[..., :1])
    return 0.5 * (torch.cat([values, zero], dim=-1) + torch.cat([zero, values], dim=-1))


def _polynomial(coefficients: tuple[float, ...], x: Tensor) -> Tensor:
    """Horner's scheme; the first coefficient is the constant."""
    value = torch.full_like(x, coefficients[-1])
    for coefficient in coefficients[-2::-1]:
        value = value * x + coefficient
    return value
