"""Statistics over seeds, after Agarwal et al., "Deep RL at the Edge of the Statistical Precipice" (2021).

``Scores`` of an algorithm: one array for each task, one score for each run (seed) in it. Tasks may have different
numbers of runs. The bootstrap is stratified: runs are drawn with replacement within each task, tasks stay. Intervals
are percentiles. Everything is drawn in one array, ``(resamples, runs)``.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Scores = Sequence[Array]

CONFIDENCE = 0.95


def pooled(episodes: Sequence[Array]) -> tuple[float, float]:
    """Mean and population standard deviation over all episodes of all seeds, one array a seed."""
    values = np.concatenate([np.asarray(of_seed, dtype=np.float64) for of_seed in episodes])
    return float(values.mean()), float(values.std())


def standard_error(values: Array) -> Array:
    """Estimate the standard error of the mean over the first axis; NaN for a single value."""
    if len(values) < 2:
        return np.full(values.shape[1:], np.nan)
    return values.std(axis=0, ddof=1) / np.sqrt(len(values))


def iqm(scores: Array) -> Array:
    """Interquartile mean over the last axis: a quarter of the scores, rounded down, is cut off at either end."""
    count = scores.shape[-1]
    cut = count // 4
    return np.sort(scores, axis=-1)[..., cut : count - cut].mean(axis=-1)


def performance_profile(scores: Array, thresholds: Array) -> Array:
    """Share of the last axis that lies above each threshold, ``(..., thresholds)``."""
    ordered = np.sort(scores.reshape(-1, scores.shape[-1]), axis=-1)
    above = np.stack([1.0 - np.searchsorted(row, thresholds, side="right") / len(row) for row in ordered])
    return above.reshape(*scores.shape[:-1], len(thresholds))


def improvement(ours: Array, theirs: Array) -> Array:
    """Probability that a score of one task is higher than another's, over the last axes; a tie counts one half.

    The Mann-Whitney statistic divided by its largest value.
    """
    difference = ours[..., :, None] - theirs[..., None, :]
    return ((difference > 0) + 0.5 * (difference == 0)).mean(axis=(-2, -1))


def probability_of_improvement(ours: Scores, theirs: Scores) -> float:
    """Mean over the tasks, which both have in the same order, of ``improvement``."""
    return float(np.mean([improvement(x, y) for x, y in zip(ours, theirs, strict=True)]))


def resample(scores: Scores, resamples: int, generator: np.random.Generator) -> list[Array]:
    """For each task ``(resamples, runs)``: its runs drawn with replacement."""
    return [of_task[generator.integers(len(of_task), size=(resamples, len(of_task)))] for of_task in scores]


def flatten(scores: Sequence[Array]) -> Array:
    """All tasks' runs side by side on the last axis."""
    return np.concatenate(list(scores), axis=-1)


def percentile_interval(draws: Array) -> Array:
    """Bounds of the central 95 % over the first axis, ``(2, ...)``."""
    tail = 100 * (1 - CONFIDENCE) / 2
    return np.percentile(draws, [tail, 100 - tail], axis=0)


def mean_interval(scores: Scores, resamples: int, generator: np.random.Generator) -> Array:
    """Interval of the mean over tasks of the mean over runs, ``(2,)``."""
    means = [of_task.mean(axis=-1) for of_task in resample(scores, resamples, generator)]
    return percentile_interval(np.mean(means, axis=0))


def iqm_interval(scores: Scores, resamples: int, generator: np.random.Generator) -> Array:
    """Interval of the interquartile mean over all runs of all tasks, ``(2,)``."""
    return percentile_interval(iqm(flatten(resample(scores, resamples, generator))))


def profile_interval(scores: Scores, thresholds: Array, resamples: int, generator: np.random.Generator) -> Array:
    """Interval, at each threshold, of the performance profile over all runs of all tasks, ``(2, thresholds)``."""
    return percentile_interval(performance_profile(flatten(resample(scores, resamples, generator)), thresholds))


def improvement_interval(ours: Scores, theirs: Scores, resamples: int, generator: np.random.Generator) -> Array:
    """Interval of the probability of improvement, ``(2,)``; both algorithms' runs are drawn independently."""
    pairs = zip(resample(ours, resamples, generator), resample(theirs, resamples, generator), strict=True)
    return percentile_interval(np.mean([improvement(x, y) for x, y in pairs], axis=0))
