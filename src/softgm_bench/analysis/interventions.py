"""Pairs evaluations under an intervention with those without, episode by episode on the same scenes."""

from collections.abc import Sequence
from typing import NamedTuple

from softgm_bench.analysis.pools import condition
from softgm_bench.analysis.runs import Evaluation
from softgm_bench.analysis.statistics import Discordance, mcnemar


class Pair(NamedTuple):
    """An evaluation under an intervention and the same policy's without.

    Attributes:
        intervened: the evaluation under the intervention.
        plain: the one without; None where ``reason`` says why there is none to compare with.
        reason: empty for a pair.
    """

    intervened: Evaluation
    plain: Evaluation | None
    reason: str = ""

    @property
    def discordance(self) -> Discordance | None:
        """The episodes that one of the two succeeds in, and what chance says of them; None without a pair."""
        if self.plain is None:
            return None
        return mcnemar(self.plain.episodes["success"], self.intervened.episodes["success"])


def pairs(evaluations: Sequence[Evaluation]) -> list[Pair]:
    """Pair every evaluation under an intervention, in order of task, algorithm, seed and intervention."""
    plain = [one for one in evaluations if not one.intervened]
    intervened = [one for one in evaluations if one.intervened]
    found = [_paired(one, [other for other in plain if _policy(other) == _policy(one)]) for one in intervened]
    return sorted(found, key=lambda pair: (*_policy(pair.intervened), pair.intervened.intervention))


def _policy(evaluation: Evaluation) -> tuple:
    """What acted, and in what world."""
    trained = (evaluation.task, evaluation.label, evaluation.seed, evaluation.frames)
    return *trained, condition(evaluation), tuple(evaluation.overrides), evaluation.deterministic


def _paired(intervened: Evaluation, plain: Sequence[Evaluation]) -> Pair:
    """Choose the evaluation of the same scenes; of several the one that lies beside it, as those of one run do."""
    if "success" not in intervened.episodes:
        return Pair(intervened, None, "success was not recorded")
    if not plain:
        return Pair(intervened, None, "no evaluation of this policy without an intervention")
    same = [one for one in plain if one.scenes == intervened.scenes]
    if not same:
        return Pair(intervened, None, f"not the same scenes: {_difference(intervened, plain[0])}")
    beside = [one for one in same if _place(one) == _place(intervened)] or same
    if len(beside) > 1:
        return Pair(intervened, None, f"{len(beside)} evaluations without an intervention: one must lie beside it")
    return Pair(intervened, beside[0])


def _difference(one: Evaluation, other: Evaluation) -> str:
    differing = [key for key in one.scenes if one.scenes[key] != other.scenes[key]]
    return ", ".join(f"{key} {one.scenes[key]} and {other.scenes[key]}" for key in differing)


def _place(evaluation: Evaluation) -> str:
    return evaluation.folder.rpartition("/")[0]
