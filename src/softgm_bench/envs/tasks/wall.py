"""``wall``, ``wall_narrow``, ``wall_fixed``: a wall of columns with one opening (paper, scenario c)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from softgm_bench.envs.tasks.base import (
    Range,
    Scene,
    Task,
    TaskConfig,
    constant,
    redraw_until,
    uniform_box,
    upright_cylinders,
)
from softgm_bench.rod.state import Cylinders


@dataclass
class WallConfig(TaskConfig):
    """Columns along z in the plane x = wall_x; the opening's centre and the target are drawn per episode."""

    wall_x: float
    column_radius: float
    column_spacing: float
    wall_y: Range
    wall_z: Range
    opening_side: float
    opening_y: Range
    opening_z: Range
    target_x: Range
    target_y: Range
    target_z: Range
    max_path: float


class Wall(Task):
    """Columns whose axis lies within half a side of the opening's centre are cut above and below it.

    Opening and target are drawn independently and redrawn together until the way from the base through the opening's
    centre to the target is at most ``max_path`` long.
    """

    config_class = WallConfig

    def __init__(self, config: WallConfig) -> None:
        """Lay out the columns.

        Raises:
            ValueError: if the opening does not fit between the wall's lower and upper edge.
        """
        super().__init__(config)
        half = 0.5 * config.opening_side
        if config.opening_z[0] - half <= config.wall_z[0] or config.opening_z[1] + half >= config.wall_z[1]:
            raise ValueError(
                f"task.opening_z is {list(config.opening_z)} with task.opening_side {config.opening_side}: "
                f"the opening must lie inside task.wall_z {list(config.wall_z)}"
            )
        width = config.wall_y[1] - config.wall_y[0]
        n_columns = math.floor(width / config.column_spacing + 1e-9) + 1
        column_y = config.wall_y[0] + config.column_spacing * torch.arange(n_columns, dtype=torch.float64)
        self.column_y: tuple[float, ...] = tuple(column_y.tolist())
        most_cut = math.floor(config.opening_side / config.column_spacing + 1e-9) + 1
        self.max_cylinders = n_columns + min(most_cut, n_columns)
        self.max_cylinder_length = config.wall_z[1] - config.wall_z[0]

    def sample(self, count: int, generator: torch.Generator) -> Scene:
        """Draw ``count`` scenes."""
        c = self.config

        def draw(n: int) -> Tensor:
            opening = uniform_box(n, ((c.wall_x, c.wall_x), c.opening_y, c.opening_z), generator)
            target = uniform_box(n, (c.target_x, c.target_y, c.target_z), generator)
            return torch.stack([opening, target], dim=1)

        def reachable(pair: Tensor) -> Tensor:
            opening, target = pair.unbind(dim=1)
            return opening.norm(dim=-1) + (target - opening).norm(dim=-1) <= c.max_path

        pair = redraw_until(draw, reachable, count, "pair of opening and target", generator.device)
        opening, target = pair.unbind(dim=1)
        return Scene(target=target, cylinders=self._columns(opening), batch_size=[count])

    def _columns(self, opening: Tensor) -> Cylinders:
        c = self.config
        half = 0.5 * c.opening_side
        column_y = constant(self.column_y, opening.device)
        cut = (column_y - opening[:, 1:2]).abs() <= half + 1e-12  # (count, n_columns)
        low, high = constant(tuple(c.wall_z), opening.device).expand(len(opening), 2).unsqueeze(1).unbind(-1)
        lower_top = torch.where(cut, opening[:, 2:3] - half, high)
        # lower (or whole) parts first, upper parts behind them; then existing ones to the front
        bottom = torch.cat([low.expand_as(cut), (opening[:, 2:3] + half).expand_as(cut)], dim=1)
        top = torch.cat([lower_top, high.expand_as(cut)], dim=1)
        mask = torch.cat([torch.ones_like(cut), cut], dim=1)
        y = column_y.repeat(2).expand_as(bottom)
        order = torch.argsort(mask.logical_not().to(torch.int8), dim=1, stable=True)[:, : self.max_cylinders]
        bottom, top, y, mask = (x.gather(1, order) for x in (bottom, top, y, mask))
        xy = torch.stack([torch.full_like(y, c.wall_x), y], dim=-1)
        return upright_cylinders(xy, bottom, top, c.column_radius, mask)
