"""In the CUDA kernel's rod-cylinder contact, each thread looks after its own element.

Now and then it measures the distance to every cylinder's axis and keeps two things: a bit set of the cylinders that are
near, and how far all others are. Until its midpoint has travelled that far no other cylinder can touch, so that in free
space contact costs a comparison a substep. Near ones are computed in full. The screen is a bound: no contact is missed.
"""

from collections.abc import Callable
from functools import lru_cache
from math import sqrt
from typing import Any, NamedTuple

from numba import cuda

from softgm_bench.rod.cuda_kernel import SIMULATED, device
from softgm_bench.rod.scalar_contact import make_offset, make_pair

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
def make_press(n_elements: int, real: type, contact_model: str, moving: bool) -> Callable[..., Any]:
    """Make the device function for an element's contact with all cylinders of its rod, which may be ``moving``."""
    zero, safety, half = real(0.0), real(SAFETY), real(0.5)
    screen = _make_screen(real, moving)
    touch = _make_touch(n_elements, real, contact_model, moving)

    def press(
        c, k, x, y, z, nx, ny, nz, vx, vy, vz, wx, wy, wz, current, duration, travelled, next_check, candidates,
        b, start, axis, length, radius, mask, velocities, touched, substep, substeps,
    ):  # fmt: skip
        """Force of the cylinders on the two nodes of an element, and what is kept between substeps.

        Args:
            c: coefficients.
            k: element.
            x, y, z: its first node.
            nx, ny, nz: its second node.
            vx, vy, vz: velocity of the first node.
            wx, wy, wz: and of the second.
            current: length.
            duration: s, since the last call.
            travelled: bound on the way of the midpoint before that.
            next_check: ``travelled`` plus reach at which a cylinder that is no candidate may touch.
            candidates: bit set.
            b: environment.
            start, axis, length, radius, mask: of all environments' cylinders as the control step begins.
            velocities: their velocities, ``(num_envs, n_cylinders, 3)``; never read where cylinders stand still.
            touched: where a rod that a cylinder pushes is marked, ``(num_envs,)``.
            substep, substeps: which one of the control step this is, from 0, and of how many.
        """
        ux, uy, uz = vx + wx, vy + wy, vz + wz
        travelled += half * safety * duration * real(sqrt(ux * ux + uy * uy + uz * uz))
        own_radius = real(sqrt(c.volume_over_pi / current))
        reach = safety * (own_radius + current)  # PyElastica's element has its full edge from its midpoint on
        px, py, pz, qx, qy, qz, behind = zero, zero, zero, zero, zero, zero, mask.shape[1]
        if travelled + reach >= next_check:
            candidates, clear = screen(
                c, half * (x + nx), half * (y + ny), half * (z + nz), reach, b, start, axis, length, radius, mask,
                velocities, substep, substeps,
            )  # fmt: skip
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
                    c, k, x, y, z, nx, ny, nz, vx, vy, vz, wx, wy, wz, own_radius, b, i, start, axis, length, radius,
                    velocities, touched, substep,
                )  # fmt: skip
                px, py, pz, qx, qy, qz = px - fx, py - fy, pz - fz, qx - gx, qy - gy, qz - gz
        return px, py, pz, qx, qy, qz, travelled, next_check, candidates

    return device(press)


@lru_cache
def make_no_press(real: type) -> Callable[..., Any]:
    """Make the device function that stands in for that of ``make_press`` where there are no cylinders."""
    zero = real(0.0)

    def press(
        c, k, x, y, z, nx, ny, nz, vx, vy, vz, wx, wy, wz, current, duration, travelled, next_check, candidates,
        b, start, axis, length, radius, mask, velocities, touched, substep, substeps,
    ):  # fmt: skip
        return zero, zero, zero, zero, zero, zero, travelled, next_check, candidates

    return device(press)


class _Motion(NamedTuple):
    """These are device functions on one cylinder, which do nothing where cylinders stand still.

    ``place`` gives a coordinate of its start in the middle of a substep, ``relative`` a component of a velocity as seen
    from it, ``gain`` the most that it can yet come nearer in this control step.
    """

    place: Callable[..., Any]
    relative: Callable[..., Any]
    gain: Callable[..., Any]


@lru_cache
def _make_motion(real: type, moving: bool) -> _Motion:
    zero, safety = real(0.0), real(SAFETY)

    def fixed(c, start, velocities, b, i, axis, substep):
        return start[b, i, axis]

    def own(velocity, velocities, b, i, axis):
        return velocity

    def nothing(c, velocities, b, i, substep, substeps):
        return zero

    def place(c, start, velocities, b, i, axis, substep):
        return start[b, i, axis] + (c.half_dt + real(substep) * c.dt) * velocities[b, i, axis]

    def relative(velocity, velocities, b, i, axis):
        return velocity - velocities[b, i, axis]

    def gain(c, velocities, b, i, substep, substeps):
        ux, uy, uz = velocities[b, i, 0], velocities[b, i, 1], velocities[b, i, 2]
        return safety * real(substeps - substep) * c.dt * real(sqrt(ux * ux + uy * uy + uz * uz))

    return _Motion(*(device(f) for f in ((place, relative, gain) if moving else (fixed, own, nothing))))


def _make_screen(real: type, moving: bool) -> Callable[..., Any]:
    zero, one, far, skin = real(0.0), real(1.0), real(1e30), real(SKIN)
    offset = make_offset(device)
    place, _, gain = _make_motion(real, moving)

    def screen(c, x, y, z, reach, b, start, axis, length, radius, mask, velocities, substep, substeps):
        """Bit set of near cylinders, and the smallest gap between a midpoint and the surface of any other.

        Of a gap counts what no motion of the cylinder can close before the control step ends.
        """
        candidates, clear, near = 0, far, skin * reach
        for i in range(mask.shape[1]):
            if mask[b, i]:
                dx = x - place(c, start, velocities, b, i, 0, substep)
                dy = y - place(c, start, velocities, b, i, 1, substep)
                dz = z - place(c, start, velocities, b, i, 2, substep)
                ax, ay, az = axis[b, i, 0], axis[b, i, 1], axis[b, i, 2]
                square = ax * ax + ay * ay + az * az
                dx, dy, dz = offset(dx, dy, dz, ax, ay, az, one / square, zero, length[b, i])
                gap = real(sqrt(dx * dx + dy * dy + dz * dz)) - radius[b, i]
                gap -= gain(c, velocities, b, i, substep, substeps)
                if i < CANDIDATES and gap <= near:
                    candidates |= 1 << i
                else:
                    clear = gap if gap < clear else clear
        return candidates, clear

    return device(screen)


def _make_touch(n_elements: int, real: type, contact_model: str, moving: bool) -> Callable[..., Any]:
    zero = real(0.0)
    meet, forces = make_pair(contact_model, n_elements, real, device)
    place, relative, _ = _make_motion(real, moving)

    def touch(
        c, k, x, y, z, nx, ny, nz, vx, vy, vz, wx, wy, wz, own_radius, b, i, start, axis, length, radius,
        velocities, touched, substep,
    ):  # fmt: skip
        """Forces with which the two nodes of an element push cylinder ``i``."""
        extent = length[b, i]
        cylinder = (
            place(c, start, velocities, b, i, 0, substep),
            place(c, start, velocities, b, i, 1, substep),
            place(c, start, velocities, b, i, 2, substep),
            axis[b, i, 0] * extent, axis[b, i, 1] * extent, axis[b, i, 2] * extent, radius[b, i],
        )  # fmt: skip
        touching, found = meet(x, y, z, nx, ny, nz, own_radius, cylinder)
        if not touching:
            return zero, zero, zero, zero, zero, zero
        touched[b] = True  # by as many threads as there are elements that touch, all of them the same
        vx, wx = relative(vx, velocities, b, i, 0), relative(wx, velocities, b, i, 0)
        vy, wy = relative(vy, velocities, b, i, 1), relative(wy, velocities, b, i, 1)
        vz, wz = relative(vz, velocities, b, i, 2), relative(wz, velocities, b, i, 2)
        contact = c.contact_stiffness, c.contact_damping, c.friction, c.slip_damping
        return forces(found, k, vx, vy, vz, wx, wy, wz, c.rest_length, contact)

    return device(touch)
