"""Compares what compiled loops and tensor operations make of the same inputs."""

import torch


def assert_equal_to_rounding(compiled, plain):
    """Tensors in pairs; small gradients are sums of large terms, so rounding goes with the largest number anywhere."""
    scale = max(1.0, *(one.abs().max().item() for one in plain if one.numel()))
    for found, expected in zip(compiled, plain, strict=True):
        torch.testing.assert_close(found, expected, rtol=0.0, atol=50 * torch.finfo(expected.dtype).eps * scale)
