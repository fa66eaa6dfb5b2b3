"""Kernels run on torch's tensors and on torch's stream, which nothing here waits for."""

import warnings
from collections.abc import Callable, Sequence
from functools import lru_cache
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

    Without blocks there is nothing to launch. No tensor may be empty.
    """
    if not blocks:
        return
    tensors = [tensor.detach() for tensor in tensors]  # gradients do not pass through kernels
    if SIMULATED:
        kernel[blocks, threads](*(tensor.numpy() for tensor in tensors), *scalars)
        return
    device = tensors[0].device
    with cuda.gpus[device.index]:
        arrays = [cuda.as_cuda_array(tensor, sync=False) for tensor in tensors]
        stream = cuda.external_stream(torch.cuda.current_stream(device).cuda_stream)
        kernel[blocks, threads, stream](*arrays, *scalars)


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
