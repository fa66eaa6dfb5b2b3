"""Puts seeds together: all evaluations of one algorithm on one task, and which of them may be ranked."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from softgm_bench.analysis import paper
from softgm_bench.analysis.runs import TUNED, Evaluation, Run
from softgm_bench.analysis.statistics import Array, Bootstrap, Scores, mean

ORACLE, CURRICULUM, PERTURBED, SMOKE, STARTED = "†", "‡", "§", "¶", "‖"
MARKS = {
    ORACLE: "actors were told what they would have to discover; whether they use it, interventions tell",
    CURRICULUM: "trained with easier scenes first; evaluated, as all are, on the task itself",
    PERTURBED: "trained and evaluated under a perturbation, or with a body drawn for every episode",
    SMOKE: "of smoke size: every part of a training once, which teaches nothing",
    STARTED: "begun with a trained policy, whose frames are not counted",
}
UNRANKED = {ORACLE, PERTURBED, SMOKE, STARTED}
SEEDS = 3  # that an algorithm needs to be compared with another
ROUNDING = 1.02  # of the most frames to the fewest that count as equal: trainings end with a whole iteration


@dataclass(frozen=True, eq=False)
class Pool:
    """One evaluation for each seed, of the same algorithm, task and condition.

    Attributes:
        evaluations: by seed.
        marks: how the training was another kind's.
        ranked: whether it competes with the others on its task.
        recipe: the trainings' hyperparameters; empty if that is not known.
        minutes: of each training; empty if they are not known.
    """

    evaluations: tuple[Evaluation, ...]
    marks: str = ""
    ranked: bool = True
    recipe: str = ""
    minutes: tuple[float, ...] = ()

    @property
    def label(self) -> str:
        """The algorithm."""
        return self.evaluations[0].label

    @property
    def seeds(self) -> int:
        """Number of trained policies."""
        return len(self.evaluations)

    @property
    def frames(self) -> list[int]:
        """That each policy was trained with."""
        return [evaluation.frames for evaluation in self.evaluations]

    @property
    def success_rates(self) -> Array | None:
        """A seed's share of successful episodes, ``(seeds,)``; None for a task without a notion of success."""
        success = self.column("success")
        return None if success is None else np.array([of_seed.mean() for of_seed in success])

    def column(self, name: str) -> list[Array] | None:
        """A column of the episodes, one array a seed; None if it was not recorded for all."""
        if any(name not in evaluation.episodes for evaluation in self.evaluations):
            return None
        return [evaluation.episodes[name] for evaluation in self.evaluations]

    def statistic(self, name: str) -> tuple[float, float] | None:
        """Mean and population standard deviation over seeds x episodes; None if the column was not recorded."""
        column = self.column(name)
        if column is None:
            return None
        values = np.concatenate(column)
        return float(values.mean()), float(values.std())

    def success_interval(self, bootstrap: Bootstrap) -> tuple[float, float] | None:
        """95 % interval of the mean success rate; None for a task without a notion of success.

        It is the bootstrap's over several seeds; a single one has Wilson's over its episodes, which says nothing about
        seeds.
        """
        rates = self.success_rates
        if rates is None:
            return None
        if self.seeds == 1:
            return wilson(self.evaluations[0])
        low, high = bootstrap.interval(f"success/{self.evaluations[0].task}/{self.label}", mean, [rates])
        return float(low), float(high)


Pools = Mapping[tuple[str, str], Pool]
Conditions = Mapping[tuple[str, str], Sequence[tuple[str, Pool | None]]]


def equal_frames(pools: Sequence[Pool]) -> bool:
    """Tell whether all trainings of several pools had as many frames, but for rounding."""
    frames = [frames for pool in pools for frames in pool.frames]
    return max(frames, default=0) <= ROUNDING * min(frames, default=0)


def comparable(*pools: Pool) -> bool:
    """Tell whether algorithms can be compared: each has ``SEEDS`` seeds or more, and all had equal frames."""
    return all(pool.seeds >= SEEDS for pool in pools) and equal_frames(pools)


def lead(pool: Pool, other: Pool, bootstrap: Bootstrap) -> tuple[float, float, float] | None:
    """Give the difference of an algorithm's success to another's on a task, and its 95 % interval over seeds.

    None where they cannot be compared, or without a notion of success.
    """
    ours, theirs = pool.success_rates, other.success_rates
    if pool is other or not comparable(pool, other) or ours is None or theirs is None:
        return None

    def difference(first: Scores, second: Scores) -> Array:
        return mean(first) - mean(second)

    key = f"difference/{pool.evaluations[0].task}/{pool.label}"
    low, high = bootstrap.interval(key, difference, [ours], [theirs])
    return float(difference([ours], [theirs])), float(low), float(high)


def wilson(evaluation: Evaluation) -> tuple[float, float]:
    """95 % interval of one policy's success rate over its episodes."""
    from softgm_bench.episodes.summary import wilson_interval  # brings torch along

    success = evaluation.episodes["success"]
    return wilson_interval(int(success.sum()), len(success))


def newest(runs: Sequence[Run]) -> tuple[list[Run], list[tuple[Run, Run]]]:
    """Choose one run for each task, algorithm and seed: the one with the most frames.

    Returns:
        Those runs, and pairs of a run that is left out for it and the run that takes its place.
    """
    best: dict[tuple, Run] = {}
    replaced: list[tuple[Run, Run]] = []
    for run in sorted(runs, key=lambda run: (-run.final.frames, run.final.folder)):
        kept = best.setdefault((run.final.task, run.final.label, run.final.seed), run)
        if kept is not run:
            replaced.append((run, kept))
    return sorted(best.values(), key=lambda run: run.final.folder), replaced


def by_algorithm(runs: Sequence[Run]) -> dict[tuple[str, str], list[Run]]:
    """Group runs by task and algorithm; each group keeps their order."""
    groups: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        groups.setdefault((run.final.task, run.final.label), []).append(run)
    return groups


def pool_runs(runs: Sequence[Run]) -> dict[tuple[str, str], Pool]:
    """Pool final evaluations by task and algorithm; algorithms that differ in kind have different names.

    Ranked are runs of more than smoke size, with the tuned recipe, without the oracle, perturbation, drawn bodies and
    a trained policy to begin with. Where some of them were trained with a curriculum and others were not, those with
    it are not ranked.
    """
    pools = {}
    for key, members in by_algorithm(sorted(runs, key=lambda run: (run.final.seed, run.final.folder))).items():
        kinds = set().union(*map(_kinds, members))
        rivals = [_kinds(run) for run in runs if run.final.task == key[0] and run.recipe == TUNED]
        fair = all(CURRICULUM in rival for rival in rivals if not rival & UNRANKED)
        ranked = not kinds & UNRANKED and members[0].recipe == TUNED and (CURRICULUM not in kinds or fair)
        finals, minutes = tuple(run.final for run in members), tuple(run.minutes for run in members)
        marks = "".join(mark for mark in MARKS if mark in kinds)
        pools[key] = Pool(finals, marks, ranked, members[0].recipe, minutes)
    return pools


def _kinds(run: Run) -> set[str]:
    perturbed = run.trained_with != "none" or run.randomised
    there = {
        ORACLE: run.oracle,
        CURRICULUM: run.curriculum,
        PERTURBED: perturbed,
        SMOKE: run.smoke,
        STARTED: run.started,
    }
    return {mark for mark, is_so in there.items() if is_so}


def pool_evaluations(evaluations: Sequence[Evaluation]) -> dict[tuple[str, str, str], Pool]:
    """Pool evaluations of the trained setting by task, algorithm and ``condition``.

    Those with other settings than were trained with, or under an intervention, are left out. Of several with the same
    seed the one counts that is deterministic, has the longest time limit, the most frames, the most episodes, in this
    order; all seeds of a pool have the same time limit and kind of actions.
    """
    groups: dict[tuple[str, str, str], dict[int, Evaluation]] = {}
    protocols: dict[tuple[str, str, str], tuple] = {}
    for evaluation in sorted(evaluations, key=_preference):
        key = (evaluation.task, evaluation.label, condition(evaluation))
        protocol = (evaluation.deterministic, evaluation.horizon)
        usual = not evaluation.overrides and not evaluation.intervened
        if usual and protocols.setdefault(key, protocol) == protocol:
            groups.setdefault(key, {}).setdefault(evaluation.seed, evaluation)
    return {key: Pool(tuple(by_seed[seed] for seed in sorted(by_seed))) for key, by_seed in sorted(groups.items())}


def _preference(evaluation: Evaluation) -> tuple:
    count = len(evaluation.episodes["length"])
    return not evaluation.deterministic, -(evaluation.horizon or 0), -evaluation.frames, -count, evaluation.folder


def condition(evaluation: Evaluation) -> str:
    """Name a perturbation and its parameters, e.g. ``noise (position 0.1)``."""
    settings = dict(evaluation.perturbation)
    name = settings.pop("name")
    parameters = [f"{key.replace('_', ' ')} {value}" for key, value in settings.items() if value]
    return f"{name} ({', '.join(parameters)})" if parameters else name


def by_condition(nominal: Pools, perturbed: Mapping[tuple[str, str, str], Pool]) -> Conditions:
    """Order what was perturbed, and in any case the paper's SoftGM on the wall, by task and algorithm.

    Each has the nominal condition, the paper's three and others, with its pool or None; a name with several parameters
    keeps them.
    """
    subjects = sorted({key[:2] for key in perturbed if key[2] != "none"} | {("wall", "softgm")}, key=_order)
    rows: dict[tuple[str, str], list[tuple[str, Pool | None]]] = {subject: [] for subject in subjects}
    for subject in subjects:
        there = {full: pool for (*key, full), pool in perturbed.items() if tuple(key) == subject}
        others = sorted({full.split(" ")[0] for full in there} - {"none", *paper.PERTURBATIONS})
        for name in ("none", *paper.PERTURBATIONS, *others):
            full_names = [full for full in there if full.split(" ")[0] == name]
            rows[subject] += [(name if len(full_names) == 1 else full, there[full]) for full in full_names]
            if not full_names:
                rows[subject].append((name, nominal.get(subject) if name == "none" else None))
    return rows


def _order(subject: tuple[str, str]) -> tuple:
    task, label = subject
    position = paper.TASKS.index(task) if task in paper.TASKS else len(paper.TASKS)
    return position, task, label != "softgm", label
