"""Over tasks: which algorithms can be compared, and what comparing them gives."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import permutations

import numpy as np

from softgm_bench.analysis.paper import ABLATIONS, ALGORITHMS, TASKS
from softgm_bench.analysis.pools import Pool, generator
from softgm_bench.analysis.statistics import (
    Array,
    flatten,
    improvement_interval,
    iqm,
    iqm_interval,
    mean_interval,
    performance_profile,
    probability_of_improvement,
    profile_interval,
)

Pools = Mapping[tuple[str, str], Pool]
Interval = tuple[float, float]
THRESHOLDS = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True)
class Estimate:
    """A number, and its interval over seeds; None with a single seed, which cannot give one."""

    value: float
    interval: Interval | None


@dataclass(frozen=True)
class Aggregate:
    """An algorithm's aggregates over all of the paper's tasks; estimates are None where ``missing`` names tasks."""

    label: str
    seeds: tuple[int, ...]
    missing: tuple[str, ...]
    iqm: Estimate | None = None
    mean: Estimate | None = None


@dataclass(frozen=True)
class Comparison:
    """Probability that the first algorithm's success rate is higher than the second's, over the tasks both have."""

    first: str
    second: str
    tasks: tuple[str, ...]
    seeds: tuple[int, int]
    estimate: Estimate


@dataclass(frozen=True, eq=False)
class Profile:
    """Share of runs whose success rate is above each of ``THRESHOLDS``, and its interval, ``(2, thresholds)``."""

    label: str
    share: Array
    interval: Array | None


def competitors(pools: Pools) -> list[str]:
    """Algorithms that are ranked on a task of the paper: its seven in their order, then others; no ablations."""
    there = {label for (task, label), pool in pools.items() if task in TASKS and pool.ranked}
    there -= set(ABLATIONS) - set(ALGORITHMS)
    return [label for label in ALGORITHMS if label in there] + sorted(there - set(ALGORITHMS))


def scores(pools: Pools, label: str, tasks: Sequence[str] = TASKS) -> dict[str, Array]:
    """Success rates of an algorithm's seeds by task, of those on which it is ranked."""
    found = {}
    for task in tasks:
        pool = pools.get((task, label))
        if pool is not None and pool.ranked and pool.success_rates is not None:
            found[task] = pool.success_rates
    return found


def aggregates(pools: Pools, resamples: int, seed: int) -> list[Aggregate]:
    """Interquartile mean and mean over the tasks of every competitor's success rates."""
    found = []
    for label in competitors(pools):
        by_task = scores(pools, label)
        seeds, missing = _seeds(by_task), tuple(task for task in TASKS if task not in by_task)
        if missing:
            found.append(Aggregate(label, seeds, missing))
            continue
        runs = list(by_task.values())
        several = min(seeds) > 1
        middle = tuple(map(float, iqm_interval(runs, resamples, generator(seed, "iqm", label)))) if several else None
        average = tuple(map(float, mean_interval(runs, resamples, generator(seed, "mean", label)))) if several else None
        mean = float(np.mean([rates.mean() for rates in runs]))
        found.append(
            Aggregate(label, seeds, (), Estimate(float(iqm(flatten(runs))), middle), Estimate(mean, average))  # type: ignore[arg-type]
        )
    return found


def comparisons(pools: Pools, resamples: int, seed: int) -> list[Comparison]:
    """Every pair of competitors with a task in common, in the order in which the first is not the less probable."""
    found = []
    for first, second in permutations(competitors(pools), 2):
        ours, theirs = scores(pools, first), scores(pools, second)
        tasks = tuple(task for task in TASKS if task in ours and task in theirs)
        if not tasks:
            continue
        x, y = [ours[task] for task in tasks], [theirs[task] for task in tasks]
        value = probability_of_improvement(x, y)
        if value < 0.5 or (value == 0.5 and first > second):
            continue
        seeds = (min(map(len, x)), min(map(len, y)))
        interval = None
        if min(seeds) > 1:
            draws = generator(seed, "improvement", first, second)
            low, high = improvement_interval(x, y, resamples, draws)
            interval = (float(low), float(high))
        found.append(Comparison(first, second, tasks, seeds, Estimate(value, interval)))
    return found


def profiles(pools: Pools, resamples: int, seed: int) -> list[Profile]:
    """Give the performance profile of every competitor that has all tasks."""
    found = []
    for label in competitors(pools):
        runs = list(scores(pools, label).values())
        if len(runs) < len(TASKS):
            continue
        several = min(map(len, runs)) > 1
        draws = generator(seed, "profile", label)
        interval = profile_interval(runs, THRESHOLDS, resamples, draws) if several else None
        found.append(Profile(label, performance_profile(flatten(runs), THRESHOLDS), interval))
    return found


def _seeds(by_task: Mapping[str, Array]) -> tuple[int, ...]:
    return tuple(len(rates) for rates in by_task.values())
