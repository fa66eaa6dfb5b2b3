"""``basic``: reach a target anywhere around the arm, no obstacles (paper, scenario a)."""

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
    eased,
    no_cylinders,
    redraw_until,
    uniform,
)
from softgm_bench.envs.tasks.registry import register_task
from softgm_bench.rod.sync import constant


@dataclass
class BasicCurriculumConfig(CurriculumConfig):
    """Targets of the easiest scenes."""

    easy_target_distance: Range
    easy_target_polar_angle: Range


@dataclass
class BasicConfig(TaskConfig):
    """Targets in spherical coordinates about the base."""

    target_distance: Range
    target_polar_angle: Range
    resting_tip: tuple[float, float, float]
    min_distance_to_resting_tip: float
    curriculum: BasicCurriculumConfig


@register_task("basic")
class Basic(Task):
    """Any azimuth; distance and polar angle from +z uniform in their ranges."""

    config_class = BasicConfig

    def sample(self, count: int, generator: torch.Generator, difficulty: Tensor | None = None) -> Scene:
        """Draw ``count`` scenes."""
        c = self.config
        device = generator.device
        tip = constant(tuple(c.resting_tip), device)
        distances = eased(c.curriculum.easy_target_distance, c.target_distance, difficulty)
        polar_angles = eased(c.curriculum.easy_target_polar_angle, c.target_polar_angle, difficulty)

        def draw(n: int) -> Tensor:
            distance = uniform(n, distances, generator)
            polar = torch.deg2rad(uniform(n, polar_angles, generator))
            azimuth = uniform(n, (0.0, 2.0 * math.pi), generator)
            direction = torch.stack(
                [polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()],
                dim=-1,
            )
            return distance.unsqueeze(-1) * direction

        def accept(target: Tensor) -> Tensor:
            return (target - tip).norm(dim=-1) >= c.min_distance_to_resting_tip

        target = redraw_until(draw, accept, count, "target", device)
        cylinders = no_cylinders(count, device)
        return Scene(target=target, cylinders=cylinders, privileged=target[:, :0], batch_size=[count])
