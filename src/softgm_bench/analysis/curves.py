"""Learning curves: what the evaluations during training say, against frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from softgm_bench.analysis.runs import Run
from softgm_bench.analysis.statistics import Array, standard_error

MEASURES = ("success_rate", "episode_length", "discounted_return")


@dataclass(frozen=True, eq=False)
class Curve:
    """A learning curve of one algorithm on one task.

    Attributes:
        frames: common to all seeds, ``(points,)``.
        seeds: a value at each of them, ``(seeds, points)``.
    """

    frames: Array
    seeds: Array

    @property
    def mean(self) -> Array:
        """Over the seeds."""
        return self.seeds.mean(axis=0)

    @property
    def error(self) -> Array:
        """Standard error of the mean; NaN for one seed."""
        return standard_error(self.seeds)


def curve(runs: Sequence[Run], measure: str) -> Curve | None:
    """The runs' evaluations put on common frames; None if any did not record the measure, or none is there.

    A run that was never evaluated during training is left out. Runs whose evaluations lie at the same frames keep them.
    Others are interpolated linearly at the union of their frames within the range that all of them have.
    """
    points = [_points(run.progress, measure) for run in runs if run.progress]
    if not points or any(at is None for at in points):
        return None
    known = [at for at in points if at is not None]
    first, last = max(frames[0] for frames, _ in known), min(frames[-1] for frames, _ in known)
    grid = np.unique(np.concatenate([frames for frames, _ in known]))
    grid = grid[(grid >= first) & (grid <= last)]
    if len(grid) == 0:
        return None
    return Curve(grid, np.stack([np.interp(grid, frames, values) for frames, values in known]))


def _points(progress: Sequence[Mapping], measure: str) -> tuple[Array, Array] | None:
    if any(entry.get(measure) is None or entry[measure]["mean"] is None for entry in progress):
        return None
    entries = sorted(progress, key=lambda entry: entry["frames"])
    frames = np.array([entry["frames"] for entry in entries], dtype=np.float64)
    return frames, np.array([entry[measure]["mean"] for entry in entries], dtype=np.float64)
