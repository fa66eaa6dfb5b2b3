"""What a test does to the numbers of threads, undone."""

from collections.abc import Iterator
from contextlib import contextmanager

import numba
import torch


@contextmanager
def kept_threads() -> Iterator[None]:
    """Put torch's and Numba's numbers of threads back in the end."""
    before = torch.get_num_threads(), numba.get_num_threads()
    yield
    torch.set_num_threads(before[0])
    numba.set_num_threads(before[1])
