"""Numbers that are not finite: which tensor of many holds one."""

from collections.abc import Iterable
from typing import Any

import torch
from torch import Tensor


def not_finite(named: Iterable[tuple[str, Any]]) -> str | None:
    """Name the first tensor that holds a NaN or an infinity, and say which of the two; None if all are finite.

    However many tensors there are, their device is waited for once, and again only to find out which one it is.

    Args:
        named: tensors of any shapes and types on one device, each with its name; anything else is passed over.
    """
    reals = [(name, one.detach()) for name, one in named if isinstance(one, Tensor) and one.is_floating_point()]
    # what is not finite makes a sum that is not; the other way round it may have been too large a sum
    if not reals or bool(torch.stack([tensor.sum() for _, tensor in reals]).isfinite().all()):
        return None
    for name, tensor in reals:
        if not tensor.isfinite().all():
            return f"{name} holds {'nan' if tensor.isnan().any() else 'inf'}"
    return None
