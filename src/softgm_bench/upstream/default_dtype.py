"""torch's default floating type, which a user may have set for other things."""

import contextlib
from collections.abc import Iterator

import torch


@contextlib.contextmanager
def float32() -> Iterator[None]:
    """Within, new tensors and networks are float32 unless they say otherwise."""
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float32)
    try:
        yield
    finally:
        torch.set_default_dtype(before)
