"""``wall_touch``, ``wall_sense``, ``wall_search``, ``wall_decoy``: their targets say nothing about the opening."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from softgm_bench.envs.tasks.base import Scene, redraw_until, uniform_box
from softgm_bench.envs.tasks.columns import columns
from softgm_bench.envs.tasks.registry import register_task
from softgm_bench.envs.tasks.wall import Wall, WallConfig
from softgm_bench.rod.state import Cylinders
from softgm_bench.rod.sync import constant


@dataclass
class VariedWallConfig(WallConfig):
    """A wall whose plane may move and turn, and that may have a second opening, which is a dead end."""

    wall_x_spread: float
    wall_yaw: float
    dead_end: float | None

    def __post_init__(self) -> None:
        """Refuse values that describe no wall.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        super().__post_init__()
        if not 0.0 <= self.wall_x_spread < self.wall_x:
            raise ValueError(
                f"task.wall_x_spread is {self.wall_x_spread}: "
                f"it must be at least 0 and below task.wall_x, {self.wall_x}"
            )
        if not 0.0 <= self.wall_yaw < 90.0:
            raise ValueError(f"task.wall_yaw is {self.wall_yaw}: it must be at least 0 and below 90 degrees")
        if self.dead_end is None:
            return
        if not self.dead_end > 0.0:
            raise ValueError(f"task.dead_end is {self.dead_end}: it must be above 0, or null")
        room, apart = self.opening_y[1] - self.opening_y[0], self._widest + self.column_spacing
        if room < apart:
            raise ValueError(
                f"task.opening_y is {list(self.opening_y)}: two openings need at least {apart:g} m between its ends"
            )
        if self._widest > self.opening_side + self.column_spacing:
            raise ValueError(
                f"task.curriculum.easy_opening_side is {self._widest}: an arm could pass beside the dead end; "
                f"it must be at most {self.opening_side + self.column_spacing:g}"
            )

    @property
    def _widest(self) -> float:
        return self.curriculum.easy_opening_side if self.curriculum.enabled else self.opening_side


@register_task("wall_touch", "wall_sense", "wall_search", "wall_decoy")
class VariedWall(Wall):
    """As ``Wall``, but target and opening are independent: neither is drawn with a look at the other.

    The target is uniform in its box. The opening is redrawn until the way from the base through its centre to *every*
    point of that box is at most ``max_path`` long. That is a condition on openings alone, so the way to the farthest
    of the box's corners decides, as the length is a convex function of the target.

    The wall's plane goes through (x, 0), x within ``wall_x_spread`` of ``wall_x``, and is turned about that place's
    vertical by a yaw within ``wall_yaw`` degrees; ``opening_y`` and ``wall_y`` are places along the wall.

    With a ``dead_end`` there are two openings of the same side, one in the left and one in the right half of
    ``opening_y``. Either may be the one that leads through. So many metres behind the other stand columns that close
    it: they reach two columns' width beyond it on every side.

    A scene's ``privileged``: the opening's centre and side, m; where there is a yaw, also that, rad.
    """

    config_class: ClassVar[type[VariedWallConfig]] = VariedWallConfig

    def __init__(self, config: VariedWallConfig) -> None:
        """Lay out the columns.

        Raises:
            ValueError: as ``Wall``.
        """
        super().__init__(config)
        if config.wall_yaw:
            self.n_privileged, self.privileged_image = 5, (*Wall.privileged_image, (4, -1.0))
        self._cut = self.max_cylinders - len(self.column_y)
        self.closing = 0
        if config.dead_end is not None:
            self.closing = math.ceil(config.opening_side / config.column_spacing - 1e-9) + 2
            self._cut = min(2 * self._cut, len(self.column_y))
        self.max_cylinders = len(self.column_y) + self.closing + self._cut

    def sample(self, count: int, generator: torch.Generator, difficulty: Tensor | None = None) -> Scene:
        """Draw ``count`` scenes.

        Raises:
            ValueError: for a difficulty without ``curriculum.enabled``, whose columns might be too many.
        """
        c, device = self.config, generator.device
        if difficulty is not None and not c.curriculum.enabled:
            raise ValueError("task.curriculum.enabled is false: scenes have no difficulty")
        side, ranges = self._ranges(difficulty, device)
        where = self._where(device)
        target = uniform_box(count, ranges[3:], generator)

        def draw(n: int) -> Tensor:
            return self._openings(uniform_box(n, where, generator), side)

        def reachable(drawn: Tensor) -> Tensor:
            ways = [self._farthest(self._placed(drawn, opening)) for opening in self._split(drawn)]
            return torch.stack(ways).amax(dim=0) <= c.max_path

        drawn = redraw_until(draw, reachable, count, "opening", device)
        openings = self._split(drawn)
        centre = self._placed(drawn, openings[0])
        if difficulty is not None:
            target[:, 1:] = torch.lerp(centre[:, 1:], target[:, 1:], c.curriculum.kept_offset(difficulty))
        told = [centre, side.expand(count, 1), *([drawn[:, 1:2]] if c.wall_yaw else [])]
        return Scene(
            target=target,
            cylinders=self._cylinders(drawn, openings, side),
            privileged=torch.cat(told, dim=-1),
            batch_size=[count],
        )

    def _where(self, device: torch.device) -> Tensor:
        """Ranges of what is drawn of a wall: x, yaw, the opening's place along it and height; of the other one too."""
        c = self.config
        yaw = math.radians(c.wall_yaw)
        plane = ((c.wall_x - c.wall_x_spread, c.wall_x + c.wall_x_spread), (-yaw, yaw))
        if c.dead_end is None:
            return constant((*plane, tuple(c.opening_y), tuple(c.opening_z)), device)
        share, side = (0.0, 1.0), (-1.0, 1.0)  # of the room in one half; which half the way through is in
        return constant((*plane, share, tuple(c.opening_z), share, tuple(c.opening_z), side), device)

    def _openings(self, drawn: Tensor, side: Tensor) -> Tensor:
        """Turn draws ``(n, 4 or 7)`` into x, yaw, and place and height of one opening or two, ``(n, 4 or 6)``."""
        c = self.config
        if c.dead_end is None:
            return drawn
        middle, room = 0.5 * (c.opening_y[0] + c.opening_y[1]), 0.5 * (c.opening_y[1] - c.opening_y[0])
        nearest = 0.5 * (side + c.column_spacing)  # no column is cut twice
        sign = torch.where(drawn[:, 6] < 0.0, -1.0, 1.0)
        first = middle + sign * (nearest + (room - nearest) * drawn[:, 2])
        second = middle - sign * (nearest + (room - nearest) * drawn[:, 4])
        return torch.stack([drawn[:, 0], drawn[:, 1], first, drawn[:, 3], second, drawn[:, 5]], dim=-1)

    @staticmethod
    def _split(drawn: Tensor) -> list[Tensor]:
        """Place along the wall and height of each opening, ``(n, 2)``; the way through is the first."""
        return list(drawn[:, 2:].split(2, dim=-1))

    @staticmethod
    def _placed(drawn: Tensor, opening: Tensor, behind: float = 0.0) -> Tensor:
        """Points ``(n, ..., 3)`` from places along the walls and heights ``(n, ..., 2)``, so far behind the plane."""
        shape = (-1, *[1] * (opening.ndim - 2))
        x, yaw = (value.view(shape) for value in drawn[:, :2].unbind(-1))
        along, height = opening.unbind(-1)
        sin, cos = yaw.sin(), yaw.cos()
        return torch.stack([x + behind * cos - along * sin, behind * sin + along * cos, height], dim=-1)

    def _farthest(self, opening: Tensor) -> Tensor:
        """Length of the way from the base through a point, m, ``(n, 3)``, to the farthest target, ``(n,)``."""
        c = self.config
        corners = constant(tuple((x, y, z) for x in c.target_x for y in c.target_y for z in c.target_z), opening.device)
        return opening.norm(dim=-1) + (corners - opening.unsqueeze(1)).norm(dim=-1).amax(dim=-1)

    def _cylinders(self, drawn: Tensor, openings: list[Tensor], side: Tensor) -> Cylinders:
        """The wall, and behind its whole columns and lower parts those that close the dead end."""
        c, device, count = self.config, drawn.device, len(drawn)
        along, (low, high) = constant(self.column_y, device), c.wall_z
        places = torch.stack([along, torch.full_like(along, low)], dim=-1).expand(count, -1, 2)
        feet = self._placed(drawn, places)
        wall = columns(along, feet, openings, side, (low, high), c.column_radius, self._cut)
        if c.dead_end is None:
            return wall
        reach = 0.5 * c.opening_side + c.column_spacing
        offsets = [c.column_spacing * (i - 0.5 * (self.closing - 1)) for i in range(self.closing)]
        beside = openings[1][:, :1] + constant(tuple(offsets), device)
        places = torch.stack([beside, (openings[1][:, 1:] - reach).expand_as(beside)], dim=-1)
        start = self._placed(drawn, places, c.dead_end)
        closing = {
            "start": start,
            "axis": constant((0.0, 0.0, 1.0), device).expand_as(start),
            "length": torch.full_like(beside, 2.0 * reach),
            "radius": torch.full_like(beside, c.column_radius),
            "mask": torch.ones_like(beside, dtype=torch.bool),
        }
        n = len(self.column_y)
        fields = {
            name: torch.cat([getattr(wall, name)[:, :n], values, getattr(wall, name)[:, n:]], dim=1)
            for name, values in closing.items()
        }
        return Cylinders(**fields, batch_size=[count])
