"""Kernels run on torch's tensors and on torch's stream, which nothing here waits for."""

import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np
import torch
from numba import cuda
from numba.core.errors import NumbaPerformanceWarning
from torch import Tensor

from softgm_bench.rod.cuda_kernel import SIMULATED
from softgm_bench.rod.scalar_contact import product

if not SIMULATED:
    from numba.cuda import libdevice

# Numba warns of few blocks; that many are all that the caller has.
warnings.filterwarnings("ignore", message="Grid size", category=NumbaPerformanceWarning)

REAL = {torch.float64: np.float64, torch.float32: np.float32}  # what kernels compute in


def launch(kernel: Any, blocks: int, threads: int, tensors: Sequence[Tensor], *scalars: Any) -> None:
    """Enqueue a kernel on the current stream of the tensors' device, with the tensors and then ``scalars``.

    A tensor among the scalars is handed on as the others are. Without blocks there is nothing to launch. No tensor may
    be empty.
    """
    if not blocks:
        return
    if SIMULATED:
        kernel[blocks, threads](*_given(lambda tensor: tensor.numpy(), *tensors, *scalars))
        return
    device = tensors[0].device
    with cuda.gpus[device.index]:
        stream = cuda.external_stream(torch.cuda.current_stream(device).cuda_stream)
        kernel[blocks, threads, stream](*_given(partial(cuda.as_cuda_array, sync=False), *tensors, *scalars))


def _given(array: Callable[[Tensor], Any], *arguments: Any) -> list[Any]:
    """Arguments as a kernel takes them; gradients do not pass through kernels."""
    return [array(value.detach()) if isinstance(value, Tensor) else value for value in arguments]


@lru_cache
def make_product(real: type) -> Callable[..., Any]:
    """Make the device function that multiplies and rounds; the compiler never fuses it with an addition.

    Where a comparison must come out as on the CPU, a fused product would have other last bits.
    """
    if SIMULATED:
        return product
    rounded = libdevice.fmul_rn if real is np.float32 else libdevice.dmul_rn

    @cuda.jit(device=True)
    def multiply(a, b):
        return rounded(a, b)

    return multiply
