"""An evaluation in numbers: the metrics of ``summary.json`` and the table at a run's end."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgm_bench.episodes.evaluation import CERTIFIED, N_AGENTS, EpisodeRecords

STEPS = (50, 100, 200, 400, 2000)  # control steps by which successes are counted, where episodes are as long
MOTIONLESS = 1e-4  # m a control step; a tip that moves less at the end of a failed episode stands still
BY_NUMBER = "success_rate_n"  # what begins so is the success rate of arms with the number of sections that follows
RENAMED = {"length": "episode_length"}  # columns that summaries know by another name


def summarise(records: EpisodeRecords) -> dict[str, Any]:
    """Compute mean and standard deviation (over the episodes, population) of every column.

    Of what happened or did not there is the success rate with its 95 % interval, and otherwise the number of episodes.
    Of a mixture of numbers of sections there is the same of each, as ``success_rate_n4`` with its number of episodes.
    ``success_certified`` is the rate on the scenes that are known to be solvable, with their number of episodes.
    ``success_by_step`` is the share of episodes that have succeeded by each of ``STEPS``, as far as the horizon goes.
    ``motionless_failures`` are the episodes that did not succeed and at whose end the tip moved by less than
    ``MOTIONLESS`` a step.
    """
    metrics: dict[str, Any] = {"episodes": records.episodes}
    numbers: dict[str, Any] = {}
    for name, values in records.items():
        if name == "success":
            metrics["success_rate"] = _rate(values)
        elif name == CERTIFIED:
            metrics["success_certified"] = _rate_among(records, values)
        elif name == N_AGENTS:
            of_each = {f"{BY_NUMBER}{number}": _rate_among(records, values == number) for number in np.unique(values)}
            metrics |= of_each if "success" in records else {}
        elif values.dtype == np.bool_:
            metrics[name] = int(values.sum())
        else:
            numbers[RENAMED.get(name, name)] = {"mean": float(np.mean(values)), "std": float(np.std(values))}
    if "success" in records and "final_tip_step" in records:
        failed = np.logical_not(records["success"])
        metrics["motionless_failures"] = int((failed & (records["final_tip_step"] < MOTIONLESS)).sum())
    if "success" in records and (by_step := success_by_step(records, records.horizon)):
        metrics["success_by_step"] = by_step
    return metrics | numbers


def _rate_among(records: EpisodeRecords, chosen: NDArray[Any]) -> dict[str, Any]:
    return _rate(records["success"][chosen]) | {"episodes": int(chosen.sum())}


def _rate(success: NDArray[Any]) -> dict[str, float]:
    successes, episodes = int(success.sum()), len(success)
    if not episodes:
        return {"mean": math.nan, "low": 0.0, "high": 1.0}
    low, high = wilson_interval(successes, episodes)
    return {"mean": successes / episodes, "low": low, "high": high}


def success_by_step(episodes: Mapping[str, Any], horizon: int | None) -> dict[str, float]:
    """Share of episodes that have succeeded by each of ``STEPS`` up to ``horizon``, by the step's number.

    Args:
        episodes: columns ``length`` and ``success``, ``(episodes,)`` each; a success is an episode's last step.
        horizon: most control steps of an episode; None: unknown, which gives nothing.
    """
    reached = np.where(np.asarray(episodes["success"]) == 1, episodes["length"], np.inf)
    return {str(step): float((reached <= step).mean()) for step in STEPS if horizon is not None and step <= horizon}


def wilson_interval(successes: int, trials: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Wilson's score interval of a proportion; the default z covers 95 %."""
    share = successes / trials
    centre = share + z * z / (2 * trials)
    margin = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max(0.0, (centre - margin) / scale), min(1.0, (centre + margin) / scale)


def table(metrics: Mapping[str, Any], title: str) -> str:
    """The metrics of ``summarise`` for a reader."""
    rows = []
    if (success := metrics.get("success_rate")) is not None:
        rows.append(("success rate", _rate_in_words(success)))
    if (known := metrics.get("success_certified")) is not None:
        rows.append(("success, certified", f"{_rate_in_words(known)}  of {known['episodes']} certified scenes"))
    rows += [
        (f"success, {name.removeprefix(BY_NUMBER)} sections", _rate_in_words(value) + f"  of {value['episodes']}")
        for name, value in metrics.items()
        if name.startswith(BY_NUMBER)
    ]
    rows += [(f"success by step {step}", f"{share:.3f}") for step, share in metrics.get("success_by_step", {}).items()]
    rows += [
        (name.replace("_", " "), f"{value['mean']:.3f} +- {value['std']:.3f}")
        for name, value in metrics.items()
        if isinstance(value, Mapping) and "std" in value and not name.startswith("reward_")
    ]
    counts = {name: value for name, value in metrics.items() if isinstance(value, int) and name != "episodes"}
    rows += [(name, str(value)) for name, value in (counts | {"episodes": metrics["episodes"]}).items()]
    width = max(len(name) for name, _ in rows)
    lines = [f"  {name:<{width}}  {value}" for name, value in rows]
    return "\n".join([title, *lines])


def _rate_in_words(rate: Mapping[str, float]) -> str:
    return f"{rate['mean']:.3f}  [{rate['low']:.3f}, {rate['high']:.3f}]"
