"""The arithmetic of ``contact_nodes`` is written here once, for its compiled loop and for the CUDA kernel."""

import math

from softgm_bench.rod.scalar_contact import clip, product


def radius_of(x, y, z, volume, tiny, pi):
    """Radius of an element with this edge that keeps its volume, in the order of ``element_radius``'s arithmetic."""
    return math.sqrt(volume / (math.sqrt(product(x, x) + product(y, y) + product(z, z)) + tiny) / pi)


def touches(x, y, z, u, v, w, ax, ay, az, length, reach):
    """Whether a point is within reach of the axis that starts at ``u, v, w``, as in ``point_segment_distance``."""
    x, y, z = x - u, y - v, z - w
    along = clip(product(x, ax) + product(y, ay) + product(z, az), length - length, length)
    x, y, z = x - product(along, ax), y - product(along, ay), z - product(along, az)
    return math.sqrt(product(x, x) + product(y, y) + product(z, z)) < reach
