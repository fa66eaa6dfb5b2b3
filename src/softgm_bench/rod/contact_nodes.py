"""The geometric test of which nodes of a rod touch a cylinder: a compiled loop on the CPU, a kernel on a GPU."""

import math

import numba
import numpy as np
import torch
from torch import Tensor

from softgm_bench.rod import sync
from softgm_bench.rod.callees import with_callees
from softgm_bench.rod.compiling import njit
from softgm_bench.rod.contact import element_radius, safe_norm
from softgm_bench.rod.scalar_contact import clip, product
from softgm_bench.rod.scalar_nodes import radius_of, touches
from softgm_bench.rod.state import Cylinders


def contact_nodes(position: Tensor, volume: Tensor, cylinders: Cylinders) -> Tensor:
    """Find the nodes that touch any cylinder: distance to its axis segment below the sum of radii.

    A node's radius is the mean of its elements' radii, an element's the one that keeps its volume.

    Args:
        position: ``(num_envs, 3, n_nodes)``.
        volume: of the elements, m^3, ``(n_elements,)``, or of every environment's, ``(num_envs, n_elements)``.
        cylinders: of the same ``num_envs``; values of masked ones are never read.

    Returns:
        bool, ``(num_envs, n_nodes)``.
    """
    if not sync.is_free(position.device):
        # kernels take no empty arrays
        if not cylinders.mask.shape[1] or not sync.runs_kernels(position.device, position.shape[-1]):
            return contact_nodes_dense(position, volume, cylinders)
        from softgm_bench.rod import cuda_checks  # only where Numba's CUDA target is

        return cuda_checks.contact_nodes(position, volume, cylinders)
    touching = torch.zeros((position.shape[0], position.shape[2]), dtype=torch.bool)
    volume = volume.reshape(-1, volume.shape[-1])
    values = (position, volume, cylinders.start, cylinders.axis, cylinders.length, cylinders.radius, cylinders.mask)
    _mark(*sync.arrays(*values, touching))
    return touching


def contact_nodes_dense(position: Tensor, volume: Tensor, cylinders: Cylinders) -> Tensor:
    """``contact_nodes`` by comparing every node with every cylinder."""
    radius = element_radius(position, volume)
    # the end nodes count their one element twice
    node_radius = 0.5 * (torch.cat([radius[:, :1], radius], dim=-1) + torch.cat([radius, radius[:, -1:]], dim=-1))
    distance = point_segment_distance(
        position.transpose(-1, -2).unsqueeze(1),
        cylinders.start.unsqueeze(2),
        cylinders.axis.unsqueeze(2),
        cylinders.length.unsqueeze(2),
    )  # (num_envs, n_cylinders, n_nodes)
    touches = distance < node_radius.unsqueeze(1) + cylinders.radius.unsqueeze(2)
    return (touches & cylinders.mask.unsqueeze(2)).any(dim=1)


def point_segment_distance(point: Tensor, start: Tensor, axis: Tensor, length: Tensor) -> Tensor:
    """Distance of points to segments.

    Args:
        point: ``(..., 3)``.
        start: one end of the segment, ``(..., 3)``, broadcast with ``point``.
        axis: unit vector to the other end, ``(..., 3)``.
        length: ``(...)``.

    Returns:
        ``(...)``, the broadcast of all.
    """
    offset = point - start
    along = torch.minimum((offset * axis).sum(-1).clamp(min=0.0), length)
    return safe_norm(offset - along[..., None] * axis, dim=-1)


_jit = njit(error_model="numpy")
_product = _jit(product)
_radius_of = _jit(with_callees(radius_of, {"product": _product}))
_touches = _jit(with_callees(touches, {"product": _product, "clip": _jit(clip)}))


@njit(parallel=True, error_model="numpy")
def _mark(position, volume, start, axis, length, radius, mask, touching):
    """Set ``touching``; a cylinder whose bounding box is apart from the rod's costs a few comparisons."""
    for b in numba.prange(position.shape[0]):
        own = volume[b] if volume.shape[0] > 1 else volume[0]
        low, high = _box(position[b], own)
        node_radius = np.empty(0, position.dtype)
        for c in range(mask.shape[1]):
            if not mask[b, c]:
                continue
            apart = False
            for i in range(3):
                end = start[b, c, i] + length[b, c] * axis[b, c, i]
                apart |= min(start[b, c, i], end) - radius[b, c] > high[i]
                apart |= max(start[b, c, i], end) + radius[b, c] < low[i]
            if not apart:
                if node_radius.shape[0] == 0:
                    node_radius = _node_radius(position[b], own)
                _compare(position[b], node_radius, start[b, c], axis[b, c], length[b, c], radius[b, c], touching[b])


@njit(error_model="numpy")
def _box(x, volume):
    """Bounds of the rod's nodes ``(3, n_nodes)``, widened by more than the largest node's radius."""
    thickest = volume[0] - volume[0]
    for k in range(volume.shape[0]):
        dx, dy, dz = x[0, k + 1] - x[0, k], x[1, k + 1] - x[1, k], x[2, k + 1] - x[2, k]
        thickest = max(thickest, volume[k] * volume[k] / (dx * dx + dy * dy + dz * dz))
    margin = 1.0001 * np.sqrt(np.sqrt(thickest) / math.pi)  # pi r^2 l is the volume
    low, high = np.empty(3), np.empty(3)
    for i in range(3):
        lowest = highest = x[i, 0]
        for k in range(x.shape[1]):
            lowest, highest = min(lowest, x[i, k]), max(highest, x[i, k])
        low[i], high[i] = lowest - margin, highest + margin
    return low, high


@njit(error_model="numpy")
def _node_radius(x, volume):
    """Mean radius of each node's elements, in the order of ``contact_nodes_dense``'s arithmetic."""
    n, real = volume.shape[0], x.dtype.type
    radius, out = np.empty(n, x.dtype), np.empty(n + 1, x.dtype)
    for k in range(n):
        dx, dy, dz = x[0, k + 1] - x[0, k], x[1, k + 1] - x[1, k], x[2, k + 1] - x[2, k]
        radius[k] = _radius_of(dx, dy, dz, volume[k], real(1e-14), real(math.pi))
    for k in range(n + 1):
        out[k] = real(0.5) * (radius[max(k - 1, 0)] + radius[min(k, n - 1)])
    return out


@njit(error_model="numpy")
def _compare(x, node_radius, start, axis, length, radius, touching):
    """Mark the nodes that touch one cylinder."""
    for k in range(x.shape[1]):
        touching[k] |= _touches(
            x[0, k], x[1, k], x[2, k], start[0], start[1], start[2], axis[0], axis[1], axis[2],
            length, node_radius[k] + radius,
        )  # fmt: skip
