"""Statistics over seeds, after Agarwal et al., "Deep RL at the Edge of the Statistical Precipice" (2021).

``Scores`` of an algorithm: one array for each task, one score for each run (seed) on its last axis. Tasks may have
different numbers of runs. A statistic of scores ``(runs,)`` is a number; of ``(resamples, runs)`` it is
``(resamples,)``, so that an interval needs no loop.
"""

import zlib
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

Array = NDArray[np.float64]
Scores = Sequence[Array]

CONFIDENCE = 0.95


def mean(scores: Scores) -> Array:
    """Average over the tasks of the mean over runs."""
    return np.mean([of_task.mean(axis=-1) for of_task in scores], axis=0)


def iqm(scores: Scores) -> Array:
    """Interquartile mean over all runs of all tasks: a quarter of them, rounded down, is cut off at either end."""
    runs = np.sort(np.concatenate(scores, axis=-1), axis=-1)
    cut = runs.shape[-1] // 4
    return runs[..., cut : runs.shape[-1] - cut].mean(axis=-1)


def performance_profile(scores: Scores, thresholds: Array) -> Array:
    """Share of all runs of all tasks that lie above each threshold, ``(..., thresholds)``."""
    runs = np.concatenate(scores, axis=-1)
    return np.stack([1.0 - (runs <= threshold).sum(axis=-1) / runs.shape[-1] for threshold in thresholds], axis=-1)


def probability_of_improvement(ours: Scores, theirs: Scores) -> Array:
    """Probability that a run of ours has a higher score than one of theirs, averaged over the tasks both have in order.

    On a task it is the Mann-Whitney statistic divided by its largest value: a tie counts one half.
    """
    differences = [x[..., :, None] - y[..., None, :] for x, y in zip(ours, theirs, strict=True)]
    return np.mean([((of_task > 0) + 0.5 * (of_task == 0)).mean(axis=(-2, -1)) for of_task in differences], axis=0)


class Discordance(NamedTuple):
    """Episodes in which one of two conditions succeeds and the other does not.

    Attributes:
        lost: the first succeeds, the second fails.
        won: the first fails, the second succeeds.
        p: McNemar's exact two-sided p-value: how likely a split at least as uneven is if either is as likely.
    """

    lost: int
    won: int
    p: float


def mcnemar(first: Array, second: Array) -> Discordance:
    """Compare success (0 or 1) of the same episodes under two conditions, ``(episodes,)`` each (McNemar 1947)."""
    lost, won = int(((first == 1) & (second == 0)).sum()), int(((first == 0) & (second == 1)).sum())
    return Discordance(lost, won, float(binomtest(lost, lost + won).pvalue) if lost + won else 1.0)


class Bootstrap(NamedTuple):
    """Draws intervals over seeds: percentiles of a bootstrap that draws runs with replacement within each task."""

    resamples: int
    seed: int

    def interval(self, key: str, statistic: Callable[..., Any], *scores: Scores) -> Any:
        """Bounds of a statistic's central 95 %, ``(2, ...)``; None where a task has a single run.

        Args:
            key: names the random numbers, so that they are the same whatever else is in the report.
            statistic: takes as many scores as are given; all algorithms' runs are drawn independently.
            scores: one for each algorithm.
        """
        if min(len(of_task) for of_algorithm in scores for of_task in of_algorithm) < 2:
            return None
        generator = np.random.default_rng([self.seed, zlib.crc32(key.encode())])
        drawn = [[self._resample(of_task, generator) for of_task in of_algorithm] for of_algorithm in scores]
        tail = 100 * (1 - CONFIDENCE) / 2
        return np.percentile(statistic(*drawn), [tail, 100 - tail], axis=0)

    def _resample(self, runs: Array, generator: np.random.Generator) -> Array:
        return runs[generator.integers(len(runs), size=(self.resamples, len(runs)))]
