"""``wall``, ``wall_narrow``, ``wall_fixed``: a wall of columns with one opening (paper, scenario c)."""

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from softgm_bench.envs.tasks.base import (
    CurriculumConfig,
    Range,
    Scene,
    Task,
    TaskConfig,
    constant,
    eased,
    redraw_until,
    uniform_box,
    upright_cylinders,
)
from softgm_bench.envs.tasks.registry import register_task
from softgm_bench.rod.state import Cylinders


@dataclass
class WallCurriculumConfig(CurriculumConfig):
    """Opening and targets of the easiest scenes."""

    easy_opening_side: float
    easy_target_x: Range


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
    curriculum: WallCurriculumConfig


@register_task("wall", "wall_narrow", "wall_fixed")
class Wall(Task):
    """Columns whose axis lies within half a side of the opening's centre are cut above and below it.

    Opening and target are drawn independently and redrawn together until the way from the base through the opening's
    centre to the target is at most ``max_path`` long. In the easiest scenes of a curriculum the opening is wider, and
    the target nearer and straight behind its centre (same y and z).

    A scene's ``privileged``: the opening's centre and side, m.
    """

    config_class = WallConfig
    n_privileged = 4
    n_points = 1

    def __init__(self, config: WallConfig) -> None:
        """Lay out the columns.

        Raises:
            ValueError: if the opening does not fit between the wall's lower and upper edge, or the curriculum's
                easiest one is not wider.
        """
        super().__init__(config)
        widest = config.opening_side
        _check_opening(config, "task.opening_side", widest)
        if config.curriculum.enabled:
            widest = config.curriculum.easy_opening_side
            _check_opening(config, "task.curriculum.easy_opening_side", widest)
            if widest < config.opening_side:
                raise ValueError(
                    f"task.curriculum.easy_opening_side is {widest}: it must be at least task.opening_side, "
                    f"{config.opening_side}"
                )
        width = config.wall_y[1] - config.wall_y[0]
        n_columns = math.floor(width / config.column_spacing + 1e-9) + 1
        column_y = config.wall_y[0] + config.column_spacing * torch.arange(n_columns, dtype=torch.float64)
        self.column_y: tuple[float, ...] = tuple(column_y.tolist())
        most_cut = math.floor(widest / config.column_spacing + 1e-9) + 1
        self.max_cylinders = n_columns + min(most_cut, n_columns)
        self.max_cylinder_length = config.wall_z[1] - config.wall_z[0]

    def sample(self, count: int, generator: torch.Generator, difficulty: Tensor | None = None) -> Scene:
        """Draw ``count`` scenes.

        Raises:
            ValueError: for a difficulty without ``curriculum.enabled``, whose columns might be too many.
        """
        c = self.config
        if difficulty is not None and not c.curriculum.enabled:
            raise ValueError("task.curriculum.enabled is false: scenes have no difficulty")
        (side,) = eased([c.curriculum.easy_opening_side], [c.opening_side], difficulty)
        target_x = eased(c.curriculum.easy_target_x, c.target_x, difficulty)

        def draw(n: int) -> Tensor:
            opening = uniform_box(n, ((c.wall_x, c.wall_x), c.opening_y, c.opening_z), generator)
            target = uniform_box(n, (target_x, c.target_y, c.target_z), generator)
            if difficulty is not None:
                sideways = torch.lerp(opening[:, 1:], target[:, 1:], difficulty)
                target = torch.cat([target[:, :1], sideways], dim=-1)
            return torch.stack([opening, target], dim=1)

        def reachable(pair: Tensor) -> Tensor:
            opening, target = pair.unbind(dim=1)
            return opening.norm(dim=-1) + (target - opening).norm(dim=-1) <= c.max_path

        pair = redraw_until(draw, reachable, count, "pair of opening and target", generator.device)
        opening, target = pair.unbind(dim=1)
        return Scene(
            target=target,
            cylinders=self._columns(opening, side),
            privileged=torch.cat([opening, torch.zeros_like(opening[:, :1]) + side], dim=-1),
            batch_size=[count],
        )

    def _columns(self, opening: Tensor, side: float | Tensor) -> Cylinders:
        c = self.config
        half = 0.5 * side
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


def _check_opening(config: WallConfig, name: str, side: float) -> None:
    half = 0.5 * side
    if config.opening_z[0] - half <= config.wall_z[0] or config.opening_z[1] + half >= config.wall_z[1]:
        raise ValueError(
            f"task.opening_z is {list(config.opening_z)} with {name} {side}: "
            f"the opening must lie inside task.wall_z {list(config.wall_z)}"
        )
