"""Where to compute everything by tensor arithmetic, and where the values themselves may steer.

On a CPU a look at a tensor's values is free, so compiled loops skip what is not there. On any other device a look stops
both processors until all queued work is done; there the same results come from shapes that do not depend on values.
"""

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from numpy.typing import NDArray
from torch import Tensor

_forced = False


def dense(device: torch.device) -> bool:
    """Whether code for this device must not look at any tensor's values."""
    return _forced or device.type != "cpu"


@contextmanager
def force_dense() -> Iterator[None]:
    """Take the other devices' way on the CPU too: for tests that the two ways agree."""
    global _forced
    previous, _forced = _forced, True
    try:
        yield
    finally:
        _forced = previous


def arrays(*tensors: Tensor) -> list[NDArray]:
    """CPU tensors as NumPy arrays, contiguous: a compiled loop is compiled anew for every other layout."""
    return [tensor.detach().contiguous().numpy() for tensor in tensors]
