# Compiled callees reach a function as globals (see jit), out of the linters' sight.
# ruff: noqa: F821
# mypy: disable-error-code="name-defined"
"""Rod-cylinder contact of the Numba kernel: PyElastica's ``RodCylinderContact`` without its pruning.

A cylinder is looked at only when it might touch. When it is, the distance from its axis to the nearest element is
stored; until the rod can have travelled that far, the cylinder costs nothing, and all of them together one comparison
a substep. Elements are then screened by a vectorised distance, and the few that may touch go through PyElastica's
closest-point search. Both screens are bounds, so no contact is missed.
"""

from collections.abc import Callable
from math import sqrt
from typing import Any, NamedTuple

import numpy as np

from softgm_bench.rod.numba_kernel import jit, larger
from softgm_bench.rod.numba_layout import Layout

# columns of a cylinder's row
START, EDGE, RADIUS, NEXT_CHECK, COLUMNS = 0, 3, 6, 7, 8
# entries of the contact parameters
STIFFNESS, DAMPING, FRICTION, SLIP_DAMPING = 0, 1, 2, 3


class Contact(NamedTuple):
    """Compiled functions on one rod's buffer and its cylinders."""

    reach: Callable[..., Any]
    add_contact: Callable[..., Any]


def make_contact(layout: Layout, real: type, touch: Callable[..., Any]) -> Contact:
    """Compile for one layout and one precision; ``touch`` is the force of one cylinder on one element."""
    p, n = layout, layout.n
    never = real(np.inf)

    def add_contact(s, cylinders, travelled, extent, contact, volume):
        """External force plus contact with every cylinder that is due.

        Args:
            s: the rod's buffer, with lengths of this substep.
            cylinders: ``(n_cylinders, 8)``; the last column, the travel at which the cylinder may touch, is updated.
            travelled: bound on how far any node has moved since the step began, m.
            extent: of the elements at this substep, m, see ``reach``.
            contact: stiffness, damping, friction and slip damping coefficients.
            volume: largest element volume, m^3.

        Returns:
            Whether contact was added, and how far the rod must travel until any cylinder is due.
        """
        copied, soonest = False, never
        for c in range(cylinders.shape[0]):
            cylinder = cylinders[c]
            if cylinder[NEXT_CHECK] < travelled + extent:
                gap = real(sqrt(nearest(s, cylinder))) - cylinder[RADIUS]
                cylinder[NEXT_CHECK] = travelled + gap
                if gap <= extent:
                    if not copied:
                        copied = True
                        for k in range(n + 1):
                            s[p.fx + k] = s[p.gx + k]
                            s[p.fy + k] = s[p.gy + k]
                            s[p.fz + k] = s[p.gz + k]
                    limit = (extent + cylinder[RADIUS]) ** 2
                    for k in range(n):
                        if s[p.distance2 + k] <= limit:
                            touch(s, k, cylinder, contact, volume)
            soonest = min(soonest, cylinder[NEXT_CHECK])
        return copied, soonest

    return Contact(
        reach=_make_reach(p, real),
        add_contact=jit(add_contact, nearest=_make_nearest(p, real), touch=touch),
    )


def _make_reach(layout: Layout, real: type) -> Callable[..., Any]:
    p, n = layout, layout.n
    inverse_pi = real(1.0 / np.pi)

    def reach(s, volume):
        """Bound on element radius plus length: no element reaches further from its midpoint."""
        longest, shortest = s[p.length], -s[p.length]
        for k in range(n):
            longest = larger(longest, s[p.length + k])
            shortest = larger(shortest, -s[p.length + k])
        return real(sqrt(volume * inverse_pi / -shortest)) + longest

    return jit(reach)


def _make_nearest(layout: Layout, real: type) -> Callable[..., Any]:
    p, n = layout, layout.n
    zero, half, one, far = real(0.0), real(0.5), real(1.0), real(np.finfo(real).max)

    def nearest(s, cylinder):
        """Squared distance of every element's midpoint to the cylinder's axis segment; returns the smallest."""
        cx, cy, cz = cylinder[START], cylinder[START + 1], cylinder[START + 2]
        ex, ey, ez = cylinder[EDGE], cylinder[EDGE + 1], cylinder[EDGE + 2]
        inverse = one / (ex * ex + ey * ey + ez * ez)
        smallest = -far
        for k in range(n):
            dx = half * (s[p.px + k] + s[p.px + k + 1]) - cx
            dy = half * (s[p.py + k] + s[p.py + k + 1]) - cy
            dz = half * (s[p.pz + k] + s[p.pz + k + 1]) - cz
            along = min(max((dx * ex + dy * ey + dz * ez) * inverse, zero), one)
            dx -= along * ex
            dy -= along * ey
            dz -= along * ez
            distance2 = dx * dx + dy * dy + dz * dz
            s[p.distance2 + k] = distance2
            smallest = larger(smallest, -distance2)
        return -smallest

    return jit(nearest)


def make_touch(layout: Layout, real: type) -> Callable[..., Any]:
    """Compile PyElastica's force of one cylinder on one element."""
    p, n = layout, layout.n
    zero, third, half, one, two = real(0.0), real(1.0 / 3.0), real(0.5), real(1.0), real(2.0)
    inverse_pi, tiny, smallest = real(1.0 / np.pi), real(1e-14), real(np.finfo(real).tiny)

    def touch(s, k, cylinder, contact, volume):
        """Force of one cylinder on one element (``_calculate_contact_forces_rod_cylinder``)."""
        length = s[p.length + k]
        radius = real(sqrt(volume * inverse_pi / length))
        dx, dy, dz = closest_points(
            half * (s[p.px + k] + s[p.px + k + 1]),
            half * (s[p.py + k] + s[p.py + k + 1]),
            half * (s[p.pz + k] + s[p.pz + k + 1]),
            s[p.px + k + 1] - s[p.px + k],
            s[p.py + k + 1] - s[p.py + k],
            s[p.pz + k + 1] - s[p.pz + k],
            cylinder[START],
            cylinder[START + 1],
            cylinder[START + 2],
            cylinder[EDGE],
            cylinder[EDGE + 1],
            cylinder[EDGE + 2],
        )
        distance = real(sqrt(dx * dx + dy * dy + dz * dz))
        penetration = radius + cylinder[RADIUS] - distance
        if not penetration > zero:
            return
        inverse = one / max(distance, smallest)  # where the axes cross there is no direction, and no force
        dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
        # velocity of the cylinder (at rest) relative to the element
        ux = -half * (s[p.vx + k] + s[p.vx + k + 1])
        uy = -half * (s[p.vy + k] + s[p.vy + k + 1])
        uz = -half * (s[p.vz + k] + s[p.vz + k + 1])
        normal = ux * dx + uy * dy + uz * dz
        force = half * (contact[STIFFNESS] * penetration - contact[DAMPING] * normal)
        fx, fy, fz = force * dx, force * dy, force * dz
        if contact[FRICTION] > zero:
            ux, uy, uz = ux - normal * dx, uy - normal * dy, uz - normal * dz
            slip = real(sqrt(ux * ux + uy * uy + uz * uz))
            friction = min(contact[SLIP_DAMPING] * slip, contact[FRICTION] * abs(force)) / (slip + tiny)
            fx, fy, fz = fx - friction * ux, fy - friction * uy, fz - friction * uz
        # the end elements lean on their free and fixed nodes with half the weight, as in PyElastica
        first, second = one, one
        if k == 0:
            first, second = two * third, two * two * third
        elif k == n - 1:
            first, second = two * two * third, two * third
        s[p.fx + k] -= first * fx
        s[p.fy + k] -= first * fy
        s[p.fz + k] -= first * fz
        s[p.fx + k + 1] -= second * fx
        s[p.fy + k + 1] -= second * fy
        s[p.fz + k + 1] -= second * fz

    return jit(touch, closest_points=_make_closest_points(real))


def _make_closest_points(real: type) -> Callable[..., Any]:
    zero, one, threshold = real(0.0), real(1.0), real(1e-6)

    def closest_points(x, y, z, ax, ay, az, u, v, w, bx, by, bz):
        """Vector from the element's segment (x, a) to the cylinder's axis (u, b) at their closest points.

        PyElastica's ``_find_min_dist``, with its threshold for parallel segments.
        """
        aa = ax * ax + ay * ay + az * az
        ab = ax * bx + ay * by + az * bz
        bb = bx * bx + by * by + bz * bz
        rx, ry, rz = u - x, v - y, w - z
        ra = rx * ax + ry * ay + rz * az
        rb = rx * bx + ry * by + rz * bz
        determinant = aa * bb - ab * ab
        if abs(determinant) < threshold * (aa * bb):
            t = min(max(ra / aa, zero), one)
            q = min(max((t * ab - rb) / bb, zero), one)
            return rx + q * bx - t * ax, ry + q * by - t * ay, rz + q * bz - t * az
        q = (ab * ra - aa * rb) / determinant
        t = (ab * q + ra) / aa
        if q < zero or q > one or t < zero or t > one:
            # the best of the four ends against the other segment
            q, t = zero, min(max(ra / aa, zero), one)
            best = (rx - t * ax) ** 2 + (ry - t * ay) ** 2 + (rz - t * az) ** 2
            try_t = min(max((ra + ab) / aa, zero), one)
            d = (rx + bx - try_t * ax) ** 2 + (ry + by - try_t * ay) ** 2 + (rz + bz - try_t * az) ** 2
            if d < best:
                best, q, t = d, one, try_t
            try_q = min(max(-rb / bb, zero), one)
            d = (rx + try_q * bx) ** 2 + (ry + try_q * by) ** 2 + (rz + try_q * bz) ** 2
            if d < best:
                best, q, t = d, try_q, zero
            try_q = min(max((ab - rb) / bb, zero), one)
            d = (rx + try_q * bx - ax) ** 2 + (ry + try_q * by - ay) ** 2 + (rz + try_q * bz - az) ** 2
            if d < best:
                q, t = try_q, one
        return rx + q * bx - t * ax, ry + q * by - t * ay, rz + q * bz - t * az

    return jit(closest_points)
