"""Detection of broken rods: a compiled loop on the CPU, a kernel on a GPU, tensors elsewhere."""

import numba
import torch
from torch import Tensor

from softgm_bench.rod import sync
from softgm_bench.rod.compiling import njit
from softgm_bench.rod.state import RodState, dilatation


def diverged(state: RodState, rest_length: Tensor, low: float, high: float) -> Tensor:
    """Rods with a value that is not finite or an element whose dilatation leaves ``[low, high]``.

    Args:
        state: of ``num_envs`` rods.
        rest_length: of the elements, m, ``(n_elements,)``.
        low: smallest dilatation of a rod that is still one.
        high: largest.

    Returns:
        bool, ``(num_envs,)``.
    """
    if not sync.is_free(state.position.device):
        if not sync.runs_kernels(state.position.device, state.position.shape[-1]):
            return diverged_dense(state, rest_length, low, high)
        from softgm_bench.rod import cuda_checks  # only where Numba's CUDA target is

        return cuda_checks.diverged(state, rest_length, low, high)
    out = torch.empty(state.position.shape[0], dtype=torch.bool)
    values = (state.position, state.director, state.velocity, state.omega, rest_length)
    arguments = [*sync.arrays(*values, out), low, high]
    _find(*arguments)
    return out


def diverged_dense(state: RodState, rest_length: Tensor, low: float, high: float) -> Tensor:
    """``diverged`` without a look at any value."""
    stretch = dilatation(state.position, rest_length)
    good = ((stretch >= low) & (stretch <= high)).all(dim=-1)  # false for NaN
    for values in (state.velocity, state.omega, state.director):
        good &= values.isfinite().flatten(1).all(dim=-1)
    return ~good


@njit(parallel=True, error_model="numpy")
def _find(position, director, velocity, omega, rest_length, out, low, high):
    for b in numba.prange(position.shape[0]):
        x = position[b]
        good = True
        for k in range(rest_length.shape[0]):
            dx, dy, dz = x[0, k + 1] - x[0, k], x[1, k + 1] - x[1, k], x[2, k + 1] - x[2, k]
            square = (dx * dx + dy * dy + dz * dz) / (rest_length[k] * rest_length[k])
            good &= (square >= low * low) & (square <= high * high)  # false for NaN
        for i in range(3):
            good &= _finite(velocity[b, i]) & _finite(omega[b, i])
            for j in range(3):
                good &= _finite(director[b, i, j])
        out[b] = not good


@njit(error_model="numpy")
def _finite(values):
    nothing = values[0] - values[0]
    for k in range(values.shape[0]):
        nothing += values[k] * values.dtype.type(0.0)  # NaN for what is not finite
    return nothing == values.dtype.type(0.0)
