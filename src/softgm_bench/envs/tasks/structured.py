"""``structured``: two fixed posts between the arm and the targets (paper, scenario b)."""

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
    uniform_box,
    upright_cylinders,
)
from softgm_bench.envs.tasks.registry import register_task
from softgm_bench.rod.sync import constant


@dataclass
class StructuredCurriculumConfig(CurriculumConfig):
    """Targets of the easiest scenes."""

    easy_target_x: Range
    easy_target_y: Range
    easy_target_z: Range


@dataclass
class StructuredConfig(TaskConfig):
    """Posts along z at (x, +-y), targets in a box."""

    post_radius: float
    post_x: float
    post_y: float
    post_z: Range
    target_x: Range
    target_y: Range
    target_z: Range
    curriculum: StructuredCurriculumConfig


@register_task("structured")
class Structured(Task):
    """The posts stand still; only the target is drawn."""

    config_class = StructuredConfig
    max_cylinders = 2

    def __init__(self, config: StructuredConfig) -> None:
        """Note the posts' length."""
        super().__init__(config)
        self.max_cylinder_length = config.post_z[1] - config.post_z[0]

    def sample(self, count: int, generator: torch.Generator, difficulty: Tensor | None = None) -> Scene:
        """Draw ``count`` scenes."""
        c, easy = self.config, self.config.curriculum
        xy = constant(((c.post_x, -c.post_y), (c.post_x, c.post_y)), generator.device).expand(count, 2, 2)
        bottom = torch.full_like(xy[..., 0], c.post_z[0])
        top = torch.full_like(bottom, c.post_z[1])
        posts = upright_cylinders(xy, bottom, top, c.post_radius, torch.ones_like(bottom, dtype=torch.bool))
        box = (
            eased(easy.easy_target_x, c.target_x, difficulty),
            eased(easy.easy_target_y, c.target_y, difficulty),
            eased(easy.easy_target_z, c.target_z, difficulty),
        )
        target = uniform_box(count, box, generator)
        return Scene(target=target, cylinders=posts, privileged=target[:, :0], batch_size=[count])
