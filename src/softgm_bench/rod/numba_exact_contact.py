# Compiled callees reach a function as globals (see jit), out of the linters' sight.
# ruff: noqa: F821
# mypy: disable-error-code="name-defined"
"""``contact_model="exact"`` of the Numba kernel: the scalar twin of ``exact_contact``, which explains the model."""

from collections.abc import Callable
from functools import lru_cache
from math import sqrt
from typing import Any

import numpy as np

from softgm_bench.rod.exact_contact import GAUSS_NODES, GAUSS_WEIGHTS
from softgm_bench.rod.numba_contact import DAMPING, EDGE, FRICTION, RADIUS, SLIP_DAMPING, START, STIFFNESS
from softgm_bench.rod.numba_kernel import jit
from softgm_bench.rod.numba_layout import Layout


@lru_cache
def make_touch_exact(layout: Layout, real: type) -> Callable[..., Any]:
    """Compile ``touch`` for one layout and one precision.

    It takes the place of PyElastica's in ``numba_contact``. Entries STIFFNESS, DAMPING and SLIP_DAMPING of its argument
    ``contact`` are the parameters' divided by ``contact_length``.
    """
    p = layout
    zero, one, inverse_pi = real(0.0), real(1.0), real(1.0 / np.pi)
    points = tuple((real(node), real(weight)) for node, weight in zip(GAUSS_NODES, GAUSS_WEIGHTS, strict=True))

    def touch(s, k, cylinder, contact, volume):
        """Force of one cylinder on one element, by Gauss-Legendre quadrature over the interval of contact."""
        reach = real(sqrt(volume * inverse_pi / s[p.length + k])) + cylinder[RADIUS]
        length = real(
            sqrt(
                cylinder[EDGE] * cylinder[EDGE]
                + cylinder[EDGE + 1] * cylinder[EDGE + 1]
                + cylinder[EDGE + 2] * cylinder[EDGE + 2]
            )
        )
        inverse = one / length
        ax, ay, az = cylinder[EDGE] * inverse, cylinder[EDGE + 1] * inverse, cylinder[EDGE + 2] * inverse
        x, y, z = s[p.px + k] - cylinder[START], s[p.py + k] - cylinder[START + 1], s[p.pz + k] - cylinder[START + 2]
        ex, ey, ez = s[p.px + k + 1] - s[p.px + k], s[p.py + k + 1] - s[p.py + k], s[p.pz + k + 1] - s[p.pz + k]
        enter, leave = interval(x, y, z, ex, ey, ez, ax, ay, az, length, reach * reach)
        if not leave > enter:
            return
        # velocity of the cylinder (at rest) relative to the first node, and how it changes along the element
        ux, uy, uz = -s[p.vx + k], -s[p.vy + k], -s[p.vz + k]
        gx, gy, gz = s[p.vx + k] - s[p.vx + k + 1], s[p.vy + k] - s[p.vy + k + 1], s[p.vz + k] - s[p.vz + k + 1]
        fx, fy, fz, hx, hy, hz = zero, zero, zero, zero, zero, zero
        for node, weight in points:
            xi = enter + node * (leave - enter)
            dx, dy, dz = density(
                x + xi * ex,
                y + xi * ey,
                z + xi * ez,
                ux + xi * gx,
                uy + xi * gy,
                uz + xi * gz,
                ax,
                ay,
                az,
                length,
                reach,
                contact,
            )
            fx, fy, fz = fx + weight * dx, fy + weight * dy, fz + weight * dz
            share = weight * xi
            hx, hy, hz = hx + share * dx, hy + share * dy, hz + share * dz
        scale = s[p.rest + k] * (leave - enter)
        s[p.fx + k] -= scale * (fx - hx)
        s[p.fy + k] -= scale * (fy - hy)
        s[p.fz + k] -= scale * (fz - hz)
        s[p.fx + k + 1] -= scale * hx
        s[p.fy + k + 1] -= scale * hy
        s[p.fz + k + 1] -= scale * hz

    return jit(touch, interval=_make_interval(real), density=_make_density(real))


def _make_density(real: type) -> Callable[..., Any]:
    zero, one, two, tiny = real(0.0), real(1.0), real(2.0), real(1e-14)

    def density(x, y, z, ux, uy, uz, ax, ay, az, length, reach, contact):
        """Force of the rod on the cylinder per metre of rest arc length at one point, seen from the axis' start."""
        along = min(max(x * ax + y * ay + z * az, zero), length)
        dx, dy, dz = along * ax - x, along * ay - y, along * az - z
        distance = real(sqrt(dx * dx + dy * dy + dz * dz))
        if distance > zero:
            inverse = one / distance
            dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
        normal = ux * dx + uy * dy + uz * dz
        force = contact[STIFFNESS] * (reach - distance) - contact[DAMPING] * normal
        fx, fy, fz = force * dx, force * dy, force * dz
        if contact[FRICTION] > zero:
            ux, uy, uz = ux - normal * dx, uy - normal * dy, uz - normal * dz
            slip = real(sqrt(ux * ux + uy * uy + uz * uz))
            viscous = two * contact[SLIP_DAMPING] * slip
            friction = min(viscous, contact[FRICTION] * abs(force)) / (slip + tiny)
            fx, fy, fz = fx - friction * ux, fy - friction * uy, fz - friction * uz
        return fx, fy, fz

    return jit(density)


def _make_interval(real: type) -> Callable[..., Any]:
    zero, one, far = real(0.0), real(1.0), real(np.finfo(real).max)
    eps = real(np.finfo(real).eps)
    parallel, perpendicular = real(float(eps) ** 1.5), eps * eps

    def interval(x, y, z, ex, ey, ez, ax, ay, az, length, reach2):
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
            first, last = -along / rate, (length - along) / rate
            enter, leave = max(enter, min(first, last)), min(leave, max(first, last))
        elif along <= zero or along >= length:
            enter, leave = far, -far
        if enter >= leave:
            enter, leave = far, -far
        # the two round ends
        first, last = quadratic(square, ex * x + ey * y + ez * z, x * x + y * y + z * z - reach2, zero)
        enter, leave = min(enter, first), max(leave, last)
        x, y, z = x - length * ax, y - length * ay, z - length * az
        first, last = quadratic(square, ex * x + ey * y + ez * z, x * x + y * y + z * z - reach2, zero)
        return max(min(enter, first), zero), min(max(leave, last), one)

    return jit(interval, quadratic=_make_quadratic(real))


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
        return min(first, last), max(first, last)

    return jit(quadratic)
