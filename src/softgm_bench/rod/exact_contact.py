"""``contact_model="exact"`` integrates a contact force per unit of rest arc length over each element.

At arc length s the rod is a point x(s) on its centreline, linear between nodes and without PyElastica's half-element
shift. It feels ``f = kappa * penetration - nu * v_n`` along the normal from the closest point of the cylinder's axis
segment, where ``penetration = r_element + R - distance`` is positive, and regularised Coulomb friction. A cylinder is
therefore a capsule, as in PyElastica's model. What the force does not depend on is the mesh: neither its size nor where
the nodes happen to lie.

- kappa, nu and the viscous coefficient of friction are the parameters' divided by ``contact_length``. PyElastica
  applies the viscous coefficient once per node, that is twice per element; so does this model.
- Damping can pull while an element leaves a cylinder quickly, as in PyElastica's model, whose law is kept.
- A rod pressed beyond the cylinder's axis is pushed out on the far side: the force before that is at most
  ``kappa * (r + R)`` per metre. On the axis itself there is no direction and no force.
- With damping, the force's derivative is unbounded (though finite) at a grazing contact, whose length grows as the
  root of the penetration.
"""

import numpy as np
import torch
from torch import Tensor

from softgm_bench.rod.contact import _dot, _existing, safe_norm
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders

# Gauss-Legendre points per element and cylinder, on the unit interval.
GAUSS_POINTS = 3
GAUSS_NODES, GAUSS_WEIGHTS = (0.5 * x for x in np.polynomial.legendre.leggauss(GAUSS_POINTS))
GAUSS_NODES = GAUSS_NODES + 0.5


def exact_contact_forces(
    position: Tensor,
    velocity: Tensor,
    radius: Tensor,
    cylinders: Cylinders,
    parameters: RodParameters,
    cylinder_velocity: Tensor | None = None,
    friction: Tensor | None = None,
) -> Tensor:
    """Return the forces of cylinders on the rods' nodes in N, integrals of the density above over the contact.

    The interval of contact is found in closed form, so the quadrature sees a smooth function except where the element
    passes from the side of a cylinder to its round end. Each point's force goes to the element's two nodes by the lever
    rule. Without damping and friction, and at given radii, it is minus the gradient of an energy.

    Args:
        position: ``(num_envs, 3, n_nodes)``.
        velocity: ``(num_envs, 3, n_nodes)``.
        radius: current radii, ``(num_envs, n_elements)``.
        cylinders: of the same ``num_envs``; values of masked ones are never read.
        parameters: stiffness, damping, friction and the length that they refer to.
        cylinder_velocity: m/s, ``(num_envs, n_cylinders, 3)``; None: they rest.
        friction: the environments' coefficients of friction, ``(num_envs, 1, 1)``; None: the parameters'.

    Returns:
        ``(num_envs, 3, n_nodes)`` in the world frame.
    """
    if cylinders.mask.shape[1] == 0:
        return torch.zeros_like(position)
    cylinder_start, cylinder_edge, cylinder_radius = _existing(cylinders)
    length = safe_norm(cylinder_edge)  # (num_envs, n_cylinders, 1)
    axis = cylinder_edge / length.unsqueeze(-2)
    start = position[:, None, :, :-1] - cylinder_start  # (num_envs, n_cylinders, 3, n_elements)
    edge = (position[..., 1:] - position[..., :-1])[:, None]
    reach = radius[:, None] + cylinder_radius  # (num_envs, n_cylinders, n_elements)

    enter, leave = contact_interval(start, edge, axis, length, reach)
    touching = cylinders.mask[:, :, None] & (leave > enter)
    enter, leave = torch.where(touching, enter, 0.0), torch.where(touching, leave, 0.0)

    # One more dimension in front: the points of the quadrature.
    nodes, weights = (position.new_tensor(x)[:, None, None, None] for x in (GAUSS_NODES, GAUSS_WEIGHTS))
    xi = (enter + nodes * (leave - enter)).unsqueeze(-2)  # (points, num_envs, n_cylinders, 1, n_elements)
    approach = -(velocity[:, None, :, :-1] + xi * (velocity[..., 1:] - velocity[..., :-1])[:, None])
    if cylinder_velocity is not None:
        approach = approach + cylinder_velocity[..., None]
    density = _force_density(start + xi * edge, approach, axis, length, reach, parameters, friction)
    rest_length = parameters.base_length / parameters.n_elements
    force = (weights * (rest_length * (leave - enter))).unsqueeze(-2) * density

    first, second = ((share * force).sum(0) for share in (1.0 - xi, xi))
    zero = torch.zeros_like(first[..., :1])
    pairs = torch.cat([first, zero], dim=-1) + torch.cat([zero, second], dim=-1)
    # One after the other, so that a masked cylinder's zeros change no bit; sum() may group them.
    return -pairs.cumsum(1)[:, -1]


def contact_interval(start: Tensor, edge: Tensor, axis: Tensor, length: Tensor, reach: Tensor) -> tuple[Tensor, Tensor]:
    """Return the interval of an element in which its centreline is inside of a capsule, in closed form.

    A capsule is convex and the union of a cylinder's side and two balls: the interval runs from the first entry into
    any of them to the last exit.

    Args:
        start: the element's first node, seen from the start of the cylinder's axis, ``(..., 3, n_elements)``.
        edge: second node minus first, ``(..., 3, n_elements)``.
        axis: unit vector of the cylinder, ``(..., 3, 1)``.
        length: of the axis segment, ``(..., 1)``.
        reach: the capsule's radius, ``(..., n_elements)``.

    Returns:
        ``enter, leave``, each ``(..., n_elements)`` in [0, 1] where the element is inside; elsewhere, not
        ``enter < leave``.
    """
    eps = torch.finfo(edge.dtype).eps
    along, rate = _dot(start, axis), _dot(edge, axis)
    square = _dot(edge, edge)
    across_start = start - along.unsqueeze(-2) * axis
    across_edge = edge - rate.unsqueeze(-2) * axis
    far_start = start - length.unsqueeze(-2) * axis
    reach2 = reach * reach

    # Elements this parallel stay at one distance from the axis, to round-off.
    side = _inside_quadratic(
        _dot(across_edge, across_edge),
        _dot(across_edge, across_start),
        _dot(across_start, across_start) - reach2,
        eps**1.5 * square,
    )
    slab = _inside_slab(along, rate, length, eps * eps * square)
    side = torch.maximum(side[0], slab[0]), torch.minimum(side[1], slab[1])
    empty = side[0] >= side[1]
    pieces = [(torch.where(empty, torch.inf, side[0]), torch.where(empty, -torch.inf, side[1]))]
    for centre_to_start in (start, far_start):
        constant = _dot(centre_to_start, centre_to_start) - reach2
        pieces.append(_inside_quadratic(square, _dot(edge, centre_to_start), constant, torch.zeros_like(square)))
    enter, leave = pieces[0]
    for first, last in pieces[1:]:
        enter, leave = torch.minimum(enter, first), torch.maximum(leave, last)
    return enter.clamp(min=0.0), leave.clamp(max=1.0)


def _inside_quadratic(a: Tensor, b: Tensor, c: Tensor, flat: Tensor) -> tuple[Tensor, Tensor]:
    """Interval in which ``a t^2 + 2 b t + c < 0``, infinite or (inf, -inf) where ``a <= flat`` or it has no roots."""
    is_flat = a <= flat
    discriminant = b * b - a * c
    crosses = (discriminant > 0.0) & ~is_flat
    root = torch.where(crosses, discriminant, 1.0).sqrt()
    # The root without cancellation, and the other one from their product c / a.
    large = -(b + torch.where(b >= 0.0, root, -root))
    one = large / torch.where(is_flat, 1.0, a)
    other = c / torch.where(crosses, large, 1.0)
    always = is_flat & (c < 0.0)
    first = torch.where(crosses, torch.minimum(one, other), torch.where(always, -torch.inf, torch.inf))
    last = torch.where(crosses, torch.maximum(one, other), torch.where(always, torch.inf, -torch.inf))
    return first, last


def _inside_slab(along: Tensor, rate: Tensor, length: Tensor, flat: Tensor) -> tuple[Tensor, Tensor]:
    """Interval in which ``0 < along + rate t < length``, infinite or (inf, -inf) where ``rate^2 <= flat``."""
    is_flat = rate * rate <= flat
    divisor = torch.where(is_flat, 1.0, rate)
    one, other = -along / divisor, (length - along) / divisor
    always = (along > 0.0) & (along < length)
    first = torch.where(is_flat, torch.where(always, -torch.inf, torch.inf), torch.minimum(one, other))
    last = torch.where(is_flat, torch.where(always, torch.inf, -torch.inf), torch.maximum(one, other))
    return first, last


def _force_density(
    point: Tensor,
    approach: Tensor,
    axis: Tensor,
    length: Tensor,
    reach: Tensor,
    parameters: RodParameters,
    friction: Tensor | None,
) -> Tensor:
    """Force of the rod on the cylinder per metre of rest arc length, ``(..., 3, n_elements)``, N/m.

    ``point`` is on the centreline, seen from the start of the cylinder's axis, ``approach`` the cylinder's velocity
    relative to it; shapes as in ``contact_interval``.
    """
    along = torch.minimum(_dot(point, axis).clamp(min=0.0), length)
    gap = along.unsqueeze(-2) * axis - point
    distance = safe_norm(gap)
    normal = gap / torch.where(distance > 0.0, distance, 1.0).unsqueeze(-2)
    normal_speed = _dot(approach, normal)
    stiffness = parameters.contact_stiffness / parameters.contact_length
    damping = parameters.contact_damping / parameters.contact_length
    magnitude = stiffness * (reach - distance) - damping * normal_speed
    force = magnitude.unsqueeze(-2) * normal
    if parameters.friction_coefficient == 0.0 or parameters.velocity_damping_coefficient == 0.0:
        return force
    slip = approach - normal_speed.unsqueeze(-2) * normal
    slip_speed = safe_norm(slip)
    viscous = 2.0 * parameters.velocity_damping_coefficient / parameters.contact_length * slip_speed
    limit = (parameters.friction_coefficient if friction is None else friction) * magnitude.abs()
    return force - (torch.minimum(viscous, limit) / (slip_speed + 1e-14)).unsqueeze(-2) * slip
