# Compiled callees reach a function as globals (see callees), out of the linters' sight.
# ruff: noqa: F821
# mypy: disable-error-code="name-defined"
"""The force between one element and one cylinder is written here once, for the Numba and for the CUDA kernel.

Every ``make_*`` binds its constants in one precision, because one Python float would promote float32 arithmetic, and
compiles with what it is given: ``numba_kernel.jit`` or ``cuda_kernel.device``. ``contact`` (PyElastica's forces) and
``exact_contact`` (a force per unit of rest arc length) explain the two models; tests compare these functions with them.
A compiler is told to ``inline`` what both models share and what is long, so that the order of its sums is chosen where
it is used. A function that LLVM leaves as a call exists twice, alone and in its caller's machine code, with sums in two
orders: a process that compiles calls the first, one that reads the disk cache the second, and their digits differ.

``smaller``, ``larger`` and ``clip`` stand for ``min`` and ``max``, which Numba's CUDA target does not compile. They are
in this file because Numba, before it takes a function's machine code from the disk, looks for changes in its own file
alone.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import sqrt
from typing import Any, NamedTuple

import numpy as np

from softgm_bench.rod.exact_contact import GAUSS_NODES, GAUSS_WEIGHTS

# entries of a cylinder
START, EDGE, RADIUS = 0, 3, 6
# entries of the contact parameters
STIFFNESS, DAMPING, FRICTION, SLIP_DAMPING = 0, 1, 2, 3

Compiled = Callable[..., Any]
Compiler = Callable[..., Compiled]  # of a function and, by name, the compiled functions that it calls


def smaller(a, b):
    """Return the smaller of two numbers."""
    return b if b < a else a


def larger(a, b):
    """Return the larger of two numbers."""
    return b if b > a else a


def clip(value, low, high):
    """Return the value within the range from ``low`` to ``high``; NaN remains NaN."""
    value = low if low > value else value
    return high if high < value else value


def product(a, b):
    """Return the product of two numbers; CUDA kernels may bind one that no compiler fuses with a sum."""
    return a * b


@lru_cache
def _compiled(function: Compiled, compiler: Compiler) -> Compiled:
    return compiler(function)


class Pair(NamedTuple):
    """These are compiled functions on one element and one cylinder; scalars are in SI units.

    ``meet`` takes the positions ``x, y, z`` and ``nx, ny, nz`` of the element's first and second node, the element's
    radius, and ``cylinder``, whose entries are the start and the edge of its axis (three each) and its radius. It
    returns whether the two touch and a tuple for ``forces``.

    ``forces`` takes that tuple, the element's index ``k``, its nodes' velocities ``vx, vy, vz`` and ``wx, wy, wz``, its
    rest length, and the four entries of ``RodParameters.contact_coefficients``. It returns the forces with which the
    first and the second node push the cylinder, six numbers.
    """

    meet: Compiled
    forces: Compiled


def make_pair(contact_model: str, n_elements: int, real: type, compiler: Compiler) -> Pair:
    """Compile one contact model for rods of ``n_elements`` in one precision."""
    if contact_model == "exact":
        return Pair(_make_exact_meet(real, compiler), _make_exact_forces(real, compiler))
    return Pair(_make_pyelastica_meet(real, compiler), _make_pyelastica_forces(n_elements, real, compiler))


@lru_cache
def make_offset(compiler: Compiler) -> Compiled:
    """Compile ``offset``, which takes numbers of any one precision."""

    def offset(x, y, z, ax, ay, az, over_square, low, high):
        """Vector from the closest point of a segment on an axis through the origin to the point ``x, y, z``.

        The segment runs from ``low`` to ``high`` times the vector ``a``, whose squared norm is one over
        ``over_square``.
        """
        along = clip((x * ax + y * ay + z * az) * over_square, low, high)
        return x - along * ax, y - along * ay, z - along * az

    return compiler(offset, inline=True, clip=_compiled(clip, compiler))


def _make_pyelastica_meet(real: type, compiler: Compiler) -> Compiled:
    zero, half = real(0.0), real(0.5)

    def meet(x, y, z, nx, ny, nz, own_radius, cylinder):
        """PyElastica's element starts at its midpoint and has its full edge; see ``Pair``."""
        dx, dy, dz = closest_points(
            half * (x + nx), half * (y + ny), half * (z + nz), nx - x, ny - y, nz - z,
            cylinder[START], cylinder[START + 1], cylinder[START + 2],
            cylinder[EDGE], cylinder[EDGE + 1], cylinder[EDGE + 2],
        )  # fmt: skip
        distance = real(sqrt(dx * dx + dy * dy + dz * dz))
        penetration = own_radius + cylinder[RADIUS] - distance
        return penetration > zero, (dx, dy, dz, distance, penetration)

    return compiler(meet, inline=True, closest_points=_make_closest_points(real, compiler))


def _make_pyelastica_forces(n_elements: int, real: type, compiler: Compiler) -> Compiled:
    half, one, last = real(0.5), real(1.0), n_elements - 1
    less, more = real(2.0 / 3.0), real(4.0 / 3.0)

    def forces(found, k, vx, vy, vz, wx, wy, wz, rest, contact):
        """PyElastica's ``_calculate_contact_forces_rod_cylinder``; see ``Pair``."""
        dx, dy, dz, distance, penetration = found
        # velocity of the cylinder (at rest) relative to the element
        ux, uy, uz = -half * (vx + wx), -half * (vy + wy), -half * (vz + wz)
        fx, fy, fz = penalty(dx, dy, dz, distance, penetration, ux, uy, uz, half, contact[SLIP_DAMPING], contact)
        # the end elements lean on their free and fixed nodes with half the weight, as in PyElastica
        first, second = one, one
        if k == 0:
            first, second = less, more
        elif k == last:
            first, second = more, less
        return first * fx, first * fy, first * fz, second * fx, second * fy, second * fz

    return compiler(forces, inline=True, penalty=_make_penalty(real, compiler))


def _make_closest_points(real: type, compiler: Compiler) -> Compiled:
    zero, one, threshold = real(0.0), real(1.0), real(1e-6)

    def closest_points(x, y, z, ax, ay, az, u, v, w, bx, by, bz):
        """Vector from the segment (x, a), start and edge, to the segment (u, b) at their closest points.

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
            t = clip(ra / aa, zero, one)
            q = clip((t * ab - rb) / bb, zero, one)
            return rx + q * bx - t * ax, ry + q * by - t * ay, rz + q * bz - t * az
        q = (ab * ra - aa * rb) / determinant
        t = (ab * q + ra) / aa
        if q < zero or q > one or t < zero or t > one:
            # the best of the four ends against the other segment
            q, t = zero, clip(ra / aa, zero, one)
            best = (rx - t * ax) ** 2 + (ry - t * ay) ** 2 + (rz - t * az) ** 2
            try_t = clip((ra + ab) / aa, zero, one)
            d = (rx + bx - try_t * ax) ** 2 + (ry + by - try_t * ay) ** 2 + (rz + bz - try_t * az) ** 2
            if d < best:
                best, q, t = d, one, try_t
            try_q = clip(-rb / bb, zero, one)
            d = (rx + try_q * bx) ** 2 + (ry + try_q * by) ** 2 + (rz + try_q * bz) ** 2
            if d < best:
                best, q, t = d, try_q, zero
            try_q = clip((ab - rb) / bb, zero, one)
            d = (rx + try_q * bx - ax) ** 2 + (ry + try_q * by - ay) ** 2 + (rz + try_q * bz - az) ** 2
            if d < best:
                q, t = try_q, one
        return rx + q * bx - t * ax, ry + q * by - t * ay, rz + q * bz - t * az

    return compiler(closest_points, inline=True, clip=_compiled(clip, compiler))


@lru_cache
def _make_penalty(real: type, compiler: Compiler) -> Compiled:
    zero, one, tiny, smallest = real(0.0), real(1.0), real(1e-14), real(np.finfo(real).tiny)

    def penalty(dx, dy, dz, distance, penetration, ux, uy, uz, share, slip_damping, contact):
        """Force on a cylinder ``d`` away that moves at ``u`` seen from the rod: a damped spring with friction.

        ``share`` of what stiffness and damping alone would give. Regularised Coulomb friction acts against the slip,
        viscous with ``slip_damping`` up to the Coulomb limit.
        """
        inverse = one / larger(distance, smallest)  # where the axes cross there is no direction, and no force
        dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
        normal = ux * dx + uy * dy + uz * dz
        force = share * (contact[STIFFNESS] * penetration - contact[DAMPING] * normal)
        fx, fy, fz = force * dx, force * dy, force * dz
        if contact[FRICTION] > zero:
            ux, uy, uz = ux - normal * dx, uy - normal * dy, uz - normal * dz
            slip = real(sqrt(ux * ux + uy * uy + uz * uz))
            drag = smaller(slip_damping * slip, contact[FRICTION] * abs(force)) / (slip + tiny)
            fx, fy, fz = fx - drag * ux, fy - drag * uy, fz - drag * uz
        return fx, fy, fz

    return compiler(penalty, inline=True, smaller=_compiled(smaller, compiler), larger=_compiled(larger, compiler))


def _make_exact_meet(real: type, compiler: Compiler) -> Compiled:
    one = real(1.0)

    def meet(x, y, z, nx, ny, nz, own_radius, cylinder):
        """Interval of contact, and the element seen from the start of the cylinder's axis; see ``Pair``."""
        reach = own_radius + cylinder[RADIUS]
        bx, by, bz = cylinder[EDGE], cylinder[EDGE + 1], cylinder[EDGE + 2]
        length = real(sqrt(bx * bx + by * by + bz * bz))
        inverse = one / length
        ax, ay, az = bx * inverse, by * inverse, bz * inverse
        ex, ey, ez = nx - x, ny - y, nz - z
        x, y, z = x - cylinder[START], y - cylinder[START + 1], z - cylinder[START + 2]
        enter, leave = interval(x, y, z, ex, ey, ez, ax, ay, az, length, reach * reach)
        return leave > enter, (enter, leave, x, y, z, ex, ey, ez, ax, ay, az, length, reach)

    return compiler(meet, inline=True, interval=_make_interval(real, compiler))


def _make_exact_forces(real: type, compiler: Compiler) -> Compiled:
    points = [(real(node), real(weight)) for node, weight in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True)]

    def forces(found, k, vx, vy, vz, wx, wy, wz, rest, contact):
        """Gauss-Legendre quadrature over the interval of contact; see ``Pair``."""
        enter, leave, x, y, z, ex, ey, ez, ax, ay, az, length, reach = found
        # velocity of the cylinder (at rest) relative to the first node, and how it changes along the element
        fx, fy, fz, gx, gy, gz = quadrature(
            enter, leave - enter, x, y, z, ex, ey, ez, -vx, -vy, -vz, vx - wx, vy - wy, vz - wz,
            ax, ay, az, length, reach, contact,
        )  # fmt: skip
        scale = rest * (leave - enter)
        return scale * (fx - gx), scale * (fy - gy), scale * (fz - gz), scale * gx, scale * gy, scale * gz

    return compiler(forces, inline=True, quadrature=_make_quadrature(real, points, compiler))


def _make_quadrature(real: type, points: Sequence[tuple[Any, Any]], compiler: Compiler) -> Compiled:
    """Compile sums of the density and of its moment about the first node; a loop would need memory in CUDA."""
    zero, (node, weight) = real(0.0), points[-1]

    def nothing(
        enter, span, x, y, z, ex, ey, ez, ux, uy, uz, hx, hy, hz, ax, ay, az, length, reach, contact
    ):  # fmt: skip
        return zero, zero, zero, zero, zero, zero

    def quadrature(
        enter, span, x, y, z, ex, ey, ez, ux, uy, uz, hx, hy, hz, ax, ay, az, length, reach, contact
    ):  # fmt: skip
        fx, fy, fz, gx, gy, gz = others(
            enter, span, x, y, z, ex, ey, ez, ux, uy, uz, hx, hy, hz, ax, ay, az, length, reach, contact
        )
        xi = enter + node * span
        dx, dy, dz = density(
            x + xi * ex, y + xi * ey, z + xi * ez, ux + xi * hx, uy + xi * hy, uz + xi * hz,
            ax, ay, az, length, reach, contact,
        )  # fmt: skip
        share = weight * xi
        return (
            fx + weight * dx, fy + weight * dy, fz + weight * dz, gx + share * dx, gy + share * dy, gz + share * dz
        )  # fmt: skip

    fewer = _make_quadrature(real, points[:-1], compiler) if len(points) > 1 else compiler(nothing, inline=True)
    return compiler(quadrature, inline=True, others=fewer, density=_make_density(real, compiler))


@lru_cache
def _make_density(real: type, compiler: Compiler) -> Compiled:
    zero, one, two = real(0.0), real(1.0), real(2.0)

    def density(x, y, z, ux, uy, uz, ax, ay, az, length, reach, contact):
        """Force of the rod on the cylinder per metre of rest arc length at one point, seen from the axis' start."""
        dx, dy, dz = offset(x, y, z, ax, ay, az, one, zero, length)
        distance = real(sqrt(dx * dx + dy * dy + dz * dz))
        return penalty(-dx, -dy, -dz, distance, reach - distance, ux, uy, uz, one, two * contact[SLIP_DAMPING], contact)

    return compiler(density, offset=make_offset(compiler), penalty=_make_penalty(real, compiler))


def _make_interval(real: type, compiler: Compiler) -> Compiled:
    zero, one, far = real(0.0), real(1.0), real(np.finfo(real).max)
    eps = real(np.finfo(real).eps)
    parallel, perpendicular = real(float(eps) ** 1.5), eps * eps

    def interval(x, y, z, ex, ey, ez, ax, ay, az, length, reach2):
        """Interval of the element in which its centreline is in the capsule; ``exact_contact.contact_interval``."""
        along = x * ax + y * ay + z * az
        rate = ex * ax + ey * ay + ez * az
        square = ex * ex + ey * ey + ez * ez
        # the side: an infinite cylinder between two planes
        cx, cy, cz = x - along * ax, y - along * ay, z - along * az
        dx, dy, dz = ex - rate * ax, ey - rate * ay, ez - rate * az
        enter, leave = quadratic(
            dx * dx + dy * dy + dz * dz,
            dx * cx + dy * cy + dz * cz,
            cx * cx + cy * cy + cz * cz - reach2,
            parallel * square,
        )
        if rate * rate > perpendicular * square:
            first, last = -along / rate, (length - along) / rate
            enter, leave = larger(enter, smaller(first, last)), smaller(leave, larger(first, last))
        elif along <= zero or along >= length:
            enter, leave = far, -far
        if enter >= leave:
            enter, leave = far, -far
        # the two round ends
        first, last = quadratic(square, ex * x + ey * y + ez * z, x * x + y * y + z * z - reach2, zero)
        enter, leave = smaller(enter, first), larger(leave, last)
        x, y, z = x - length * ax, y - length * ay, z - length * az
        first, last = quadratic(square, ex * x + ey * y + ez * z, x * x + y * y + z * z - reach2, zero)
        return larger(smaller(enter, first), zero), smaller(larger(leave, last), one)

    return compiler(
        interval,
        quadratic=_make_quadratic(real, compiler),
        smaller=_compiled(smaller, compiler),
        larger=_compiled(larger, compiler),
    )


def _make_quadratic(real: type, compiler: Compiler) -> Compiled:
    zero, far = real(0.0), real(np.finfo(real).max)

    def quadratic(a, b, c, flat):
        """Interval in which ``a t^2 + 2 b t + c < 0``."""
        if a <= flat:
            if c < zero:
                return -far, far
            return far, -far
        discriminant = b * b - a * c
        if discriminant <= zero:
            return far, -far
        root = real(sqrt(discriminant))
        large = -(b + root) if b >= zero else root - b
        first, last = large / a, c / large
        return smaller(first, last), larger(first, last)

    return compiler(quadratic, smaller=_compiled(smaller, compiler), larger=_compiled(larger, compiler))
