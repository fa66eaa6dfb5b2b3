"""Devices on which a value may steer the program, and those on which reading one makes the processors wait.

On a CPU reading a tensor's values is free, so compiled loops skip what is not there. On any other device reading one
stops both processors until all queued work is done; there the same results come from shapes that do not depend on
values. Callers ask through this module (``sync.is_free``), so that a test can send the CPU down the other devices' way.
"""

from functools import lru_cache

import numba
import torch
from numpy.typing import NDArray
from torch import Tensor


def is_free(device: torch.device) -> bool:
    """Tell whether code for this device may read tensors' values without waiting."""
    return device.type == "cpu"


MOST_THREADS = 1024  # of a kernel's block


def runs_kernels(device: torch.device, threads: int = 1) -> bool:
    """Tell whether CUDA kernels with so many threads a block run on this device.

    They do on a GPU that Numba reaches, and on the CPU under Numba's simulator.
    """
    if threads > MOST_THREADS:
        return False
    if numba.config.ENABLE_CUDASIM:
        return device.type == "cpu"
    return device.type == "cuda" and _numba_reaches_gpus()


@lru_cache
def _numba_reaches_gpus() -> bool:
    try:
        from numba import cuda  # absent where Numba's CUDA target is not installed
    except ImportError:
        return False
    return bool(cuda.is_available())


@lru_cache
def constant(values: tuple, device: torch.device, dtype: torch.dtype = torch.float64) -> Tensor:
    """Nested tuples of numbers as a tensor that is copied to the device once; not to be changed."""
    return torch.tensor(values, dtype=dtype, device=device)


def any_true(mask: Tensor) -> bool:
    """Tell whether any entry of a bool tensor is true; True without reading it where that would have to wait."""
    return not is_free(mask.device) or bool(mask.any())


def arrays(*tensors: Tensor) -> list[NDArray]:
    """Give CPU tensors as contiguous NumPy arrays: a compiled loop is compiled anew for every other layout."""
    return [tensor.detach().contiguous().numpy() for tensor in tensors]
