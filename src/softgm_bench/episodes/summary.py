"""What an evaluation says in numbers, ``summary.json`` and the table at a run's end."""

import math
import platform
from collections.abc import Mapping
from importlib.metadata import version
from typing import Any

import numpy as np

from softgm_bench.envs import keys
from softgm_bench.episodes.evaluation import EpisodeRecords

# Name in the summary, field of the records; a reader's table leaves out what the reward is made of.
AVERAGED = {
    "discounted_return": "discounted_return",
    "undiscounted_return": "undiscounted_return",
    "episode_length": "length",
    "tip_travel_distance": "tip_travel_distance",
    "final_distance": "final_distance",
    "torque_per_agent": "torque_per_agent",
    "torque_joint": "torque_joint",
    "contact_steps": "contact_steps",
    "discovered_bins": "discovered_bins",
    "dropped_bins": "dropped_bins",
    **{f"reward_{name}": f"reward_{name}" for name in keys.REWARD_TERM_NAMES},
}


def summarise(records: EpisodeRecords) -> dict[str, Any]:
    """Mean and standard deviation (over the episodes, population) of every metric; success rate with 95 % interval.

    What the records do not tell is absent.
    """
    episodes = len(records.length)
    metrics: dict[str, Any] = {"episodes": episodes}
    if records.success is not None:
        successes = int(records.success.sum())
        low, high = wilson_interval(successes, episodes)
        metrics["success_rate"] = {"mean": successes / episodes, "low": low, "high": high}
    if records.diverged is not None:
        metrics["diverged"] = int(records.diverged.sum())
    for name, field in AVERAGED.items():
        values = getattr(records, field)
        if values is not None:
            metrics[name] = {"mean": float(np.mean(values)), "std": float(np.std(values))}
    return metrics


def wilson_interval(successes: int, trials: int, z: float = 1.959963984540054) -> tuple[float, float]:
    """Wilson's score interval of a proportion; the default z covers 95 %."""
    share = successes / trials
    centre = share + z * z / (2 * trials)
    margin = z * math.sqrt(share * (1 - share) / trials + z * z / (4 * trials * trials))
    scale = 1 + z * z / trials
    return max(0.0, (centre - margin) / scale), min(1.0, (centre + margin) / scale)


def versions() -> dict[str, str]:
    """Versions of everything that a number may depend on."""
    packages = ("softgm_bench", "torch", "torchrl", "tensordict", "numba", "numpy")
    return {"python": platform.python_version()} | {package: version(package) for package in packages}


def table(metrics: Mapping[str, Any], title: str) -> str:
    """The metrics of ``summarise`` for a reader."""
    rows = []
    if (success := metrics.get("success_rate")) is not None:
        rows.append(("success rate", f"{success['mean']:.3f}  [{success['low']:.3f}, {success['high']:.3f}]"))
    rows += [
        (name.replace("_", " "), f"{metrics[name]['mean']:.3f} +- {metrics[name]['std']:.3f}")
        for name in AVERAGED
        if name in metrics and not name.startswith("reward_")
    ]
    rows += [(name, str(metrics[name])) for name in ("diverged", "episodes") if name in metrics]
    width = max(len(name) for name, _ in rows)
    lines = [f"  {name:<{width}}  {value}" for name, value in rows]
    return "\n".join([title, *lines])
