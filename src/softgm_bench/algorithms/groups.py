"""What several batches have in common: scales over all of their values, and minibatches with a share of each."""

from collections.abc import Iterator, Sequence

import torch
from tensordict import TensorDictBase
from torch import Tensor


def joined(values: Sequence[Tensor]) -> Tensor:
    """All values ``(.., 1)`` as ``(n, 1)``; those of one group as they are."""
    return values[0] if len(values) == 1 else torch.cat([value.reshape(-1, 1) for value in values])


def standardised(values: Sequence[Tensor]) -> list[Tensor]:
    """The values of all groups with mean 0 and standard deviation 1 over all of them."""
    everything = joined(values)
    mean, scale = everything.mean(), everything.std() + 1e-8
    return [(value - mean) / scale for value in values]


def minibatches(groups: Sequence[TensorDictBase], size: int) -> Iterator[tuple[TensorDictBase, ...]]:
    """Pass once over all frames in random minibatches of ``size`` frames, in which every group has its share.

    Groups are shuffled one by one and cut at the same fractions of their lengths, so every frame is met once, but for a
    rest that is smaller than half a minibatch: it would weigh its few frames too much.
    """
    total = sum(map(len, groups))
    ends = [*range(size, total, size), total]
    if len(ends) > 1 and 2 * (total - ends[-2]) < size:
        ends.pop()
    shuffled = [frames[torch.randperm(len(frames), device=frames.device)] for frames in groups]
    for begin, end in zip([0, *ends], ends, strict=False):
        parts = [frames[_share(begin, frames, total) : _share(end, frames, total)] for frames in shuffled]
        if some := tuple(part for part in parts if len(part)):
            yield some


def _share(place: int, frames: TensorDictBase, total: int) -> int:
    """Where in a group a place among all frames is."""
    return place * len(frames) // total


def weighted_mean(values: Sequence[float], frames: Sequence[int]) -> float:
    """The mean over all frames of what has a mean over each group's; of one group its own."""
    return sum(value * (count / sum(frames)) for value, count in zip(values, frames, strict=True))
