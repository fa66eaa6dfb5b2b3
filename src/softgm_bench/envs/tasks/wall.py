"""``wall``, ``wall_narrow``, ``wall_fixed``: a wall of columns with one opening (paper, scenario c)."""

import math
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from softgm_bench.envs.tasks.base import (
    CurriculumConfig,
    Range,
    Scene,
    Task,
    TaskConfig,
    redraw_until,
    uniform_box,
)
from softgm_bench.envs.tasks.columns import columns
from softgm_bench.envs.tasks.registry import register_task
from softgm_bench.rod.state import Cylinders
from softgm_bench.rod.sync import constant


@dataclass
class WallCurriculumConfig(CurriculumConfig):
    """Opening and targets of the easiest scenes."""

    easy_opening_side: float
    easy_target_x: Range
    easy_target_offset: float
    target_power: float

    def __post_init__(self) -> None:
        """Refuse values by which nothing could be decided or drawn.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        super().__post_init__()
        if not 0.0 <= self.easy_target_offset <= 1.0:
            raise ValueError(
                f"task.curriculum.easy_target_offset is {self.easy_target_offset}: it must lie between 0 and 1"
            )
        if not self.target_power > 0.0:
            raise ValueError(f"task.curriculum.target_power is {self.target_power}: it must be above 0")

    def kept_offset(self, difficulty: Tensor) -> Tensor:
        """The share of its distance in y and z from the opening's centre that a target keeps; exactly 1 at the end."""
        # 1 keeps the digits that were there before there was a power
        own = difficulty if self.target_power == 1.0 else 1.0 - (1.0 - difficulty) ** self.target_power
        return own if self.easy_target_offset == 0.0 else own + self.easy_target_offset * (1.0 - own)


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
    max_path: float = field(metadata={"infinite": True})  # m; an infinity: every pair
    curriculum: WallCurriculumConfig


@register_task("wall", "wall_narrow", "wall_fixed")
class Wall(Task):
    """Columns whose axis lies within half a side of the opening's centre are cut above and below it.

    Opening and target are drawn independently and redrawn together until the way from the base through the opening's
    centre to the target is at most ``max_path`` long. In the easiest scenes of a curriculum the opening is wider, and
    the target nearer and straight behind its centre (same y and z), or ``easy_target_offset`` of the way to its own
    place from there.

    A scene's ``privileged``: the opening's centre and side, m.
    """

    config_class: ClassVar[type[WallConfig]] = WallConfig
    n_privileged = 4
    n_points = 1
    privileged_image: tuple[tuple[int, float], ...] = ((0, 1.0), (1, -1.0), (2, 1.0), (3, 1.0))

    def __init__(self, config: WallConfig) -> None:
        """Lay out the columns.

        Raises:
            ValueError: if the opening does not fit between the wall's lower and upper edge, or the curriculum's
                easiest one is not wider.
        """
        super().__init__(config)
        widest = config.opening_side
        check_opening(config, "task.opening_side", widest)
        if config.curriculum.enabled:
            widest = config.curriculum.easy_opening_side
            check_opening(config, "task.curriculum.easy_opening_side", widest)
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
        side, box = self._ranges(difficulty, generator.device)

        def draw(n: int) -> Tensor:
            pair = uniform_box(n, box, generator).unflatten(-1, (2, 3))
            if difficulty is not None:
                pair[:, 1, 1:] = torch.lerp(pair[:, 0, 1:], pair[:, 1, 1:], c.curriculum.kept_offset(difficulty))
            return pair

        def reachable(pair: Tensor) -> Tensor:
            opening, target = pair.unbind(dim=1)
            return opening.norm(dim=-1) + (target - opening).norm(dim=-1) <= c.max_path

        pair = redraw_until(draw, reachable, count, "pair of opening and target", generator.device)
        opening, target = pair.unbind(dim=1)
        return Scene(
            target=target,
            cylinders=self._columns(opening, side),
            privileged=torch.cat([opening, side.expand(count, 1)], dim=-1),
            batch_size=[count],
        )

    def _ranges(self, difficulty: Tensor | None, device: torch.device) -> tuple[Tensor, Tensor]:
        """Give the opening's side and the ranges of its centre's and the target's coordinates, ``(6, 2)``."""
        c, easy = self.config, self.config.curriculum
        opening = ((c.wall_x, c.wall_x), tuple(c.opening_y), tuple(c.opening_z))
        sideways = (tuple(c.target_y), tuple(c.target_z))
        own = ((c.opening_side,) * 2, *opening, tuple(c.target_x), *sideways)
        ranges = constant(own, device)
        if difficulty is not None:
            easiest = ((easy.easy_opening_side,) * 2, *opening, tuple(easy.easy_target_x), *sideways)
            ranges = torch.lerp(constant(easiest, device), ranges, difficulty)  # exact at both ends
        return ranges[0, 0], ranges[1:]

    def _columns(self, opening: Tensor, side: Tensor) -> Cylinders:
        c, device = self.config, opening.device
        along = constant(self.column_y, device)
        feet = constant(tuple((c.wall_x, y, c.wall_z[0]) for y in self.column_y), device)
        more = self.max_cylinders - len(self.column_y)
        return columns(along, feet, [opening[:, 1:]], side, tuple(c.wall_z), c.column_radius, more)


def check_opening(config: WallConfig, name: str, side: float) -> None:
    """Refuse an opening that does not fit between the wall's lower and upper edge.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    half = 0.5 * side
    if config.opening_z[0] - half <= config.wall_z[0] or config.opening_z[1] + half >= config.wall_z[1]:
        raise ValueError(
            f"task.opening_z is {list(config.opening_z)} with {name} {side}: "
            f"the opening must lie inside task.wall_z {list(config.wall_z)}"
        )
