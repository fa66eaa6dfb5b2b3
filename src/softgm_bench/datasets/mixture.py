"""Who acts in a data set, each for which share of the transitions, and with which seeds."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from softgm_bench.assembly import configure
from softgm_bench.config import Config, plain, validate_device
from softgm_bench.envs import entries, kind_of
from softgm_bench.envs.section_mixture import refuse_mixture
from softgm_bench.episodes import policy
from softgm_bench.errors import UserError

RANDOM = "random"  # in place of a policy's file
# settings in which all of a data set's policies act
ACTED_IN = ("task", "rod", "perturbation", "randomise", "dtype", "backend")
OF_TRAINING = ("curriculum", "train_horizon")  # settings of a task that nothing but training heeds


class Uniform(TensorDictModuleBase):
    """Draws every action uniformly from [-1, 1], whatever is observed."""

    in_keys: ClassVar[list[Any]] = []
    out_keys: ClassVar[list[Any]] = [entries.ACTION]

    def __init__(self, n_agents: int, actions: int) -> None:
        """Act for so many agents, each with so many numbers."""
        super().__init__()
        self.shape = (n_agents, actions)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write ``entries.ACTION``, ``(*batch, N, A)``."""
        action = torch.empty((*td.batch_size, *self.shape), device=td.device)
        return td.set(entries.ACTION, action.uniform_(-1.0, 1.0))


@dataclass(frozen=True)
class Behaviour:
    """One of those who act.

    Attributes:
        policy: writes ``entries.ACTION``.
        transitions: to be collected of it, at least.
        about: plain values for readers: source, label, frames, fingerprint, share.
    """

    policy: TensorDictModuleBase
    transitions: int
    about: dict[str, Any]


def load(
    sources: Sequence[str], shares: Sequence[float], transitions: int, device: str, overrides: Sequence[str]
) -> tuple[list[Behaviour], Config]:
    """Read the policies; gives them and the configuration in which all act, on ``device``.

    Args:
        sources: ``random`` or where ``policy.load`` reads a policy, each.
        shares: of the transitions, in any unit.
        transitions: of the data set, at least.
        device: to act on.
        overrides: settings to act in, as ``policy.load`` takes them.

    Raises:
        UserError: a source makes no sense, the policies do not act in the same, or nothing says on which task.
    """
    validate_device(device)
    trained = {source: policy.load(Path(source), device, overrides) for source in sources if source != RANDOM}
    named = next((source for source in sources if source != RANDOM), None)
    if named is not None:
        config = trained[named].config
    elif any(override.startswith("task=") for override in overrides):
        config = replace(configure(list(overrides)), device=device)
    else:
        raise UserError("policies are all random: name a task too: task=wall, for example")
    for source, other in trained.items():
        if (differs := _difference(config, other.config)) is not None:
            raise UserError(f"{source} acts in another {differs} than {named}: add {differs}=NAME for both")
    refuse_mixture(config.task)
    sizes = kind_of(config.task).sizes(config.task)
    counts = _apportioned(shares, transitions)
    if 0 in counts:
        none = sources[counts.index(0)]
        raise UserError(f"transitions={transitions}: {none} would have none; ask for more or give it a larger share")
    behaviours = []
    for source, share, count in zip(sources, shares, counts, strict=True):
        about: dict[str, Any] = {"source": source, "share": share / sum(shares), "transitions": count}
        if source == RANDOM:
            acting: TensorDictModuleBase = Uniform(sizes.n_agents, sizes.action)
            about |= {"label": RANDOM, "frames": 0, "fingerprint": None}
        else:
            one = trained[source]
            acting = one.policy
            about |= {"label": one.label, "frames": one.frames, "fingerprint": policy.fingerprint(one)}
        behaviours.append(Behaviour(acting, count, about))
    return behaviours, config


def part_seed(seed: int, behaviour: int, part: int) -> int:
    """Seed of a part: no training's, no evaluation's, and no other part's."""
    return int(np.random.SeedSequence(seed, spawn_key=(3, behaviour, part)).generate_state(1)[0])


def _apportioned(shares: Sequence[float], transitions: int) -> list[int]:
    """Split a number by shares: whole numbers that add up to it, by the largest remainder."""
    exact = np.asarray(shares, dtype=np.float64) * transitions / sum(shares)
    counts = np.floor(exact).astype(int)
    left = transitions - int(counts.sum())
    counts[np.argsort(counts - exact, kind="stable")[:left]] += 1
    return counts.tolist()


def acted_in(config: Config) -> dict[str, Any]:
    """Give the settings that decide what an episode is, as plain values."""
    values = plain(config)
    kept = {key: values[key] for key in ACTED_IN} | {"backend": policy.backend_of(config)}
    kept["task"] = {key: value for key, value in kept["task"].items() if key not in OF_TRAINING}
    return kept


def _difference(one: Config, other: Config) -> str | None:
    """Name the first setting in which two configurations let policies act in different things."""
    ours, theirs = acted_in(one), acted_in(other)
    return next((key for key in ours if ours[key] != theirs[key]), None)
