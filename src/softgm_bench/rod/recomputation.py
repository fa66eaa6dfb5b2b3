"""Gradients of a long computation at the cost of its time instead of its memory."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable


class Recomputed(torch.autograd.Function):
    """A function of tensors whose intermediate values are computed again in the backward pass rather than kept.

    ``torch.utils.checkpoint`` does the same through hooks on every saved tensor, which for a rod of this size cost
    more than the arithmetic.
    """

    @staticmethod
    def forward(ctx: Any, run: Callable[..., tuple[Tensor, ...]], *inputs: Tensor) -> tuple[Tensor, ...]:
        """Compute ``run(*inputs)`` and keep the inputs alone."""
        ctx.run = run
        ctx.save_for_backward(*inputs)
        return tuple(run(*inputs))

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        """Compute again, with gradients."""
        needed = ctx.needs_input_grad[1:]
        inputs = [x.detach().requires_grad_(need) for x, need in zip(ctx.saved_tensors, needed, strict=True)]
        with torch.enable_grad():
            outputs = ctx.run(*inputs)
        used = [(output, gradient) for output, gradient in zip(outputs, gradients, strict=True) if output.requires_grad]
        wanted = [x for x in inputs if x.requires_grad]
        found = iter(
            torch.autograd.grad(
                [output for output, _ in used], wanted, [gradient for _, gradient in used], allow_unused=True
            )
        )
        return (None, *(next(found) if need else None for need in needed))
