"""Evaluations in the JSON layout that the package marl-eval (Gorsane et al. 2022) reads.

``environment -> task -> ALGORITHM -> seed_<k> -> step_<i> {step_count, metric: [value]}``, and last of a run
``absolute_metrics`` with its final evaluation, one value an episode. The package wants the same algorithms, runs and
number of steps everywhere and says what is missing; the export holds what there is.
"""

from collections.abc import Sequence
from typing import Any

from softgm_bench.analysis.runs import Run

ENVIRONMENT = "softgm_bench"
# Metric, without "_" where the package normalises it; entry of the evaluations during training; column of the episodes.
METRICS = {
    "return": ("discounted_return", "discounted_return"),
    "success_rate": ("success_rate", "success"),
    "episode_length": ("episode_length", "length"),
}


def export(runs: Sequence[Run]) -> dict[str, Any]:
    """The nested mapping; order matters to its reader."""
    tasks: dict[str, Any] = {}
    for run in sorted(runs, key=lambda run: (run.final.task, run.final.label, run.final.seed)):
        algorithms = tasks.setdefault(run.final.task, {})
        algorithms.setdefault(run.final.label.upper(), {})[f"seed_{run.final.seed}"] = _entries(run)
    return {ENVIRONMENT: tasks}


def _entries(run: Run) -> dict[str, Any]:
    entries: dict[str, Any] = {}
    for index, evaluation in enumerate(run.progress):
        values = {metric: [evaluation[entry]["mean"]] for metric, (entry, _) in METRICS.items() if entry in evaluation}
        entries[f"step_{index}"] = {"step_count": evaluation["frames"], **values}
    entries["absolute_metrics"] = {
        metric: run.final.episodes[column].tolist()
        for metric, (_, column) in METRICS.items()
        if column in run.final.episodes
    }
    return entries
