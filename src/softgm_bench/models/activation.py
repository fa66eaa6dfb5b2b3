"""The hyperbolic tangent of hidden layers, five times as fast as torch's on a CPU."""

from typing import Any

import torch
from torch import Tensor, nn

from softgm_bench.rod import sync
from softgm_bench.upstream import functorch


class _Tanh(torch.autograd.Function):
    """tanh x = 2 sigmoid(2 x) - 1: torch 2.13 vectorises the sigmoid with a fast exponential, the tanh without."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = torch.sigmoid_(x + x).mul_(2.0).sub_(1.0)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradient, y)


def tanh(x: Tensor) -> Tensor:
    """tanh x within a few units of rounding at 1, absolutely: not for what is close to 0 and matters there."""
    # A function that vmap can take has a ``setup_context``; torch then inspects the signature of ``forward`` at every
    # call, for 0.1 ms, where a layer of a small network takes half of one. Hence torch's own under vmap and its like.
    # On a GPU torch's is one launch instead of four.
    plain = functorch.transforms_active() or not sync.is_free(x.device)
    return torch.tanh(x) if plain else _Tanh.apply(x)


class Tanh(nn.Module):
    """``tanh`` as a layer."""

    def forward(self, x: Tensor) -> Tensor:
        """Apply tanh to every entry of a tensor of any shape."""
        return tanh(x)
