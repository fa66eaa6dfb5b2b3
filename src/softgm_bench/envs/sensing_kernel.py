"""``softgm_bench.envs.sensing`` as one compiled loop over environments for the CPU.

Of all the bins an agent can sense only few: those of the cylinders whose axis passes within reach, and of these only
the stretch around the agent. Both are bounds, widened by more than rounding; the test itself is made bin by bin.
"""

import math

import numba
import numpy as np

from softgm_bench.rod.callees import with_callees
from softgm_bench.rod.compiling import njit
from softgm_bench.rod.scalar_contact import product

SLACK = 1e-4  # m, by which the bounds are widened; float32 rounds positions of a few metres to less than 1e-6


def senses(x, y, z, centre_x, centre_y, centre_z, radius, sensing_radius):
    """``sensing.sense`` for one agent and one bin, with the sum in its order; the CUDA kernel calls it, too."""
    x, y, z = x - centre_x, y - centre_y, z - centre_z
    return math.sqrt(product(x, x) + product(z, z) + product(y, y)) - radius < sensing_radius


_jit = njit(error_model="numpy")
_senses = _jit(with_callees(senses, {"product": _jit(product)}))


@njit(parallel=True, error_model="numpy")
def look(
    agents,
    start,
    axis,
    length,
    cylinder_radius,
    exists,
    descriptor,
    mask,
    sensing_radius,
    bin_length,
    bin_of_slot,
    known,
    count,
    dropped,
    new,
    shown,
    active,
    edge,
):
    """Sense, discover and show in every environment; shapes as in ``sensing``.

    ``bin_of_slot``, ``known``, ``count`` and ``dropped`` are updated, ``new`` (stored bins), ``shown`` (descriptors),
    ``active`` and ``edge`` written; the last three must hold zeros.
    """
    n_agents, n_bins, n_slots = agents.shape[1], mask.shape[1], bin_of_slot.shape[1]
    n_cylinders = exists.shape[1]
    per_cylinder = n_bins // n_cylinders
    for b in numba.prange(agents.shape[0]):
        sensed = np.zeros((n_agents, n_bins), np.bool_)
        first = n_bins  # the first bin that has just been met
        for c in range(n_cylinders):
            if not exists[b, c]:
                continue
            reach = cylinder_radius[b, c] + sensing_radius + SLACK
            for i in range(n_agents):
                low, high = _within_reach(agents[b, i], start[b, c], axis[b, c], length[b, c], reach, bin_length)
                for k in range(c * per_cylinder + low, c * per_cylinder + min(high, per_cylinder)):
                    if mask[b, k] and _sensed(agents[b, i], descriptor[b, k], sensing_radius):
                        sensed[i, k] = True
                        if not known[b, k]:
                            first = min(first, k)
        new[b] = 0
        for k in range(first, n_bins):
            if not known[b, k] and _any(sensed, k):
                known[b, k] = True
                if count[b] < n_slots:
                    bin_of_slot[b, count[b]] = k
                    count[b] += 1
                    new[b] += 1
                else:
                    dropped[b] += 1
        for s in range(count[b]):
            k = bin_of_slot[b, s]
            active[b, s] = True
            for i in range(descriptor.shape[2]):
                shown[b, s, i] = descriptor[b, k, i]
            for i in range(n_agents):
                edge[b, i, s] = sensed[i, k]


@njit(error_model="numpy")
def _within_reach(point, start, axis, length, reach, bin_length):
    """Range of a cylinder's bins whose centres may lie within ``reach`` of a point; empty for most cylinders."""
    x, y, z = point[0] - start[0], point[1] - start[1], point[2] - start[2]
    along = x * axis[0] + y * axis[1] + z * axis[2]
    x, y, z = x - along * axis[0], y - along * axis[1], z - along * axis[2]
    square = reach * reach - (x * x + y * y + z * z)
    if not square >= 0.0:  # too far, or NaN
        return 0, 0
    half = math.sqrt(square) + SLACK
    # centres lie on the axis between start and end
    if along + half < 0.0 or along - half > length:
        return 0, 0
    low = max(0, int((along - half) / bin_length) - 1)
    return low, int((along + half) / bin_length) + 2


@njit(error_model="numpy")
def _sensed(point, descriptor, sensing_radius):
    return _senses(
        point[0], point[1], point[2], descriptor[0], descriptor[1], descriptor[2], descriptor[6], sensing_radius
    )


@njit(error_model="numpy")
def _any(sensed, k):
    found = False
    for i in range(sensed.shape[0]):
        found |= sensed[i, k]
    return found
