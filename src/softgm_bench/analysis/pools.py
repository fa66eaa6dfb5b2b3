"""Puts seeds together: all evaluations of one algorithm on one task, and which of them may be ranked."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from softgm_bench.analysis.runs import Evaluation, Run
from softgm_bench.analysis.statistics import Array, mean_interval, pooled

ORACLE, CURRICULUM, PERTURBED = "†", "‡", "§"
MARKS = {
    ORACLE: "actors were told what they would have to discover: an upper bound",
    CURRICULUM: "trained with easier scenes first; evaluated, as all are, on the task itself",
    PERTURBED: "trained and evaluated under a perturbation",
}


@dataclass(frozen=True, eq=False)
class Pool:
    """One evaluation for each seed, of the same algorithm, task and condition.

    Attributes:
        evaluations: by seed.
        marks: how the training was another kind's.
        ranked: whether it competes with the others on its task.
    """

    evaluations: tuple[Evaluation, ...]
    marks: str = ""
    ranked: bool = True

    @property
    def task(self) -> str:
        """Shared by all evaluations."""
        return self.evaluations[0].task

    @property
    def label(self) -> str:
        """Shared by all evaluations."""
        return self.evaluations[0].label

    @property
    def seeds(self) -> int:
        """Number of trained policies."""
        return len(self.evaluations)

    @property
    def success_rates(self) -> Array | None:
        """A seed's share of successful episodes, ``(seeds,)``; None for a task without a notion of success."""
        if any("success" not in evaluation.episodes for evaluation in self.evaluations):
            return None
        return np.array([evaluation.episodes["success"].mean() for evaluation in self.evaluations])

    @property
    def diverged(self) -> int | None:
        """Number of episodes in which the simulation broke."""
        if any("diverged" not in evaluation.episodes for evaluation in self.evaluations):
            return None
        return int(sum(evaluation.episodes["diverged"].sum() for evaluation in self.evaluations))

    def statistic(self, column: str) -> tuple[float, float] | None:
        """Mean and standard deviation over seeds x episodes; None if it was not recorded."""
        if any(column not in evaluation.episodes for evaluation in self.evaluations):
            return None
        return pooled([evaluation.episodes[column] for evaluation in self.evaluations])

    def success_interval(self, resamples: int, seed: int) -> tuple[float, float] | None:
        """95 % interval of the mean success rate.

        Of several seeds, the bootstrap's over them; of one, Wilson's over its episodes, which says nothing about seeds.
        """
        rates = self.success_rates
        if rates is None:
            return None
        if self.seeds == 1:
            return wilson(self.evaluations[0])
        low, high = mean_interval([rates], resamples, generator(seed, "success", self.task, self.label))
        return float(low), float(high)


def wilson(evaluation: Evaluation) -> tuple[float, float]:
    """95 % interval of one policy's success rate over its episodes."""
    from softgm_bench.episodes.summary import wilson_interval  # brings torch along

    success = evaluation.episodes["success"]
    return wilson_interval(int(success.sum()), len(success))


def generator(seed: int, *names: str) -> np.random.Generator:
    """Random numbers of one statistic: the same whatever else is in the report."""
    return np.random.default_rng([seed, zlib.crc32("/".join(names).encode())])


def newest(runs: Sequence[Run]) -> tuple[list[Run], list[tuple[Run, Run]]]:
    """One run for each task, algorithm and seed: the one with the most frames.

    Returns:
        Those runs, and pairs of a run that is left out for it and the run that takes its place.
    """
    best: dict[tuple, Run] = {}
    replaced: list[tuple[Run, Run]] = []
    for run in sorted(runs, key=lambda run: (-run.final.frames, run.final.folder)):
        key = (run.final.task, run.final.label, run.final.seed)
        if key in best:
            replaced.append((run, best[key]))
        best.setdefault(key, run)
    return sorted(best.values(), key=lambda run: run.final.folder), replaced


def pool_runs(runs: Sequence[Run]) -> dict[tuple[str, str], Pool]:
    """Final evaluations by task and algorithm; algorithms that differ in kind have different names.

    Ranked are runs without the oracle and trained without perturbation. Where some were trained with a curriculum and
    others were not, those with it are not ranked.
    """
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in sorted(runs, key=lambda run: (run.final.seed, run.final.folder)):
        groups.setdefault((run.final.task, run.final.label), []).append(run)
    competing: dict[str, list[bool]] = {}
    for (task, _), members in groups.items():
        competing.setdefault(task, []).extend(run.curriculum for run in members if not _apart(run))
    return {
        key: Pool(
            tuple(run.final for run in members),
            _marks(members),
            not any(_apart(run) or (run.curriculum and not all(competing[key[0]])) for run in members),
        )
        for key, members in groups.items()
    }


def _apart(run: Run) -> bool:
    return run.oracle or run.trained_with != "none"


def _marks(runs: Sequence[Run]) -> str:
    kinds = {
        ORACLE: any(run.oracle for run in runs),
        CURRICULUM: any(run.curriculum for run in runs),
        PERTURBED: any(run.trained_with != "none" for run in runs),
    }
    return "".join(mark for mark, there in kinds.items() if there)


def pool_evaluations(evaluations: Sequence[Evaluation]) -> dict[tuple[str, str, str], Pool]:
    """Evaluations of the trained setting by task, algorithm and ``condition``.

    Those with other settings than were trained with are left out. Of several with the same seed the one counts that is
    deterministic, has the longest time limit, the most frames, the most episodes, in this order; all seeds of a pool
    have the same time limit and kind of actions.
    """
    groups: dict[tuple[str, str, str], dict[int, Evaluation]] = {}
    protocols: dict[tuple[str, str, str], tuple] = {}
    for evaluation in sorted(evaluations, key=_preference):
        key = (evaluation.task, evaluation.label, condition(evaluation))
        protocol = (evaluation.deterministic, evaluation.horizon)
        if not evaluation.overrides and protocols.setdefault(key, protocol) == protocol:
            groups.setdefault(key, {}).setdefault(evaluation.seed, evaluation)
    return {key: Pool(tuple(by_seed[seed] for seed in sorted(by_seed))) for key, by_seed in sorted(groups.items())}


def _preference(evaluation: Evaluation) -> tuple:
    count = len(evaluation.episodes["length"])
    return not evaluation.deterministic, -(evaluation.horizon or 0), -evaluation.frames, -count, evaluation.folder


def condition(evaluation: Evaluation) -> str:
    """Perturbation and its parameters, e.g. ``noise (position 0.1)``."""
    parameters = [
        f"{name.replace('_', ' ')} {value}"
        for name, value in evaluation.perturbation.items()
        if name != "name" and value
    ]
    name = evaluation.perturbation["name"]
    return f"{name} ({', '.join(parameters)})" if parameters else name
