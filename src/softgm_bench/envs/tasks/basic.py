"""``basic``: reach a target anywhere around the arm, no obstacles (paper, scenario a)."""

import math
from dataclasses import dataclass

import torch

from softgm_bench.envs.tasks.base import (
    Range,
    Scene,
    Task,
    TaskConfig,
    constant,
    no_cylinders,
    redraw_until,
    uniform,
)


@dataclass
class BasicConfig(TaskConfig):
    """Targets in spherical coordinates about the base."""

    target_distance: Range
    target_polar_angle: Range
    resting_tip: tuple[float, float, float]
    min_distance_to_resting_tip: float


class Basic(Task):
    """Any azimuth; distance and polar angle from +z uniform in their ranges."""

    config_class = BasicConfig

    def sample(self, count: int, generator: torch.Generator) -> Scene:
        """Draw ``count`` scenes."""
        c = self.config
        device = generator.device
        tip = constant(tuple(c.resting_tip), device)

        def draw(n: int) -> torch.Tensor:
            distance = uniform(n, c.target_distance, generator)
            polar = torch.deg2rad(uniform(n, c.target_polar_angle, generator))
            azimuth = uniform(n, (0.0, 2.0 * math.pi), generator)
            direction = torch.stack(
                [polar.sin() * azimuth.cos(), polar.sin() * azimuth.sin(), polar.cos()],
                dim=-1,
            )
            return distance.unsqueeze(-1) * direction

        def accept(target: torch.Tensor) -> torch.Tensor:
            return (target - tip).norm(dim=-1) >= c.min_distance_to_resting_tip

        target = redraw_until(draw, accept, count, "target", device)
        return Scene(target=target, cylinders=no_cylinders(count, device), batch_size=[count])
