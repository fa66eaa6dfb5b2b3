"""The contract of a task: a configuration, and scenes drawn for any number of environments at once."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import torch
from tensordict import TensorClass
from torch import Tensor

from softgm_bench.envs.section_mixture import check_numbers
from softgm_bench.rod import sync
from softgm_bench.rod.state import Cylinders
from softgm_bench.rod.sync import constant

POOL = 4096  # fewest values among which admissible ones are looked for where nobody may count them

Range = tuple[float, float]
Bounds = Sequence[float | Tensor]  # of two: numbers, or tensors without dimensions

CONTACT_COUNTS = ("at_end", "within")  # of a control step, see ``conf/task``


@dataclass
class RewardConfig:
    """Coefficients of the eight reward terms, named as in the paper; values in ``conf/task/reward``."""

    lambda_p: float
    lambda_da: float
    lambda_t: float
    lambda_c: float
    lambda_cn: float
    lambda_d: float
    k_max: int
    lambda_s: float
    epsilon: float
    lambda_succ: float
    lambda_fail: float


@dataclass
class ActuationConfig:
    """Settings by which actions become couples on the rod; see ``softgm_bench.rod.actuation``."""

    basis: str
    scaling: str
    max_torque: float


@dataclass
class CurriculumConfig:
    """Settings by which training may begin with easier scenes; values and their meaning in ``conf/task/curriculum``.

    Tasks add the scenes' easiest ranges; ``softgm_bench.envs.curriculum`` moves between them and the task's own.
    """

    enabled: bool
    stages: int
    episodes: int
    promote: float
    demote: float
    easier_share: float
    easy_contact_steps: int | None
    contact_stages: int
    easy_lambda_c: float | None

    def __post_init__(self) -> None:
        """Refuse values by which nothing could be decided.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        for name in ("stages", "episodes"):
            if getattr(self, name) < 1:
                raise ValueError(f"task.curriculum.{name} is {getattr(self, name)}: it must be at least 1")
        if not 0.0 <= self.demote < self.promote < 1.0:
            raise ValueError(
                f"task.curriculum.demote is {self.demote}, task.curriculum.promote {self.promote}: "
                "the first must be the smaller one, both at least 0 and below 1"
            )
        if not 0.0 <= self.easier_share < 1.0:
            raise ValueError(f"task.curriculum.easier_share is {self.easier_share}: it must be at least 0 and below 1")
        if not 0 <= self.contact_stages < self.stages:
            raise ValueError(
                f"task.curriculum.contact_stages is {self.contact_stages}: "
                f"it must be at least 0 and below task.curriculum.stages, {self.stages}"
            )
        if self.contact_stages and self.easy_contact_steps is None and self.easy_lambda_c is None:
            raise ValueError(
                f"task.curriculum.contact_stages is {self.contact_stages}: without task.curriculum.easy_contact_steps "
                "or easy_lambda_c nothing would change in these stages; it must be 0"
            )


@dataclass
class TaskConfig:
    """Settings that every task has; values and their meaning in ``conf/task``.

    ``n_agents`` is a number, or the list of those that a mixture has (``envs.section_mixture``).
    """

    name: str
    n_agents: Any
    horizon: int
    success_radius: float
    min_dilatation: float
    max_dilatation: float
    sensing_radius: float
    bin_length: float
    slots: int
    train_horizon: int | None
    hidden_scene: bool
    max_contact_steps: int | None
    contact_counts: str
    friction_coefficient: float | None
    velocity_damping_coefficient: float | None
    actuation: ActuationConfig
    reward: RewardConfig
    curriculum: CurriculumConfig

    def __post_init__(self) -> None:
        """Refuse values that describe no task.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        check_numbers(self.n_agents)
        for name, lowest in (("horizon", 1), ("slots", 0)):
            if getattr(self, name) < lowest:
                raise ValueError(f"task.{name} is {getattr(self, name)}: it must be at least {lowest}")
        if self.train_horizon is not None and self.train_horizon < 1:
            raise ValueError(f"task.train_horizon is {self.train_horizon}: it must be at least 1, or null")
        if self.max_contact_steps is not None and self.max_contact_steps < 0:
            raise ValueError(f"task.max_contact_steps is {self.max_contact_steps}: it must be at least 0, or null")
        if self.contact_counts not in CONTACT_COUNTS:
            raise ValueError(
                f"task.contact_counts is {self.contact_counts!r}: it must be {' or '.join(CONTACT_COUNTS)}, "
                "where a step counts as one in contact"
            )
        own, easy = self.max_contact_steps, self.curriculum.easy_contact_steps
        if easy is not None and (own is None or easy < own):
            raise ValueError(
                f"task.curriculum.easy_contact_steps is {easy}, task.max_contact_steps {own}: "
                "the easiest scenes allow no less contact than the task, whose limit must be a number; null: as much"
            )
        cost, easy_cost = self.reward.lambda_c, self.curriculum.easy_lambda_c
        if easy_cost is not None and easy_cost < cost:
            raise ValueError(
                f"task.curriculum.easy_lambda_c is {easy_cost}, task.reward.lambda_c {cost}: "
                "contact costs no more in the easiest scenes than in the task's own; null: as much"
            )
        for name in ("friction_coefficient", "velocity_damping_coefficient"):
            value = getattr(self, name)
            if value is not None and not value >= 0.0:
                raise ValueError(f"task.{name} is {value}: it must not be negative; null: the rod's")
        for name in ("success_radius", "sensing_radius", "bin_length"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"task.{name} is {getattr(self, name)}: it must be above 0")
        if not 0.0 <= self.min_dilatation < 1.0 < self.max_dilatation:
            raise ValueError(
                f"task.min_dilatation is {self.min_dilatation}, task.max_dilatation {self.max_dilatation}: "
                "1, the dilatation at rest, must lie between them"
            )


class Scene(TensorClass):
    """The scenes that a reset draws; ``batch_size`` is ``(num_envs,)``.

    Attributes:
        target: m, ``(num_envs, 3)``.
        cylinders: the obstacles, padded to the task's ``max_cylinders``.
        privileged: what describes the scene and must be found out by interaction, ``(num_envs, n_privileged)``.
    """

    target: Tensor
    cylinders: Cylinders
    privileged: Tensor


class Task(ABC):
    """One family of scenes.

    A new task is one file with a configuration dataclass and a subclass, and one YAML file with the values.

    Attributes:
        max_cylinders: the number that scenes are padded to.
        max_cylinder_length: the longest cylinder of any scene, m; 0 where there is none.
        n_privileged: numbers in a scene's ``privileged``.
        n_points: points among them, m; the first ``3 n_points`` numbers are their coordinates.
        privileged_image: what a mirror in the plane y = 0 makes of them: for each number of the image the index of the
            number that is there, and the sign that it gets; only an oracle's mirrored actor needs it.
        moves: whether cylinders move, by ``advance``.
    """

    config_class: ClassVar[type[TaskConfig]]
    max_cylinders: int = 0
    max_cylinder_length: float = 0.0
    n_privileged: int = 0
    n_points: int = 0
    privileged_image: tuple[tuple[int, float], ...] = ()
    moves: bool = False

    def __init__(self, config: Any) -> None:
        """Keep the configuration."""
        self.config = config

    @abstractmethod
    def sample(self, count: int, generator: torch.Generator, difficulty: Tensor | None = None) -> Scene:
        """Draw ``count`` scenes, float64, on the generator's device.

        Args:
            count: number of scenes.
            generator: to draw from.
            difficulty: from 0, easiest, to 1, float64 without dimensions on the generator's device; for
                configurations with ``curriculum.enabled``. None and 1 give the same scenes from the same generator
                state, bit by bit, which may differ in the number of masked cylinders behind the others.
        """

    def advance(self, scene: Scene, step: Tensor, duration: float) -> Scene:
        """Give the scenes one control step later, where the task ``moves`` cylinders.

        From where a cylinder starts in one to where it starts in the other it moves on a straight line at a constant
        speed, and contact is damped against that velocity. All that motion depends on is in the scene, as in its
        ``privileged``, or follows from the step.

        Args:
            scene: as it is now, not to be changed in place, floating numbers in the simulation's type.
            step: control steps since the episodes began, ``(num_envs,)`` int64; staggered ones began at any.
            duration: of a control step, s.

        Returns:
            Scenes that differ in the cylinders' ``start`` and in ``privileged`` alone: nothing turns or grows.
        """
        return scene


def eased(easy: Sequence[float], own: Sequence[float], difficulty: Tensor | None) -> Bounds:
    """Numbers of a scene at a difficulty: ``easy`` at 0, ``own`` at 1 or without one, on a straight line between."""
    if difficulty is None:
        return own
    first, last = constant((tuple(easy), tuple(own)), difficulty.device)
    # exact at both ends, where first + difficulty * (last - first) is not
    return torch.lerp(first, last, difficulty).unbind(0)


def uniform(count: int, bounds: Bounds, generator: torch.Generator) -> Tensor:
    """Draw from ``[low, high]``: ``(count,)`` float64."""
    low, high = bounds
    noise = torch.rand(count, generator=generator, device=generator.device, dtype=torch.float64)
    return low + (high - low) * noise


def uniform_box(count: int, bounds: Sequence[Bounds] | Tensor, generator: torch.Generator) -> Tensor:
    """Draw points from a box of any dimension d: ``(count, d)`` float64, one axis after the other.

    ``bounds``: of each axis, or a tensor ``(d, 2)``.
    """
    if not isinstance(bounds, Tensor):
        if any(isinstance(bound, Tensor) for axis in bounds for bound in axis):
            return torch.stack([uniform(count, axis, generator) for axis in bounds], dim=-1)
        bounds = constant(tuple(tuple(axis) for axis in bounds), generator.device)
    low, high = bounds.unsqueeze(-1).unbind(1)
    noise = torch.rand((len(bounds), count), generator=generator, device=generator.device, dtype=torch.float64)
    return (low + (high - low) * noise).mT.contiguous()


def redraw_until(
    draw: Callable[[int], Tensor],
    accept: Callable[[Tensor], Tensor],
    count: int,
    what: str,
    device: torch.device,
) -> Tensor:
    """Rejection sampling for a whole batch: redraw the rejected rows until all are accepted.

    Where nobody may look at values (``sync.is_free``) see ``first_accepted``.

    Raises:
        ValueError: if some rows are still rejected after 1000 rounds: the ranges leave (almost) nothing.
    """
    if not sync.is_free(device):
        return first_accepted(draw, accept, count)
    values = draw(count)
    for _ in range(1000):
        rejected = (~accept(values)).nonzero().squeeze(-1)
        if len(rejected) == 0:
            return values
        values[rejected] = draw(len(rejected))
    raise ValueError(f"task: no admissible {what} found in 1000 draws: widen its ranges")


def first_accepted(draw: Callable[[int], Tensor], accept: Callable[[Tensor], Tensor], count: int) -> Tensor:
    """Rejection sampling in shapes that do not depend on values: the first ``count`` accepted ones of a large pool.

    Should the pool hold fewer, which takes an acceptance of a few per cent, rows share a value.
    """
    size = max(POOL, 16 * count)
    values = draw(size)
    rank = accept(values).cumsum(0)  # of an accepted one, from 1
    wanted = _counted_up(count, values.device) % rank[-1:].clamp(min=1)
    # behind the last place stands one that is not there if none is accepted
    return values[torch.searchsorted(rank, wanted, right=True).clamp(max=size - 1)]


@lru_cache
def _counted_up(count: int, device: torch.device) -> Tensor:
    """0, 1, .., count - 1; made once, not to be changed."""
    return torch.arange(count, device=device)


def no_cylinders(count: int, device: torch.device) -> Cylinders:
    """Scenes without obstacles."""
    empty = torch.empty((count, 0), dtype=torch.float64, device=device)
    vectors = empty.unsqueeze(-1).expand(count, 0, 3)
    return Cylinders(
        start=vectors,
        axis=vectors,
        length=empty,
        radius=empty,
        mask=empty.bool(),
        batch_size=[count],
    )


def upright_cylinders(xy: Tensor, bottom: Tensor, top: Tensor, radius: float, mask: Tensor) -> Cylinders:
    """Cylinders along +z.

    Args:
        xy: axes' positions, m, ``(count, n_cylinders, 2)``.
        bottom: height of the lower end, m, ``(count, n_cylinders)``.
        top: height of the upper end, m, ``(count, n_cylinders)``.
        radius: of all of them, m.
        mask: which exist, ``(count, n_cylinders)`` bool.
    """
    axis = torch.zeros((*bottom.shape, 3), dtype=bottom.dtype, device=bottom.device)
    axis[..., 2].fill_(1.0)
    return Cylinders(
        start=torch.cat([xy, bottom.unsqueeze(-1)], dim=-1),
        axis=axis,
        # a masked cylinder keeps a positive length so that nothing divides by zero
        length=torch.where(mask, top - bottom, 1.0),
        radius=torch.full_like(bottom, radius),
        mask=mask,
        batch_size=bottom.shape[:1],
    )
