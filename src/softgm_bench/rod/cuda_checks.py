# Compiled callees reach a function as globals (see callees), out of the linters' sight.
# ruff: noqa: F821
# mypy: disable-error-code="name-defined"
"""What is asked of every rod after a control step, as CUDA kernels: a block a rod, a thread a node.

The arithmetic is that of ``contact_nodes`` and ``divergence``, with products rounded as on the CPU.
"""

import math
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from softgm_bench.rod import scalar_nodes as scalar
from softgm_bench.rod.callees import with_callees
from softgm_bench.rod.cuda_kernel import device
from softgm_bench.rod.cuda_launch import REAL, launch, make_product
from softgm_bench.rod.scalar_contact import clip, larger, smaller
from softgm_bench.rod.state import Cylinders, RodState


def contact_nodes(position: Tensor, volume: Tensor, cylinders: Cylinders) -> Tensor:
    """``contact_nodes.contact_nodes`` in one launch; arguments and result are the same."""
    num_envs, _, n_nodes = position.shape
    touching = torch.empty((num_envs, n_nodes), dtype=torch.bool, device=position.device)
    volume = volume.reshape(-1, n_nodes - 1)
    read = (position, volume, cylinders.start, cylinders.axis, cylinders.length, cylinders.radius, cylinders.mask)
    kernel = make_contact_nodes(n_nodes, REAL[position.dtype])
    launch(kernel, num_envs, n_nodes, [*(value.contiguous() for value in read), touching])
    return touching


def diverged(state: RodState, rest_length: Tensor, low: float, high: float) -> Tensor:
    """``divergence.diverged`` in one launch; arguments and result are the same."""
    num_envs, _, n_nodes = state.position.shape
    broken = torch.empty(num_envs, dtype=torch.bool, device=state.position.device)
    read = (state.position, state.director, state.velocity, state.omega, rest_length)
    real = REAL[state.position.dtype]
    kernel = make_diverged(n_nodes, real)
    launch(kernel, num_envs, n_nodes, [*(value.contiguous() for value in read), broken], real(low), real(high))
    return broken


@lru_cache
def make_contact_nodes(n_nodes: int, real: type) -> Callable[..., Any]:
    """Build the kernel for one length of rods and one precision."""
    n, half, pi, tiny = n_nodes - 1, real(0.5), real(math.pi), real(1e-14)
    rounded = make_product(real)

    def at(position, volume, k):
        dx, dy, dz = (
            position[0, k + 1] - position[0, k],
            position[1, k + 1] - position[1, k],
            position[2, k + 1] - position[2, k],
        )
        return radius_of(dx, dy, dz, volume[k], tiny, pi)

    def mark(position, volume, start, axis, length, radius, mask, touching):
        b, k = cuda.blockIdx.x, cuda.threadIdx.x
        x, y, z = position[b, 0, k], position[b, 1, k], position[b, 2, k]
        left, right = larger(k - 1, 0), smaller(k, n - 1)
        filled = volume[b] if volume.shape[0] > 1 else volume[0]
        own = product(half, radius_at(position[b], filled, left) + radius_at(position[b], filled, right))
        found = False
        for c in range(mask.shape[1]):
            if mask[b, c]:
                found |= touches(
                    x, y, z, start[b, c, 0], start[b, c, 1], start[b, c, 2],
                    axis[b, c, 0], axis[b, c, 1], axis[b, c, 2], length[b, c], own + radius[b, c],
                )  # fmt: skip
        touching[b, k] = found

    callees = {
        "product": rounded,
        "radius_at": device(at, radius_of=device(scalar.radius_of, product=rounded)),
        "touches": device(scalar.touches, product=rounded, clip=device(clip)),
        "larger": device(larger),
        "smaller": device(smaller),
    }
    return cuda.jit(with_callees(mark, callees))


@lru_cache
def make_diverged(n_nodes: int, real: type) -> Callable[..., Any]:
    """Build the kernel for one length of rods and one precision."""
    n, zero = n_nodes - 1, real(0.0)

    def find(position, director, velocity, omega, rest_length, broken, low, high):
        b, k = cuda.blockIdx.x, cuda.threadIdx.x
        good = cuda.shared.array(n_nodes, np.int32)
        nothing = zero  # NaN as soon as a value is not finite
        fine = True
        for i in range(3):
            nothing += velocity[b, i, k] - velocity[b, i, k]
        if k < n:
            for i in range(3):
                nothing += omega[b, i, k] - omega[b, i, k]
                for j in range(3):
                    nothing += director[b, i, j, k] - director[b, i, j, k]
            x = position[b, 0, k + 1] - position[b, 0, k]
            y = position[b, 1, k + 1] - position[b, 1, k]
            z = position[b, 2, k + 1] - position[b, 2, k]
            stretch = real(math.sqrt(product(x, x) + product(y, y) + product(z, z))) / rest_length[k]
            fine = stretch >= low and stretch <= high  # false for NaN
        good[k] = 1 if fine and nothing == zero else 0
        cuda.syncthreads()
        if k == 0:
            whole = 0
            for other in range(n_nodes):
                whole += good[other]
            broken[b] = whole < n_nodes

    return cuda.jit(with_callees(find, {"product": make_product(real)}))
