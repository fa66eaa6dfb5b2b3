"""Detection of torch's function transforms (vmap and the like), which torch 2.13 tells by private functions."""

import torch
from torch import Tensor


def transforms_active() -> bool:
    """Tell whether the calling code runs under any transform."""
    return torch._C._are_functorch_transforms_active()


def is_wrapped(tensor: Tensor) -> bool:
    """Tell whether a tensor belongs to a transform: its memory cannot be handed to a compiled loop."""
    return torch._C._functorch.is_functorch_wrapped_tensor(tensor)
