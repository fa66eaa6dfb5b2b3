"""``wall_sliding``: the wall of ``wall`` slides along itself, there and back, and its opening with it."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from softgm_bench.envs.tasks.base import Scene, uniform
from softgm_bench.envs.tasks.registry import register_task
from softgm_bench.envs.tasks.wall import Wall, WallConfig

CENTRE_Y, RATE = 1, 4  # of a scene's ``privileged``


@dataclass
class SlidingWallConfig(WallConfig):
    """A wall whose opening's centre goes to and fro within ``opening_y`` at ``slide_speed``."""

    slide_speed: float

    def __post_init__(self) -> None:
        """Refuse values that describe no task.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        super().__post_init__()
        if not self.slide_speed >= 0.0:
            raise ValueError(f"task.slide_speed is {self.slide_speed}: it must not be negative")


@register_task("wall_sliding")
class SlidingWall(Wall):
    """Where the opening begins and in which direction it moves is drawn; at the ends of its range it turns back.

    A scene's ``privileged``: the opening's centre and side, m, as they are now, and its velocity along y, m/s.
    """

    config_class: ClassVar[type[SlidingWallConfig]] = SlidingWallConfig
    n_privileged = 5
    privileged_image = (*Wall.privileged_image, (4, -1.0))
    moves = True

    def sample(self, count: int, generator: torch.Generator, difficulty: Tensor | None = None) -> Scene:
        """Draw ``count`` scenes as ``Wall`` does, then the directions."""
        scene = super().sample(count, generator, difficulty)
        towards = torch.where(uniform(count, (-1.0, 1.0), generator) < 0.0, -1.0, 1.0).to(scene.privileged)
        rate = self.config.slide_speed * towards.unsqueeze(-1)
        return scene.replace(privileged=torch.cat([scene.privileged, rate], dim=-1))

    def advance(self, scene: Scene, step: Tensor, duration: float) -> Scene:
        """Slide on; what would lead beyond an end of the range leads as far back from it."""
        low, high = self.config.opening_y
        y, rate = scene.privileged[:, CENTRE_Y], scene.privileged[:, RATE]
        there = y + duration * rate
        beyond = (there > high) | (there < low)
        there = torch.where(there > high, 2.0 * high - there, torch.where(there < low, 2.0 * low - there, there))
        there = there.clamp(low, high)
        privileged, start = scene.privileged.clone(), scene.cylinders.start.clone()
        privileged[:, CENTRE_Y], privileged[:, RATE] = there, torch.where(beyond, -rate, rate)
        start[..., 1] += (there - y).unsqueeze(-1)
        return scene.replace(cylinders=scene.cylinders.replace(start=start), privileged=privileged)
