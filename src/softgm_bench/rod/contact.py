"""This module computes PyElastica's penalty forces between rods and cylinders.

Vectors over elements keep PyElastica's layout, components before elements. A pair (cylinder, element) adds one
dimension in front: ``(num_envs, n_cylinders, 3, n_elements)``. There are no matrix products, whose rounding depends on
the batch: on the CPU, no bit of an environment depends on its neighbours.
"""

import math

import torch
from torch import Tensor

from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders

# |sin| of the angle between two axes below which PyElastica treats them as parallel, squared.
_PARALLEL = 1e-6


def element_length(position: Tensor) -> Tensor:
    """Return the elements' current lengths ``(..., n_elements)`` in m, with PyElastica's guard of 1e-14 m.

    ``position`` holds the nodes, ``(..., 3, n_nodes)``.
    """
    return safe_norm(position[..., 1:] - position[..., :-1]) + 1e-14


def element_radius(position: Tensor, volume: Tensor) -> Tensor:
    """Return the current radii of incompressible elements in m (Gazzola et al. 2018, section 2.3).

    Args:
        position: ``(num_envs, 3, n_nodes)``.
        volume: conserved volumes of the elements, m^3, ``(n_elements,)`` or ``(num_envs, n_elements)``.

    Returns:
        ``(num_envs, n_elements)``.
    """
    return (volume / element_length(position) / math.pi).sqrt()


def safe_norm(vector: Tensor, dim: int = -2) -> Tensor:
    """Return the Euclidean norm along ``dim``, whose gradient at the zero vector is zero instead of NaN."""
    square = (vector * vector).sum(dim)
    positive = square > 0.0
    return torch.where(positive, torch.where(positive, square, 1.0).sqrt(), square)  # the last keeps 0 and NaN


def contact_forces(
    position: Tensor,
    velocity: Tensor,
    radius: Tensor,
    cylinders: Cylinders,
    parameters: RodParameters,
    cylinder_velocity: Tensor | None = None,
    friction: Tensor | None = None,
) -> Tensor:
    """Return the forces of cylinders on nodes, N (PyElastica's ``_calculate_contact_forces_rod_cylinder``).

    Its quirks are kept: an element's segment starts at the element's midpoint and has its full edge, and the first and
    last elements split their force 2/3 : 4/3 between end and inner node. Its bounding-box pruning, which misses
    contacts, is not: every pair is computed.

    Args:
        position: ``(num_envs, 3, n_nodes)``.
        velocity: ``(num_envs, 3, n_nodes)``.
        radius: current radii, ``(num_envs, n_elements)``.
        cylinders: of the same ``num_envs``; values of masked ones are never read.
        parameters: stiffness, damping and friction.
        cylinder_velocity: m/s, ``(num_envs, n_cylinders, 3)``, PyElastica's ``velocity_cylinder``; None: they rest.
        friction: the environments' coefficients of friction, ``(num_envs, 1, 1)``; None: the parameters'.

    Returns:
        ``(num_envs, 3, n_nodes)`` in the world frame.
    """
    if cylinders.mask.shape[1] == 0:
        return torch.zeros_like(position)
    cylinder_start, cylinder_edge, cylinder_radius = _existing(cylinders)
    centre = 0.5 * (position[:, None, :, 1:] + position[:, None, :, :-1])
    edge = position[:, None, :, 1:] - position[:, None, :, :-1]
    # Relative velocity of the cylinder, seen from the element.
    approach = -0.5 * (velocity[:, None, :, 1:] + velocity[:, None, :, :-1])
    if cylinder_velocity is not None:
        approach = approach + cylinder_velocity[..., None]

    gap = shortest_connection(centre, edge, cylinder_start, cylinder_edge)
    distance = safe_norm(gap)
    penetration = radius[:, None] + cylinder_radius - distance
    touching = cylinders.mask[:, :, None] & (penetration > 0.0)
    force = _pair_forces(gap, distance, penetration, approach, touching, parameters, friction)
    # One after the other, so that a masked cylinder's zeros change no bit; sum() may group them.
    return -_elements_to_nodes(force.cumsum(1)[:, -1])


def shortest_connection(start1: Tensor, edge1: Tensor, start2: Tensor, edge2: Tensor) -> Tensor:
    """Return the vector from segment 1 to segment 2 at their closest points, as PyElastica's ``_find_min_dist``.

    Args:
        start1: start of segment 1, ``(..., 3, n)``; all four broadcast.
        edge1: its end minus its start.
        start2: start of segment 2.
        edge2: its end minus its start.

    Returns:
        ``(..., 3, n)``. For nearly parallel segments PyElastica's shortcut, which isn't always the minimum.
    """
    between = start2 - start1
    e11, e12, e22 = _dot(edge1, edge1), _dot(edge1, edge2), _dot(edge2, edge2)
    b1, b2 = _dot(between, edge1), _dot(between, edge2)

    # t runs along segment 1, s along segment 2. Parallel: project one start, then project back.
    parallel = (1.0 - e12 * e12 / (e11 * e22)).abs() < _PARALLEL
    t_parallel = (b1 / e11).clamp(0.0, 1.0)
    s_parallel = ((t_parallel * e12 - b2) / e22).clamp(0.0, 1.0)

    # Otherwise the closest points of the two infinite lines, where both lie on the segments...
    s_line = (e12 * b1 - e11 * b2) / torch.where(parallel, 1.0, e11 * e22 - e12 * e12)
    t_line = (e12 * s_line + b1) / e11
    on_both = (s_line >= 0.0) & (s_line <= 1.0) & (t_line >= 0.0) & (t_line <= 1.0)

    # ... and else the nearest of the four pairs (end of one segment, its projection on the other).
    s_end, t_end = _nearest_end(e11, e12, e22, b1, b2)

    s = torch.where(parallel, s_parallel, torch.where(on_both, s_line, s_end))
    t = torch.where(parallel, t_parallel, torch.where(on_both, t_line, t_end))
    return between + s.unsqueeze(-2) * edge2 - t.unsqueeze(-2) * edge1


def _nearest_end(e11: Tensor, e12: Tensor, e22: Tensor, b1: Tensor, b2: Tensor) -> tuple[Tensor, Tensor]:
    """Parameters ``s, t`` of the closest pair in which one point is an end; dot products as in the caller."""
    zero, one = torch.zeros_like(b1), torch.ones_like(b1)
    s = torch.stack([zero, one, (-b2 / e22).clamp(0.0, 1.0), ((e12 - b2) / e22).clamp(0.0, 1.0)])
    t = torch.stack([(b1 / e11).clamp(0.0, 1.0), ((b1 + e12) / e11).clamp(0.0, 1.0), zero, one])
    # Squared distance less |between|^2, which all four share.
    square = s * (s * e22 + 2.0 * b2) + t * (t * e11 - 2.0 * b1) - 2.0 * s * t * e12
    nearest = square.argmin(dim=0, keepdim=True)
    return s.gather(0, nearest)[0], t.gather(0, nearest)[0]


def _pair_forces(
    gap: Tensor,
    distance: Tensor,
    penetration: Tensor,
    approach: Tensor,
    touching: Tensor,
    parameters: RodParameters,
    friction: Tensor | None,
) -> Tensor:
    """Half the force of the rod on the cylinder for every pair, ``(num_envs, n_cylinders, 3, n_elements)``.

    ``gap`` and ``approach`` are vectors (..., 3, n_elements); the others scalars (..., n_elements).
    """
    normal = gap / torch.where(distance > 0.0, distance, 1.0).unsqueeze(-2)
    normal_speed = _dot(approach, normal)
    magnitude = 0.5 * (parameters.contact_stiffness * penetration - parameters.contact_damping * normal_speed)
    magnitude = torch.where(touching, magnitude, 0.0)
    force = magnitude.unsqueeze(-2) * normal
    if parameters.friction_coefficient == 0.0 or parameters.velocity_damping_coefficient == 0.0:
        return force
    # Regularised Coulomb friction: viscous up to the Coulomb limit, against the slip.
    slip = approach - normal_speed.unsqueeze(-2) * normal
    slip_speed = safe_norm(slip)
    limit = (parameters.friction_coefficient if friction is None else friction) * magnitude.abs()
    drag = torch.minimum(parameters.velocity_damping_coefficient * slip_speed, limit) / (slip_speed + 1e-14)
    return force - drag.unsqueeze(-2) * slip


def _existing(cylinders: Cylinders) -> tuple[Tensor, Tensor, Tensor]:
    """Start and edge ``(num_envs, n_cylinders, 3, 1)`` and radius ``(num_envs, n_cylinders, 1)``.

    Masked cylinders become harmless ones, because a NaN in a discarded branch still poisons gradients.
    """
    mask = cylinders.mask[..., None]
    start = torch.where(mask, cylinders.start, 0.0)
    edge = torch.where(mask, cylinders.length[..., None] * cylinders.axis, 1.0)
    radius = torch.where(mask, cylinders.radius[..., None], 0.0)
    return start[..., None], edge[..., None], radius


def _elements_to_nodes(force: Tensor) -> Tensor:
    """Give each element's force ``(num_envs, 3, n_elements)`` to its two nodes, the outermost ones 2/3 : 4/3."""
    share = force.new_ones(force.shape[-1])
    first = torch.cat([share[:1] * (2.0 / 3.0), share[1:-1], share[-1:] * (4.0 / 3.0)])
    zero = torch.zeros_like(force[..., :1])
    return torch.cat([force * first, zero], dim=-1) + torch.cat([zero, force * first.flip(0)], dim=-1)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Dot product over the components, dimension -2."""
    return (a * b).sum(-2)
