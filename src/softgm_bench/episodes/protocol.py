"""The protocol of an evaluation: its settings, as the command and the Python interface both have them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from numbers import Integral
from typing import TYPE_CHECKING, Any

from softgm_bench.errors import UserError

if TYPE_CHECKING:  # a refused command need not wait for torch
    from softgm_bench.episodes.evaluation import EpisodeRecords, Watch
    from softgm_bench.episodes.policy import TrainedPolicy


def whole_from_one(name: str, value: Any, *, optional: bool = False) -> None:
    """Refuse what is no whole number from 1 on, or with ``optional`` None.

    Raises:
        UserError: with the name and the value.
    """
    if (value is None and optional) or (isinstance(value, Integral) and int(value) >= 1):
        return
    raise UserError(f"{name}={value}: it must be at least 1, a whole number")


def check_seed(seed: Any) -> None:
    """Refuse what is no seed.

    Raises:
        UserError: saying what one is.
    """
    if not (isinstance(seed, Integral) and 0 <= int(seed) < 2**63):
        raise UserError(f"seed={seed}: a seed is a whole number from 0 to 2**63 - 1")


@dataclass
class Protocol:
    """Settings that decide which episodes an evaluation plays, and how.

    Attributes:
        episodes: of which each environment plays one.
        seed: of targets, obstacles and perturbations; the same gives the same episodes, none of them training's.
        deterministic: act by the mode of the policy, otherwise by a sample.
        horizon: control steps of an episode; None: the task's own.
        gamma: of the discounted return.
        batch: environments at once, to save memory; None: all. Others play other episodes.
        intervention: what the policy is shown in place of what its agents see, on the same scenes; see
            ``episodes.interventions``.
    """

    episodes: int = 100
    seed: int = 0
    deterministic: bool = True
    horizon: int | None = None
    gamma: float = 0.99
    batch: int | None = None
    intervention: str = "none"

    def check(self) -> None:
        """Refuse values that make no sense.

        Raises:
            UserError: naming the first such setting, its value and what would be right.
        """
        for key in ("episodes", "horizon", "batch"):
            whole_from_one(key, getattr(self, key), optional=key != "episodes")
        check_seed(self.seed)
        if not 0.0 <= self.gamma <= 1.0:
            raise UserError(f"gamma={self.gamma}: it must lie between 0 and 1")
        if self.intervention != "none":
            from softgm_bench.episodes import interventions

            interventions.check(self.intervention, self.episodes, self.batch)

    def check_fits(self, trained: TrainedPolicy) -> None:
        """Refuse an intervention on what neither the policy nor its task has.

        Raises:
            UserError: saying what is missing.
        """
        from softgm_bench.episodes import interventions

        interventions.check_fits(self.intervention, trained)

    def play(self, trained: TrainedPolicy, watch: Watch | None = None) -> EpisodeRecords:
        """Play the episodes in the environment that belongs to the policy; ``watch`` follows."""
        from softgm_bench.assembly import build_envs
        from softgm_bench.episodes import certified
        from softgm_bench.episodes.evaluation import evaluate_in_parts
        from softgm_bench.episodes.interventions import INTERVENTIONS

        records = evaluate_in_parts(
            trained.policy,
            lambda count, seed: build_envs(trained.config, count, seed, self.horizon),
            self.episodes,
            deterministic=self.deterministic,
            seed=self.seed,
            gamma=self.gamma,
            at_once=self.batch,
            show=INTERVENTIONS[self.intervention],
            watch=watch,
        )
        known = certified.mask(trained.config, self.episodes, self.seed, self.batch, self.horizon)
        return records.marked(known)

    def describe(self, trained: TrainedPolicy, overrides: Sequence[str]) -> dict[str, Any]:
        """Give the settings as ``summary.json`` has them, with ``overrides`` on top of the policy's own."""
        import torch

        from softgm_bench.episodes.policy import backend_of

        return {
            "evaluation_seed": self.seed,
            "deterministic": self.deterministic,
            "horizon": self.horizon or trained.config.task.horizon,
            "batch": self.batch,
            "intervention": self.intervention,
            "device": trained.config.device.partition(":")[0],
            "backend": backend_of(trained.config),
            "discount": self.gamma,
            "threads": torch.get_num_threads(),
            "overrides": list(overrides),
        }
