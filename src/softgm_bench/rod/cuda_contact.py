"""Rod-cylinder contact of the CUDA kernel: each thread looks after its own element.

Now and then it measures the distance to every cylinder's axis and keeps two things: a bit set of the cylinders that are
near, and how far all others are. Until its midpoint has travelled that far no other cylinder can touch, so that in free
space contact costs a comparison a substep. Near ones are computed in full. The screen is a bound: no contact is missed.
"""

from collections.abc import Callable
from functools import lru_cache
from math import sqrt
from typing import Any

from numba import cuda

from softgm_bench.rod.cuda_exact_contact import make_touch_exact
from softgm_bench.rod.cuda_kernel import SIMULATED, clip, device, smaller

CANDIDATES = 31  # cylinders that the bit set can hold; those behind them are computed whenever one of them is near
SAFETY = 1.001  # on reach and travel, far above the round-off that they gather in a control step of float32
SKIN = 1.25  # a cylinder within this many reaches becomes a candidate

if SIMULATED:

    def first_bit(bits):
        """Index of the lowest bit that is set."""
        return int(bits & -bits).bit_length() - 1

else:

    @cuda.jit(device=True)
    def first_bit(bits):
        """Index of the lowest bit that is set."""
        return cuda.ffs(bits) - 1


@lru_cache
def make_press(n_elements: int, real: type, contact_model: str) -> Callable[..., Any]:
    """Device function for an element's contact with all cylinders of its rod."""
    zero, safety, half = real(0.0), real(SAFETY), real(0.5)
    screen = _make_screen(real)
    touch = make_touch_exact(real) if contact_model == "exact" else _make_touch(n_elements, real)

    def press(
        c, k, x, y, z, ex, ey, ez, vx, vy, vz, rx, ry, rz, current, duration, travelled, next_check, candidates,
        b, start, axis, length, radius, mask,
    ):  # fmt: skip
        """Force of the cylinders on the two nodes of an element, and what is kept between substeps.

        Args:
            c: coefficients.
            k: element.
            x, y, z: its first node.
            ex, ey, ez: edge to its second node.
            vx, vy, vz: velocity of the first node.
            rx, ry, rz: and of the second.
            current: length.
            duration: s, since the last call.
            travelled: bound on the way of the midpoint before that.
            next_check: ``travelled`` plus reach at which a cylinder that is no candidate may touch.
            candidates: bit set.
            b: environment.
            start, axis, length, radius, mask: of all environments' cylinders.
        """
        ux, uy, uz = vx + rx, vy + ry, vz + rz
        travelled += half * safety * duration * real(sqrt(ux * ux + uy * uy + uz * uz))
        own_radius = real(sqrt(c.volume_over_pi / current))
        reach = safety * (own_radius + current)  # PyElastica's element has its full edge from its midpoint on
        px, py, pz, nx, ny, nz, behind = zero, zero, zero, zero, zero, zero, mask.shape[1]
        if travelled + reach >= next_check:
            candidates, clear = screen(
                x + half * ex, y + half * ey, z + half * ez, reach, b, start, axis, length, radius, mask
            )
            next_check = travelled + clear
            behind = CANDIDATES
        bits = candidates
        while bits != 0 or behind < mask.shape[1]:
            i = behind
            if bits != 0:
                i = first_bit(bits)
                bits &= bits - 1
            else:
                behind += 1
            if mask[b, i]:
                fx, fy, fz, gx, gy, gz = touch(
                    c, k, x, y, z, ex, ey, ez, vx, vy, vz, rx, ry, rz, own_radius, b, i, start, axis, length, radius
                )
                px, py, pz, nx, ny, nz = px + fx, py + fy, pz + fz, nx + gx, ny + gy, nz + gz
        return px, py, pz, nx, ny, nz, travelled, next_check, candidates

    return device(press)


@lru_cache
def make_no_press(real: type) -> Callable[..., Any]:
    """The same where there are no cylinders."""
    zero = real(0.0)

    def press(
        c, k, x, y, z, ex, ey, ez, vx, vy, vz, rx, ry, rz, current, duration, travelled, next_check, candidates,
        b, start, axis, length, radius, mask,
    ):  # fmt: skip
        return zero, zero, zero, zero, zero, zero, travelled, next_check, candidates

    return device(press)


def _make_screen(real: type) -> Callable[..., Any]:
    zero, far, skin = real(0.0), real(1e30), real(SKIN)

    def screen(x, y, z, reach, b, start, axis, length, radius, mask):
        """Bit set of near cylinders, and the smallest gap between a midpoint and the surface of any other."""
        candidates, clear, near = 0, far, skin * reach
        for i in range(mask.shape[1]):
            if mask[b, i]:
                dx, dy, dz = x - start[b, i, 0], y - start[b, i, 1], z - start[b, i, 2]
                ax, ay, az = axis[b, i, 0], axis[b, i, 1], axis[b, i, 2]
                square = ax * ax + ay * ay + az * az
                along = clip((dx * ax + dy * ay + dz * az) / square, zero, length[b, i])
                dx, dy, dz = dx - along * ax, dy - along * ay, dz - along * az
                gap = real(sqrt(dx * dx + dy * dy + dz * dz)) - radius[b, i]
                if i < CANDIDATES and gap <= near:
                    candidates |= 1 << i
                else:
                    clear = smaller(clear, gap)
        return candidates, clear

    return device(screen)


def _make_touch(n_elements: int, real: type) -> Callable[..., Any]:
    zero, half, one, tiny = real(0.0), real(0.5), real(1.0), real(1e-14)
    less, more, last = real(2.0 / 3.0), real(4.0 / 3.0), n_elements - 1
    closest_points = _make_closest_points(real)

    def touch(
        c, k, x, y, z, ex, ey, ez, vx, vy, vz, rx, ry, rz, own_radius, b, i, start, axis, length, radius
    ):  # fmt: skip
        """Force of cylinder ``i`` on the two nodes of an element (``_calculate_contact_forces_rod_cylinder``)."""
        extent = length[b, i]
        dx, dy, dz = closest_points(
            ex, ey, ez, start[b, i, 0] - x - half * ex, start[b, i, 1] - y - half * ey, start[b, i, 2] - z - half * ez,
            axis[b, i, 0] * extent, axis[b, i, 1] * extent, axis[b, i, 2] * extent,
        )  # fmt: skip
        distance = real(sqrt(dx * dx + dy * dy + dz * dz))
        penetration = own_radius + radius[b, i] - distance
        if not penetration > zero:
            return zero, zero, zero, zero, zero, zero
        inverse = one / distance if distance > zero else one
        dx, dy, dz = dx * inverse, dy * inverse, dz * inverse
        # velocity of the cylinder (at rest) relative to the element
        ux, uy, uz = -half * (vx + rx), -half * (vy + ry), -half * (vz + rz)
        normal = ux * dx + uy * dy + uz * dz
        force = half * (c.contact_stiffness * penetration - c.contact_damping * normal)
        fx, fy, fz = force * dx, force * dy, force * dz
        if c.friction > zero:
            ux, uy, uz = ux - normal * dx, uy - normal * dy, uz - normal * dz
            slip = real(sqrt(ux * ux + uy * uy + uz * uz))
            friction = smaller(c.slip_damping * slip, c.friction * abs(force)) / (slip + tiny)
            fx, fy, fz = fx - friction * ux, fy - friction * uy, fz - friction * uz
        # the end elements lean on their free and fixed nodes with half the weight, as in PyElastica
        first, second = one, one
        if k == 0:
            first, second = less, more
        elif k == last:
            first, second = more, less
        return -first * fx, -first * fy, -first * fz, -second * fx, -second * fy, -second * fz

    return device(touch)


def _make_closest_points(real: type) -> Callable[..., Any]:
    zero, one, threshold = real(0.0), real(1.0), real(1e-6)

    def closest_points(ax, ay, az, rx, ry, rz, bx, by, bz):
        """Vector from a segment with edge ``a`` to one with edge ``b``, starting ``r`` away, at their closest points.

        PyElastica's ``_find_min_dist``, with its threshold for parallel segments.
        """
        aa = ax * ax + ay * ay + az * az
        ab = ax * bx + ay * by + az * bz
        bb = bx * bx + by * by + bz * bz
        ra = rx * ax + ry * ay + rz * az
        rb = rx * bx + ry * by + rz * bz
        over_aa, over_bb = one / aa, one / bb
        determinant = aa * bb - ab * ab
        if abs(determinant) < threshold * (aa * bb):
            t = clip(ra * over_aa, zero, one)
            q = clip((t * ab - rb) * over_bb, zero, one)
        else:
            q = (ab * ra - aa * rb) / determinant
            t = (ab * q + ra) * over_aa
            if q < zero or q > one or t < zero or t > one:
                # the best of the four ends against the other segment
                q, t = zero, clip(ra * over_aa, zero, one)
                dx, dy, dz = rx - t * ax, ry - t * ay, rz - t * az
                best = dx * dx + dy * dy + dz * dz
                try_t = clip((ra + ab) * over_aa, zero, one)
                dx, dy, dz = rx + bx - try_t * ax, ry + by - try_t * ay, rz + bz - try_t * az
                square = dx * dx + dy * dy + dz * dz
                if square < best:
                    best, q, t = square, one, try_t
                try_q = clip(-rb * over_bb, zero, one)
                dx, dy, dz = rx + try_q * bx, ry + try_q * by, rz + try_q * bz
                square = dx * dx + dy * dy + dz * dz
                if square < best:
                    best, q, t = square, try_q, zero
                try_q = clip((ab - rb) * over_bb, zero, one)
                dx, dy, dz = rx + try_q * bx - ax, ry + try_q * by - ay, rz + try_q * bz - az
                square = dx * dx + dy * dy + dz * dz
                if square < best:
                    q, t = try_q, one
        return rx + q * bx - t * ax, ry + q * by - t * ay, rz + q * bz - t * az

    return device(closest_points)
