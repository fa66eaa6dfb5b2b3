# Compiled callees reach a function as globals (see jit), out of the linters' sight.
# ruff: noqa: F821
# mypy: disable-error-code="name-defined"
"""The Numba kernel's rod-cylinder contact is PyElastica's ``RodCylinderContact`` without its pruning.

A cylinder is looked at only when it might touch. When it is, the distance from its axis to the nearest element is
stored; until the rod can have travelled that far, the cylinder costs nothing, and all of them together one comparison
a substep. Elements are then screened by a vectorised distance, and the few that may touch go through PyElastica's
closest-point search. Both screens are bounds, so no contact is missed.
"""

from collections.abc import Callable
from functools import lru_cache
from math import sqrt
from typing import Any, NamedTuple

import numpy as np

from softgm_bench.rod.numba_kernel import jit, larger
from softgm_bench.rod.numba_layout import Layout
from softgm_bench.rod.parameters import CONTACT_MODELS
from softgm_bench.rod.scalar_contact import EDGE, RADIUS, START, make_offset, make_pair

# columns of a cylinder's row behind those of ``scalar_contact``; only one that moves has the last two
NEXT_CHECK, COLUMNS = 7, 8
VELOCITY, ORIGIN, MOVING_COLUMNS = 8, 11, 14


class Contact(NamedTuple):
    """These are compiled functions on one rod's buffer and its cylinders."""

    reach: Callable[..., Any]
    add_contact: Callable[..., Any]


def make_contact(layout: Layout, real: type, touch: Callable[..., Any]) -> Contact:
    """Compile contact for one layout and one precision; ``touch`` adds the force of one cylinder on one element."""
    p, n = layout, layout.n
    never = real(np.inf)

    def add_contact(s, cylinders, travelled, extent, contact, volume):
        """External force plus contact with every cylinder that is due.

        Args:
            s: the rod's buffer, with lengths of this substep.
            cylinders: ``(n_cylinders, 8)``; the last column, the travel at which the cylinder may touch, is updated.
            travelled: bound on how far any node has moved since the step began, as a cylinder sees it, m.
            extent: of the elements at this substep, m, see ``reach``.
            contact: stiffness, damping, friction and slip damping coefficients.
            volume: largest element volume, m^3.

        Returns:
            Whether forces were written anew, whether a cylinder pushes, how far the rod must travel until one is due.
        """
        copied, pushed, soonest = False, False, never
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
                        if s[p.distance2 + k] <= limit and touch(s, k, cylinder, contact, volume):
                            pushed = True
            soonest = min(soonest, cylinder[NEXT_CHECK])
        return copied, pushed, soonest

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
            dx, dy, dz = offset(dx, dy, dz, ex, ey, ez, inverse, zero, one)
            distance2 = dx * dx + dy * dy + dz * dz
            s[p.distance2 + k] = distance2
            smallest = larger(smallest, -distance2)
        return -smallest

    return jit(nearest, offset=make_offset(jit))


class Motion(NamedTuple):
    """These are compiled functions on one rod's cylinders, which do nothing where cylinders stand still.

    ``speed`` gives the fastest cylinder's speed, ``carry`` brings the cylinders to where they are in the middle of a
    substep.
    """

    speed: Callable[..., Any]
    carry: Callable[..., Any]


@lru_cache
def make_motion(real: type, moving: bool) -> Motion:
    """Compile the cylinders' motion: along straight lines, at a speed that is constant in a control step."""
    zero, half = real(0.0), real(0.5)

    def no_speed(cylinders):
        return zero

    def stay(cylinders, substep, dt):
        pass

    def speed(cylinders):
        fastest = zero
        for c in range(cylinders.shape[0]):
            x, y, z = cylinders[c, VELOCITY], cylinders[c, VELOCITY + 1], cylinders[c, VELOCITY + 2]
            fastest = larger(fastest, x * x + y * y + z * z)
        return real(sqrt(fastest))

    def carry(cylinders, substep, dt):
        time = (real(substep) + half) * dt
        for c in range(cylinders.shape[0]):
            for i in range(3):
                cylinders[c, START + i] = cylinders[c, ORIGIN + i] + time * cylinders[c, VELOCITY + i]

    if moving:
        return Motion(jit(speed), jit(carry))
    return Motion(jit(no_speed, inline=True), jit(stay, inline=True))


@lru_cache
def make_touch(layout: Layout, real: type, contact_model: str, moving: bool) -> Callable[..., Any]:
    """Compile the force of one cylinder on one element for one layout, precision and contact model."""
    p = told_apart(layout, contact_model, moving)
    inverse_pi = real(1.0 / np.pi)

    def touch(s, k, cylinder, contact, volume):
        """Add the cylinder's force, if any, to the element's two nodes and say so; arguments as in ``add_contact``."""
        touching, found = meet(
            s[p.px + k],
            s[p.py + k],
            s[p.pz + k],
            s[p.px + k + 1],
            s[p.py + k + 1],
            s[p.pz + k + 1],
            real(sqrt(volume * inverse_pi / s[p.length + k])),
            cylinder,
        )
        if not touching:
            return False
        vx, vy, vz = s[p.vx + k], s[p.vy + k], s[p.vz + k]
        wx, wy, wz = s[p.vx + k + 1], s[p.vy + k + 1], s[p.vz + k + 1]
        if moving:  # known when this is compiled
            vx, wx = vx - cylinder[VELOCITY], wx - cylinder[VELOCITY]
            vy, wy = vy - cylinder[VELOCITY + 1], wy - cylinder[VELOCITY + 1]
            vz, wz = vz - cylinder[VELOCITY + 2], wz - cylinder[VELOCITY + 2]
        fx, fy, fz, gx, gy, gz = forces(found, k, vx, vy, vz, wx, wy, wz, s[p.rest + k], contact)
        s[p.fx + k] -= fx
        s[p.fy + k] -= fy
        s[p.fz + k] -= fz
        s[p.fx + k + 1] -= gx
        s[p.fy + k + 1] -= gy
        s[p.fz + k + 1] -= gz
        return True

    return jit(touch, **make_pair(contact_model, layout.n, real, jit)._asdict())


def told_apart(layout: Layout, contact_model: str, moving: bool) -> Layout:
    """Return a layout of this contact model and motion's own.

    Code on disk is found by the closure: what differs only in its callees must differ in the layout too.
    """
    return layout._replace(source=layout.source + CONTACT_MODELS.index(contact_model) + len(CONTACT_MODELS) * moving)
