"""Round cones: the hull of two spheres, of which arm, cylinders, target and edges are all drawn; compiled functions."""

from collections.abc import Callable
from math import sqrt
from typing import Any

from softgm_bench.rod.compiling import njit

MISS = 1e30
# Nothing here computes with infinities or NaN on purpose, but a ray along an axis divides by zero and is caught after.
FASTMATH = {"contract", "reassoc", "nsz", "arcp"}


def jit(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile without Python's exceptions, free of its lock, keeping the machine code on disk.

    Calls are put in line: an array is seven words and more to hand over.
    """
    return njit(fastmath=FASTMATH, error_model="numpy", nogil=True, forceinline=True)(function)


@jit
def hit_sphere(ox, oy, oz, dx, dy, dz, cx, cy, cz, radius):
    """Distance along the unit direction d from o to the near side of a sphere, or ``MISS``."""
    px, py, pz = ox - cx, oy - cy, oz - cz
    along = px * dx + py * dy + pz * dz
    # distance of the ray to the centre, by the rejected vector: exact for rays from far away
    qx, qy, qz = px - along * dx, py - along * dy, pz - along * dz
    square = radius * radius - (qx * qx + qy * qy + qz * qz)
    if square < 0.0:
        return MISS
    t = -along - sqrt(square)
    return t if t > 0.0 else MISS


@jit
def hit_round_cone(ox, oy, oz, dx, dy, dz, cones, n):
    """First point of a ray that starts outside on a round cone.

    Lateral surface of the cone that is tangent to both spheres where the point of contact lies between them, otherwise
    the nearer sphere (Quilez, "Intersectors", rounded cone).

    The ray goes from o along the unit direction d. Row n of ``cones``, ``(P, 8)``, holds centre and radius of both
    spheres; handing over the row alone would count its references, at the cost of the intersection. Returns the
    distance or ``MISS``, and the position along the axis, from 0 at the first sphere to 1.
    """
    ra, rb = cones[n, 3], cones[n, 7]
    ux, uy, uz = cones[n, 4] - cones[n, 0], cones[n, 5] - cones[n, 1], cones[n, 6] - cones[n, 2]
    # the ray is measured from its point next to the first centre, so that no square of the camera's distance appears
    shift = (cones[n, 0] - ox) * dx + (cones[n, 1] - oy) * dy + (cones[n, 2] - oz) * dz
    ax, ay, az = ox + shift * dx - cones[n, 0], oy + shift * dy - cones[n, 1], oz + shift * dz - cones[n, 2]
    taper = ra - rb
    uu = ux * ux + uy * uy + uz * uz
    ua = ux * ax + uy * ay + uz * az
    ud = ux * dx + uy * dy + uz * dz
    aa = ax * ax + ay * ay + az * az
    lateral = uu - taper * taper
    if lateral > 0.0:
        k2 = lateral - ud * ud
        k1 = ud * (taper * ra - ua)
        k0 = lateral * aa - ua * ua + 2.0 * ua * taper * ra - uu * ra * ra
        square = k1 * k1 - k0 * k2
        if square < 0.0 and k2 > 0.0:  # a ray steeper than the cone meets it somewhere, whatever rounding says
            return MISS, 0.0
        if square >= 0.0:
            t = (-sqrt(square) - k1) / k2
            y = ua - ra * taper + t * ud
            if 0.0 < y < lateral and t + shift > 0.0:
                return t + shift, y / lateral
    near = hit_sphere(ox, oy, oz, dx, dy, dz, cones[n, 0], cones[n, 1], cones[n, 2], ra)
    far = hit_sphere(ox, oy, oz, dx, dy, dz, cones[n, 4], cones[n, 5], cones[n, 6], rb)
    if near <= far:
        return near, 0.0
    return far, 1.0


@jit
def nearest_on_axis(px, py, pz, cones, n):
    """Position along the axis, from 0 to 1, of its point next to p."""
    ux, uy, uz = cones[n, 4] - cones[n, 0], cones[n, 5] - cones[n, 1], cones[n, 6] - cones[n, 2]
    uu = ux * ux + uy * uy + uz * uz
    if uu == 0.0:
        return 0.0
    y = ((px - cones[n, 0]) * ux + (py - cones[n, 1]) * uy + (pz - cones[n, 2]) * uz) / uu
    return min(max(y, 0.0), 1.0)


@jit
def normal_at(px, py, pz, cones, n, y):
    """Outward unit normal of a point on a round cone, from the tangent sphere whose centre is y along the axis."""
    nx = px - cones[n, 0] - y * (cones[n, 4] - cones[n, 0])
    ny = py - cones[n, 1] - y * (cones[n, 5] - cones[n, 1])
    nz = pz - cones[n, 2] - y * (cones[n, 6] - cones[n, 2])
    scale = 1.0 / sqrt(nx * nx + ny * ny + nz * nz)
    return nx * scale, ny * scale, nz * scale
