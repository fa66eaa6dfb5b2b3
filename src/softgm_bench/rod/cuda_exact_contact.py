"""``contact_model="exact"`` of the CUDA kernel: the scalar twin of ``exact_contact``, which explains the model."""

from collections.abc import Callable, Sequence
from math import sqrt
from typing import Any

import numpy as np

from softgm_bench.rod.cuda_kernel import clip, device, larger, smaller
from softgm_bench.rod.exact_contact import GAUSS_NODES, GAUSS_WEIGHTS


def make_touch_exact(real: type) -> Callable[..., Any]:
    """Device function that takes the place of PyElastica's in ``cuda_contact``.

    Stiffness, damping and slip damping among the coefficients are the parameters' divided by ``contact_length``.
    """
    zero, one = real(0.0), real(1.0)
    interval = _make_interval(real)
    quadrature = _make_quadrature(real, list(zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True)))

    def touch(
        c, k, x, y, z, ex, ey, ez, vx, vy, vz, rx, ry, rz, own_radius, b, i, start, axis, length, radius
    ):  # fmt: skip
        """Force of cylinder ``i`` on the two nodes of an element: the density's integral over the contact."""
        ax, ay, az, extent = axis[b, i, 0], axis[b, i, 1], axis[b, i, 2], length[b, i]
        norm = real(sqrt(ax * ax + ay * ay + az * az))
        inverse = one / norm
        ax, ay, az, extent = ax * inverse, ay * inverse, az * inverse, extent * norm
        x, y, z = x - start[b, i, 0], y - start[b, i, 1], z - start[b, i, 2]
        reach = own_radius + radius[b, i]
        enter, leave = interval(x, y, z, ex, ey, ez, ax, ay, az, extent, reach * reach)
        if not leave > enter:
            return zero, zero, zero, zero, zero, zero
        fx, fy, fz, gx, gy, gz = quadrature(
            c, enter, leave - enter, x, y, z, ex, ey, ez, -vx, -vy, -vz, vx - rx, vy - ry, vz - rz,
            ax, ay, az, extent, reach,
        )  # fmt: skip
        scale = -c.rest_length * (leave - enter)
        return scale * (fx - gx), scale * (fy - gy), scale * (fz - gz), scale * gx, scale * gy, scale * gz

    return device(touch)


def _make_quadrature(real: type, points: Sequence[tuple[float, float]]) -> Callable[..., Any]:
    """Gauss-Legendre sums of the density and of its moment about the first node, unrolled at compile time."""
    zero, node, weight = real(0.0), real(points[0][0]), real(points[0][1])
    density = _make_density(real)

    def nothing(
        c, enter, span, x, y, z, ex, ey, ez, ux, uy, uz, hx, hy, hz, ax, ay, az, extent, reach
    ):  # fmt: skip
        return zero, zero, zero, zero, zero, zero

    others = _make_quadrature(real, points[1:]) if len(points) > 1 else device(nothing)

    def quadrature(
        c, enter, span, x, y, z, ex, ey, ez, ux, uy, uz, hx, hy, hz, ax, ay, az, extent, reach
    ):  # fmt: skip
        xi = enter + node * span
        dx, dy, dz = density(
            c, x + xi * ex, y + xi * ey, z + xi * ez, ux + xi * hx, uy + xi * hy, uz + xi * hz,
            ax, ay, az, extent, reach,
        )  # fmt: skip
        fx, fy, fz, gx, gy, gz = others(
            c, enter, span, x, y, z, ex, ey, ez, ux, uy, uz, hx, hy, hz, ax, ay, az, extent, reach
        )
        share = weight * xi
        return (
            fx + weight * dx, fy + weight * dy, fz + weight * dz, gx + share * dx, gy + share * dy, gz + share * dz
        )  # fmt: skip

    return device(quadrature)


def _make_density(real: type) -> Callable[..., Any]:
    zero, one, two, tiny = real(0.0), real(1.0), real(2.0), real(1e-14)

    def density(c, x, y, z, ux, uy, uz, ax, ay, az, extent, reach):
        """Force of the rod on the cylinder per metre of rest arc length at one point, seen from the axis' start."""
        along = clip(x * ax + y * ay + z * az, zero, extent)
        dx, dy, dz = along * ax - x, along * ay - y, along * az - z
        distance = real(sqrt(dx * dx + dy * dy + dz * dz))
        inverse = one / distance if distance > zero else one
        dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
        normal = ux * dx + uy * dy + uz * dz
        force = c.contact_stiffness * (reach - distance) - c.contact_damping * normal
        fx, fy, fz = force * dx, force * dy, force * dz
        if c.friction > zero:
            ux, uy, uz = ux - normal * dx, uy - normal * dy, uz - normal * dz
            slip = real(sqrt(ux * ux + uy * uy + uz * uz))
            friction = smaller(two * c.slip_damping * slip, c.friction * abs(force)) / (slip + tiny)
            fx, fy, fz = fx - friction * ux, fy - friction * uy, fz - friction * uz
        return fx, fy, fz

    return device(density)


def _make_interval(real: type) -> Callable[..., Any]:
    zero, one, far = real(0.0), real(1.0), real(np.finfo(real).max)
    eps = float(np.finfo(real).eps)
    parallel, perpendicular = real(eps**1.5), real(eps * eps)
    quadratic = _make_quadratic(real)

    def interval(x, y, z, ex, ey, ez, ax, ay, az, extent, reach2):
        """Where on the element its centreline is inside of the capsule; ``exact_contact.contact_interval``."""
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
            first, last = -along / rate, (extent - along) / rate
            enter, leave = larger(enter, smaller(first, last)), smaller(leave, larger(first, last))
        elif along <= zero or along >= extent:
            enter, leave = far, -far
        if enter >= leave:
            enter, leave = far, -far
        # the two round ends
        first, last = quadratic(square, ex * x + ey * y + ez * z, x * x + y * y + z * z - reach2, zero)
        enter, leave = smaller(enter, first), larger(leave, last)
        x, y, z = x - extent * ax, y - extent * ay, z - extent * az
        first, last = quadratic(square, ex * x + ey * y + ez * z, x * x + y * y + z * z - reach2, zero)
        return larger(smaller(enter, first), zero), smaller(larger(leave, last), one)

    return device(interval)


def _make_quadratic(real: type) -> Callable[..., Any]:
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

    return device(quadratic)
