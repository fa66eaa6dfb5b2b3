"""A curriculum over a task's scenes, gated by success; for training environments only.

Difficulty rises in ``stages`` equal steps from 0, the easiest scenes, to 1, the task's own. All environments of one
object share the stage. It moves after a round, of which every environment counts its first episodes and no others: a
window over the episodes that end first would hold the quick ones, which are successes.

A share of the environments, the last ones, may draw from all that is easier than the stage instead. They decide on
nothing, and keep in use what the earlier stages taught.

A round can end in any step, and nothing here looks at values: see ``softgm_bench.rod.sync``.
"""

import math
from functools import lru_cache

import torch
from tensordict import TensorClass
from torch import Tensor

from softgm_bench.envs.tasks.base import CurriculumConfig, TaskConfig


class Progress(TensorClass):
    """The standing of a curriculum; ``batch_size`` is ``(num_envs,)``.

    Attributes:
        stage: from 0 to ``stages``, ``(num_envs,)`` int64; the same everywhere.
        counting: the episode under way began in this round, ``(num_envs,)`` bool.
        counted: episodes of this round, ``(num_envs,)`` int64.
        succeeded: how many of these were successes, ``(num_envs,)`` int64.
    """

    stage: Tensor
    counting: Tensor
    counted: Tensor
    succeeded: Tensor


def first_progress(num_envs: int, device: torch.device) -> Progress:
    """Stand at the easiest stage, before any episode has begun."""
    zero = torch.zeros(num_envs, dtype=torch.int64, device=device)
    return Progress(
        stage=zero,
        counting=torch.zeros(num_envs, dtype=torch.bool, device=device),
        counted=zero.clone(),
        succeeded=zero.clone(),
        batch_size=[num_envs],
    )


def difficulty(progress: Progress, config: CurriculumConfig) -> Tensor:
    """Give the difficulty of the scenes to be drawn now: from 0 to exactly 1, float64 without dimensions."""
    return progress.stage[0].to(torch.float64) / config.stages


def scene_difficulty(level: Tensor, config: CurriculumConfig) -> Tensor:
    """Give the difficulty by which scenes are drawn: ``level``, or ahead of it where the last stages change none."""
    if not config.contact_stages:
        return level
    ahead = level * (config.stages / (config.stages - config.contact_stages))
    return ahead.round(decimals=12).clamp(max=1.0)  # exactly 1 where only the limit of contact is left to change


def further_contact(level: Tensor, config: TaskConfig) -> Tensor | None:
    """Give how many more steps in contact than the task episodes of a difficulty allow, int64; None: never any more.

    They fall on a straight line to 0 at the task's own, each rounded to a whole step: over all stages, or over the
    last ``contact_stages``.
    """
    settings, own = config.curriculum, config.max_contact_steps
    easy = settings.easy_contact_steps
    if easy is None or own is None:
        return None
    return ((easy - own) * _leniency(level, settings)).round().to(torch.int64)


def waived_cost(level: Tensor, config: TaskConfig) -> Tensor | None:
    """Give by how much a step in contact costs less than the task's ``lambda_c`` has it; None: never any less.

    It falls to 0 as ``further_contact`` does, in the precision of ``level``.
    """
    own, easy = config.reward.lambda_c, config.curriculum.easy_lambda_c
    return None if easy is None else (easy - own) * _leniency(level, config.curriculum)


def _leniency(level: Tensor, config: CurriculumConfig) -> Tensor:
    """Fall from 1 to 0 with the difficulty: over all stages, or over the last ``contact_stages``."""
    return ((1.0 - level) * (config.stages / (config.contact_stages or config.stages))).clamp(max=1.0)


def leading(num_envs: int, config: CurriculumConfig) -> int:
    """Give the number of environments whose scenes are of the stage and whose episodes count: all but a share."""
    return num_envs - math.floor(config.easier_share * num_envs)


def note_ends(progress: Progress, ended: Tensor, success: Tensor, config: CurriculumConfig) -> Progress:
    """Count the episodes that have just ended and, when that settles the round, decide on the stage.

    A round has at least ``episodes`` episodes, equally many of every leading environment. The stage rises by one if a
    larger share of them than ``promote`` are successes, and falls by one if a smaller share than ``demote`` are. The
    round is over as soon as the episodes under way cannot change that any more: it need not wait for the longest
    failures.

    Args:
        progress: not changed.
        ended: ``(num_envs,)`` bool.
        success: of those that ended, ``(num_envs,)`` bool; anything elsewhere.
        config: thresholds.
    """
    first = leading(len(ended), config)
    quota = -(-config.episodes // first)
    counts = ended & progress.counting & (progress.counted < quota)
    counts[first:].fill_(False)
    counted = progress.counted + counts
    succeeded = progress.succeeded + (counts & success)
    total = quota * first
    won, seen = succeeded.sum(), counted.sum()
    rises = won >= _fewest(total, config.promote, above=True)
    falls = won - seen < _fewest(total, config.demote, above=False) - total  # were all that is open won
    over = rises | falls | (seen == total)
    return Progress(
        stage=(progress.stage + rises - falls.long()).clamp(0, config.stages),
        # what is under way when a round begins has lasted long already: more often a failure than not
        counting=progress.counting > over,
        counted=counted.masked_fill(over, 0),
        succeeded=succeeded.masked_fill(over, 0),
        batch_size=progress.batch_size,
    )


@lru_cache
def _fewest(total: int, share: float, *, above: bool) -> int:
    """Give the smallest number whose share of ``total`` is above ``share``, or at least ``share``."""
    return next((n for n in range(total + 1) if n / total > share or (n / total == share and not above)), total + 1)
