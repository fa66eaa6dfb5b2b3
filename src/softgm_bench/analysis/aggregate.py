"""Over tasks: which algorithms can be compared, and what comparing them gives."""

from itertools import permutations
from typing import Any, NamedTuple

import numpy as np

from softgm_bench.analysis import statistics
from softgm_bench.analysis.paper import ABLATIONS, ALGORITHMS, TASKS
from softgm_bench.analysis.pools import Pools, comparable
from softgm_bench.analysis.statistics import Array, Bootstrap

THRESHOLDS = np.linspace(0.0, 1.0, 101)


class Estimate(NamedTuple):
    """A statistic, and its interval over seeds, ``(2, ...)``; None with a single seed, which cannot give one."""

    value: Any
    interval: Any


class Aggregate(NamedTuple):
    """An algorithm over all of the paper's tasks; estimates are None where ``missing`` names tasks.

    Attributes:
        label: the algorithm.
        seeds: their number on each task that it has.
        missing: tasks on which it was not run or is not ranked.
        iqm: interquartile mean of the success rates.
        mean: over tasks of the mean over seeds.
        profile: share of runs whose success rate is above each of ``THRESHOLDS``, ``(thresholds,)``.
    """

    label: str
    seeds: tuple[int, ...]
    missing: tuple[str, ...]
    iqm: Estimate | None = None
    mean: Estimate | None = None
    profile: Estimate | None = None


class Comparison(NamedTuple):
    """Probability that the first algorithm's success rate is higher than the second's, over the tasks both have."""

    first: str
    second: str
    tasks: tuple[str, ...]
    seeds: tuple[int, int]
    estimate: Estimate


def success_rates(pools: Pools) -> dict[str, dict[str, Array]]:
    """Success rates of every competitor's seeds by algorithm and task, of the paper's tasks on which it is ranked.

    The paper's algorithms come first, in its order, then others; ablations do not compete.
    """
    labels = {label for (task, label), pool in pools.items() if task in TASKS and pool.ranked}
    labels -= set(ABLATIONS) - set(ALGORITHMS)
    rates: dict[str, dict[str, Array]] = {}
    for label in [label for label in ALGORITHMS if label in labels] + sorted(labels - set(ALGORITHMS)):
        ranked = {task: pools[task, label] for task in TASKS if (task, label) in pools and pools[task, label].ranked}
        found = {task: pool.success_rates for task, pool in ranked.items()}
        rates[label] = {task: of_seeds for task, of_seeds in found.items() if of_seeds is not None}
    return rates


def aggregates(pools: Pools, bootstrap: Bootstrap) -> list[Aggregate]:
    """Estimate interquartile mean, mean and performance profile of every competitor over the tasks."""
    found = []
    for label, by_task in success_rates(pools).items():
        seeds, missing = tuple(map(len, by_task.values())), tuple(task for task in TASKS if task not in by_task)
        runs = list(by_task.values())
        estimates = {
            name: Estimate(statistic(runs), bootstrap.interval(f"{name}/{label}", statistic, runs))
            for name, statistic in (("iqm", statistics.iqm), ("mean", statistics.mean), ("profile", _profile))
            if not missing
        }
        found.append(Aggregate(label, seeds, missing, **estimates))
    return found


def _profile(scores: statistics.Scores) -> Array:
    return statistics.performance_profile(scores, THRESHOLDS)


def comparisons(pools: Pools, bootstrap: Bootstrap) -> list[Comparison]:
    """Compare every two competitors on the tasks on which they are ``comparable``.

    Each pair stands once, in the order in which the first is not less probable.
    """
    found = []
    rates, statistic = success_rates(pools), statistics.probability_of_improvement
    for first, second in permutations(rates, 2):
        shared = [task for task in TASKS if task in rates[first] and task in rates[second]]
        tasks = tuple(task for task in shared if comparable(pools[task, first], pools[task, second]))
        ours, theirs = ([rates[label][task] for task in tasks] for label in (first, second))
        value = float(statistic(ours, theirs)) if tasks else 0.0
        if value > 0.5 or (value == 0.5 and first < second):
            interval = bootstrap.interval(f"improvement/{first}/{second}", statistic, ours, theirs)
            seeds = (min(map(len, ours)), min(map(len, theirs)))
            found.append(Comparison(first, second, tasks, seeds, Estimate(value, interval)))
    return found
