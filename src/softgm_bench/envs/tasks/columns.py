"""A wall of touching upright columns, some of them cut into a lower and an upper part at openings."""

from collections.abc import Sequence

import torch
from torch import Tensor

from softgm_bench.envs.tasks.base import Range
from softgm_bench.rod.state import Cylinders
from softgm_bench.rod.sync import constant


def columns(
    along: Tensor,
    feet: Tensor,
    openings: Sequence[Tensor],
    side: Tensor,
    height: Range,
    radius: float,
    more: int,
) -> Cylinders:
    """Whole columns and the lower parts of cut ones, then the upper parts of these; existing ones first.

    Args:
        along: the columns' places along the wall, m, ``(n,)``.
        feet: their lower ends, m, ``(n, 3)``, or ``(count, n, 3)`` where they differ from scene to scene.
        openings: of each opening the place of its centre along the wall and its height, m, ``(count, 2)``. No column
            is cut by two of them.
        side: of the openings, m, without dimensions; columns within half of it of a centre are cut.
        height: of the wall's lower and upper edge, m: columns stand from the first to the second.
        radius: of the columns, m.
        more: upper parts that there is room for.
    """
    device, (count, _), n = along.device, openings[0].shape, len(along)
    half, (low, high) = 0.5 * side, height
    y, z = openings[0][:, :1], openings[0][:, 1:]
    cut = (along - y).abs() <= half + 1e-12  # (count, n)
    for opening in openings[1:]:
        here = (along - opening[:, :1]).abs() <= half + 1e-12
        cut, z = cut | here, torch.where(here, opening[:, 1:], z)
    lower_top = torch.where(cut, z - half, constant((high,), device))
    upper_bottom = z + half
    exists, order = cut.to(torch.int8).sort(dim=1, stable=True, descending=True)
    exists, order = exists[:, :more].bool(), order[:, :more]
    if len(openings) > 1:
        upper_bottom = upper_bottom.gather(1, order)
    if feet.ndim == 2:
        cut_feet, feet = feet[order], feet.expand(count, n, 3)
    else:
        cut_feet = feet.gather(1, order.unsqueeze(-1).expand(-1, -1, 3))
    upper = torch.cat([cut_feet[..., :2], upper_bottom.unsqueeze(-1).expand(count, more, 1)], dim=-1)
    # a masked cylinder keeps a positive length so that nothing divides by zero
    upper_length = torch.where(exists, high - upper_bottom, constant((1.0,), device))
    start = torch.cat([feet, upper], dim=1)
    return Cylinders(
        start=start,
        axis=constant((0.0, 0.0, 1.0), device).expand_as(start),
        length=torch.cat([lower_top - low, upper_length], dim=1),
        radius=constant((radius,), device).expand(count, n + more),
        mask=torch.nn.functional.pad(exists, (n, 0), value=True),
        batch_size=[count],
    )
