"""Vectorised evaluation: every environment counts exactly its first episode."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from softgm_bench.envs import entries
from softgm_bench.envs.entries import Column
from softgm_bench.rod import sync

DISCOUNT = 0.99  # of the returns that are reported, whatever an algorithm trains with
CERTIFIED = "certified"  # the column of episodes whose scene is known to be solvable; see ``episodes.certified``
CHECK_EVERY = 16  # steps between two checks whether an episode goes on, on a device that a check waits for

Values = NDArray[np.float64] | NDArray[np.int64] | NDArray[np.bool_]


class EpisodeRecords(Mapping[str, Values]):
    """One number per episode in every column, ``(episodes,)``; columns are those of ``entries.EPISODE_COLUMNS``.

    A column is absent where the task does not tell it; ``certified`` is there where scenes are known. Bool columns say
    whether something ever happened in the episode.

    Attributes:
        horizon: most control steps of an episode; None if the environment does not say it.
    """

    def __init__(self, columns: Mapping[str, Values], horizon: int | None = None) -> None:
        """Hold columns of equal lengths, in the order of the table of entries."""
        self.horizon = horizon
        known = [*(column.name for column in entries.EPISODE_COLUMNS), CERTIFIED]
        self._columns = {name: columns[name] for name in known if name in columns}

    def __getitem__(self, name: str) -> Values:
        """Give a column."""
        return self._columns[name]

    def __iter__(self) -> Iterator[str]:
        """Go through the names of the columns."""
        return iter(self._columns)

    def __len__(self) -> int:
        """Give the number of columns."""
        return len(self._columns)

    def marked(self, certified: NDArray[np.bool_] | None) -> "EpisodeRecords":
        """Add the column of certified scenes, ``(episodes,)``; None: there is none to add."""
        more = {} if certified is None else {CERTIFIED: certified}
        return EpisodeRecords(self._columns | more, self.horizon)

    @property
    def episodes(self) -> int:
        """The number of episodes."""
        return len(self["length"])

    def rows(self) -> list[dict[str, float | int]]:
        """Give one mapping per episode, of plain numbers."""
        columns = {name: values.tolist() for name, values in self.items()}
        return [
            {"episode": index} | {name: values[index] for name, values in columns.items()}
            for index in range(self.episodes)
        ]


Show = Callable[[TensorDictBase], TensorDictBase]


def evaluate(
    policy: TensorDictModuleBase,
    env: EnvBase,
    *,
    deterministic: bool,
    seed: int,
    gamma: float = DISCOUNT,
    show: Show | None = None,
) -> EpisodeRecords:
    """One episode in each of ``env``'s environments; the same seed gives the same episodes.

    ``show`` makes of a frame ``(episodes,)`` the one that the policy is shown in its place.

    Training is not disturbed: ``env`` must not be the training environment, and the global generator, on which a
    policy that samples draws, is put back.
    """
    exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    devices = [env.device] if env.device is not None and env.device.type == "cuda" else []
    with torch.random.fork_rng(devices), torch.no_grad(), set_exploration_type(exploration):
        env.set_seed(seed)
        torch.manual_seed(seed)
        return _first_episodes(policy, env, gamma, show)


def evaluate_in_parts(
    policy: TensorDictModuleBase,
    build: Callable[[int, int], EnvBase],
    episodes: int,
    *,
    deterministic: bool,
    seed: int,
    gamma: float = DISCOUNT,
    at_once: int | None = None,
    show: Show | None = None,
) -> EpisodeRecords:
    """``episodes`` episodes; with the same ``at_once``, the same seed gives the same ones.

    Args:
        policy: to be evaluated.
        build: makes an environment of so many environments with a seed.
        episodes: how many.
        deterministic: take the policy's mean instead of a sample.
        seed: from which all seeds are derived; see ``evaluation_seed``.
        gamma: of the discounted return.
        at_once: environments simulated side by side, to save memory; None: all.
        show: as ``evaluate`` takes it.
    """
    size = at_once or episodes
    parts = []
    for part, first in enumerate(range(0, episodes, size)):
        own = evaluation_seed(seed, part)
        env = build(min(size, episodes - first), own)
        parts.append(evaluate(policy, env, deterministic=deterministic, seed=own, gamma=gamma, show=show))
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
    return EpisodeRecords(columns, parts[0].horizon)


def evaluation_seed(seed: int, part: int = 0) -> int:
    """Seed of the environments of an evaluation's part, independent of everything that any training draws."""
    return int(np.random.SeedSequence(seed, spawn_key=(2, part)).generate_state(1)[0])


def _first_episodes(policy: TensorDictModuleBase, env: EnvBase, gamma: float, show: Show | None) -> EpisodeRecords:
    data = env.reset()
    alive = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    tally: _Tally | None = None
    free = sync.is_free(alive.device)
    for step in itertools.count():
        if (free or step % CHECK_EVERY == 0) and not alive.any():
            break
        data = env.step(act(policy, data if show is None else show(data), alive))
        after = data["next"]
        tally = tally or _Tally(after, gamma)
        tally.add(after, alive)
        alive = alive & ~after[entries.DONE].squeeze(-1)
        data = step_mdp(data)
    assert tally is not None
    return tally.records(getattr(env, "horizon", None))


class _Tally:
    """Adds up what episodes say of themselves, in the ways that the table of entries asks for."""

    def __init__(self, frame: TensorDictBase, gamma: float) -> None:
        """Begin with nothing; ``frame``, ``(episodes,)``, shows what there is to add up."""
        told = set(frame.keys(include_nested=True))

        def chosen(*reductions: str) -> list[Column]:
            return [
                column for column in entries.EPISODE_COLUMNS if column.reduction in reductions and column.key in told
            ]

        self._summed, self._counted = chosen(entries.DISCOUNTED, entries.SUM, entries.MEAN), chosen(entries.COUNT)
        self._happened, self._last = chosen(entries.EVER), chosen(entries.LAST, entries.LAST_COUNT)
        (episodes,), device = frame.batch_size, frame.device
        self._length = torch.zeros((episodes, 1), dtype=torch.int64, device=device)
        self._sums = torch.zeros((episodes, len(self._summed)), dtype=torch.float64, device=device)
        self._weight = torch.ones(len(self._summed), dtype=torch.float64, device=device)
        discount = [gamma if column.reduction == entries.DISCOUNTED else 1.0 for column in self._summed]
        self._discount = torch.tensor(discount, dtype=torch.float64, device=device)
        self._counts = torch.zeros((episodes, len(self._counted)), dtype=torch.int64, device=device)
        self._ever = torch.zeros((episodes, len(self._happened)), dtype=torch.bool, device=device)
        self._ends = torch.zeros((episodes, len(self._last)), dtype=torch.float64, device=device)

    def add(self, frame: TensorDictBase, alive: Tensor) -> None:
        """Add a step of the episodes in ``alive``, ``(episodes,)``."""
        going = alive.unsqueeze(-1)
        self._length += going
        self._sums += torch.where(going, _side_by_side(frame, self._summed).double() * self._weight, 0.0)
        self._weight *= self._discount
        if self._counted:
            self._counts += going & (_side_by_side(frame, self._counted) > 0)
        if self._happened:
            self._ever |= going & _side_by_side(frame, self._happened)
        if self._last:
            self._ends = torch.where(going, _side_by_side(frame, self._last).double(), self._ends)

    def records(self, horizon: int | None) -> EpisodeRecords:
        """Give all that has been added, of episodes of at most ``horizon`` steps."""
        length = self._length.squeeze(-1)
        columns = {"length": length}
        tallies = (
            (self._summed, self._sums),
            (self._counted, self._counts),
            (self._happened, self._ever),
            (self._last, self._ends),
        )
        for group, values in tallies:
            for column, value in zip(group, values.unbind(-1), strict=True):
                if column.reduction == entries.MEAN:
                    value = value / length
                columns[column.name] = value.long() if column.reduction == entries.LAST_COUNT else value
        return EpisodeRecords({name: values.cpu().numpy() for name, values in columns.items()}, horizon)


def _side_by_side(frame: TensorDictBase, columns: Sequence[Column]) -> Tensor:
    """Put entries ``(episodes, 1)`` side by side."""
    return torch.cat([frame.get(column.key) for column in columns], dim=-1)


def act(policy: TensorDictModuleBase, data: TensorDictBase, alive: Tensor) -> TensorDictBase:
    """Choose the actions of the environments whose first episode goes on; zeros, unpaid for, in the others.

    On a device where reading ``alive`` would wait, all are paid for.
    """
    if not sync.is_free(alive.device) or alive.all():
        return policy(data)
    action = policy(data[alive])[entries.ACTION]
    data[entries.ACTION] = action.new_zeros(*alive.shape, *action.shape[1:])
    data[entries.ACTION][alive] = action
    return data
