"""``swinging_posts``: the posts of ``structured`` swing from side to side."""

import math
from dataclasses import dataclass
from typing import ClassVar

import torch
from torch import Tensor

from softgm_bench.envs.tasks.base import Scene, uniform_box
from softgm_bench.envs.tasks.registry import register_task
from softgm_bench.envs.tasks.structured import Structured, StructuredConfig
from softgm_bench.rod.sync import constant


@dataclass
class SwingingPostsConfig(StructuredConfig):
    """Posts that swing along y about their places in ``structured``, each with a phase of its own."""

    swing_amplitude: float
    swing_period: float

    def __post_init__(self) -> None:
        """Refuse values that describe no task.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        super().__post_init__()
        room = self.post_y - self.post_radius
        if not 0.0 <= self.swing_amplitude < room:
            raise ValueError(
                f"task.swing_amplitude is {self.swing_amplitude}: it must be at least 0 and below {room:g}, "
                "where the posts would meet"
            )
        if not self.swing_period > 0.0:
            raise ValueError(f"task.swing_period is {self.swing_period}: it must be above 0")


@register_task("swinging_posts")
class SwingingPosts(Structured):
    """Both posts move along y as sines of one period, upright; their phases and the target are drawn.

    A scene's ``privileged``: the middles of both posts as they are now, m, and their velocities along y, m/s.
    """

    config_class: ClassVar[type[SwingingPostsConfig]] = SwingingPostsConfig
    n_privileged = 8
    n_points = 2
    # the image of the right post is the left one's
    privileged_image = ((3, 1.0), (4, -1.0), (5, 1.0), (0, 1.0), (1, -1.0), (2, 1.0), (7, -1.0), (6, -1.0))
    moves = True

    def sample(self, count: int, generator: torch.Generator, difficulty: Tensor | None = None) -> Scene:
        """Draw ``count`` scenes as ``Structured`` does, then the phases."""
        scene, c = super().sample(count, generator, difficulty), self.config
        phase = uniform_box(count, ((0.0, 2.0 * math.pi),) * 2, generator)  # (count, 2)
        frequency = 2.0 * math.pi / c.swing_period
        return self._at(scene, c.swing_amplitude * phase.sin(), c.swing_amplitude * frequency * phase.cos())

    def advance(self, scene: Scene, step: Tensor, duration: float) -> Scene:
        """Swing on: place and velocity of a harmonic oscillator turn by an angle."""
        frequency = 2.0 * math.pi / self.config.swing_period
        cosine, sine = math.cos(frequency * duration), math.sin(frequency * duration)
        away, rate = scene.cylinders.start[..., 1] - self._rest(scene), scene.privileged[:, 6:]
        return self._at(scene, cosine * away + sine / frequency * rate, cosine * rate - sine * frequency * away)

    def _rest(self, scene: Scene) -> Tensor:
        """Places along y about which the posts swing, m, ``(2,)``."""
        return constant((-self.config.post_y, self.config.post_y), scene.target.device).to(scene.target.dtype)

    def _at(self, scene: Scene, away: Tensor, rate: Tensor) -> Scene:
        """Put the posts ``away`` from where they rest, m, at this ``rate``, m/s, ``(count, 2)`` each."""
        posts = scene.cylinders
        start = posts.start.clone()
        start[..., 1] = self._rest(scene) + away
        middle = start + 0.5 * posts.length.unsqueeze(-1) * posts.axis
        privileged = torch.cat([middle.flatten(1), rate], dim=-1)
        return scene.replace(cylinders=posts.replace(start=start), privileged=privileged)
