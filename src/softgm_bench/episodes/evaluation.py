"""Vectorised evaluation: every environment counts exactly its first episode."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from softgm_bench.envs import SectionMixture, entries
from softgm_bench.envs.entries import Column
from softgm_bench.errors import NotFinite
from softgm_bench.rod import sync

DISCOUNT = 0.99  # of the returns that are reported, whatever an algorithm trains with
FORGOTTEN = 0.1  # share of what came before that a recent mean forgets in a step
N_AGENTS = "n_agents"  # the column of the number of sections, of a mixture of them
CERTIFIED = "certified"  # the column of episodes whose scene is known to be solvable; see ``episodes.certified``
CHECK_EVERY = 16  # steps between two checks whether an episode goes on, on a device that a check waits for

Values = NDArray[np.float64] | NDArray[np.int64] | NDArray[np.bool_]


class EpisodeRecords(Mapping[str, Values]):
    """One number per episode in every column, ``(episodes,)``; columns are those of ``entries.EPISODE_COLUMNS``.

    A column is absent where the task does not tell it; ``certified`` is there where scenes are known, ``n_agents``
    where arms have several numbers of sections. Bool columns say whether something ever happened in the episode.

    Attributes:
        horizon: most control steps of an episode; None if the environment does not say it.
    """

    def __init__(self, columns: Mapping[str, Values], horizon: int | None = None) -> None:
        """Hold columns of equal lengths, in the order of the table of entries."""
        self.horizon = horizon
        known = [*(column.name for column in entries.EPISODE_COLUMNS), CERTIFIED, N_AGENTS]
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

    def of_arms(self, n_agents: int) -> "EpisodeRecords":
        """Add the column of the number of sections, the same for all."""
        return EpisodeRecords(self._columns | {N_AGENTS: np.full(self.episodes, n_agents)}, self.horizon)

    @staticmethod
    def joined(parts: "Sequence[EpisodeRecords]") -> "EpisodeRecords":
        """Put episodes of the same columns one after the other."""
        columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
        return EpisodeRecords(columns, parts[0].horizon)

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
Watch = Callable[[int, int], None]  # told now and then: steps and ended episodes since it was told last
Keep = Callable[[TensorDictBase, Tensor], None]  # given every step and its "next", (episodes,), and who still plays


def evaluate(
    policy: TensorDictModuleBase,
    env: EnvBase | SectionMixture,
    *,
    deterministic: bool,
    seed: int,
    gamma: float = DISCOUNT,
    show: Show | None = None,
    watch: Watch | None = None,
    keep: Keep | None = None,
) -> EpisodeRecords:
    """One episode in each of ``env``'s environments; the same seed gives the same episodes.

    ``show`` makes of a frame ``(episodes,)`` the one that the policy is shown in its place; ``watch`` follows, and
    ``keep`` is handed every step, of which the rows count that the mask beside it names. Of a mixture of numbers of
    sections one number plays after the other, each from ``seed``.

    Training is not disturbed: ``env`` must not be the training environment, and the global generator, on which a
    policy that samples draws, is put back.

    Raises:
        NotFinite: the policy has chosen an action that is not finite.
    """
    if isinstance(env, SectionMixture):
        play = partial(evaluate, policy, deterministic=deterministic, seed=seed, gamma=gamma, show=show)
        played = [play(one, watch=watch, keep=keep).of_arms(number) for number, one in env.members.items()]
        return EpisodeRecords.joined(played)
    exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    devices = [env.device] if env.device is not None and env.device.type == "cuda" else []
    with torch.random.fork_rng(devices), torch.no_grad(), set_exploration_type(exploration):
        env.set_seed(seed)
        torch.manual_seed(seed)
        return _first_episodes(policy, env, gamma, show, watch, keep)


def evaluate_in_parts(
    policy: TensorDictModuleBase,
    build: Callable[[int, int], EnvBase | SectionMixture],
    episodes: int,
    *,
    deterministic: bool,
    seed: int,
    gamma: float = DISCOUNT,
    at_once: int | None = None,
    show: Show | None = None,
    watch: Watch | None = None,
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
        watch: likewise.
    """
    size = at_once or episodes
    parts = []
    for part, first in enumerate(range(0, episodes, size)):
        own = evaluation_seed(seed, part)
        env = build(min(size, episodes - first), own)
        parts.append(evaluate(policy, env, deterministic=deterministic, seed=own, gamma=gamma, show=show, watch=watch))
    return EpisodeRecords.joined(parts)


def watched(episodes: int, tell: Callable[[int, str], None]) -> Watch:
    """Make a ``Watch`` that tells the steps since it told last, and what has become of all episodes in words."""
    ended = 0

    def watch(steps: int, more: int) -> None:
        nonlocal ended
        ended += more
        tell(steps, f"{ended} of {episodes} episodes have ended")

    return watch


def evaluation_seed(seed: int, part: int = 0) -> int:
    """Seed of the environments of an evaluation's part, independent of everything that any training draws."""
    return int(np.random.SeedSequence(seed, spawn_key=(2, part)).generate_state(1)[0])


def _first_episodes(
    policy: TensorDictModuleBase,
    env: EnvBase,
    gamma: float,
    show: Show | None,
    watch: Watch | None,
    keep: Keep | None,
) -> EpisodeRecords:
    data = env.reset()
    alive = torch.ones(env.batch_size, dtype=torch.bool, device=env.device)
    sound = torch.ones((), dtype=torch.bool, device=env.device)
    tally: _Tally | None = None
    free = sync.is_free(alive.device)
    told, ended = 0, 0
    for step in itertools.count():
        if free or step % CHECK_EVERY == 0:
            going = int(alive.sum())
            if watch is not None and step:
                watch(step - told, alive.numel() - going - ended)
                told, ended = step, alive.numel() - going
            if not going:
                break
        chosen = act(policy, data if show is None else show(data), alive)
        sound = sound & chosen[entries.ACTION].isfinite().all()
        data = env.step(chosen)
        after = data["next"]
        if keep is not None:
            keep(data, alive)
        tally = tally or _Tally(after, gamma)
        tally.add(after, alive)
        alive = alive & ~after[entries.DONE].squeeze(-1)
        data = step_mdp(data)
    if not sound:
        raise NotFinite("an action of the policy is not finite")
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
        self._recent = chosen(entries.RECENT)
        (episodes,), device = frame.batch_size, frame.device
        self._length = torch.zeros((episodes, 1), dtype=torch.int64, device=device)
        self._sums = torch.zeros((episodes, len(self._summed)), dtype=torch.float64, device=device)
        self._weight = torch.ones(len(self._summed), dtype=torch.float64, device=device)
        discount = [gamma if column.reduction == entries.DISCOUNTED else 1.0 for column in self._summed]
        self._discount = torch.tensor(discount, dtype=torch.float64, device=device)
        self._counts = torch.zeros((episodes, len(self._counted)), dtype=torch.int64, device=device)
        self._ever = torch.zeros((episodes, len(self._happened)), dtype=torch.bool, device=device)
        self._ends = torch.zeros((episodes, len(self._last)), dtype=torch.float64, device=device)
        self._means: Tensor | None = None  # of the recent past, (episodes, columns)

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
        if self._recent:
            now = _side_by_side(frame, self._recent).double()
            self._means = (
                now if self._means is None else torch.where(going, self._means.lerp(now, FORGOTTEN), self._means)
            )

    def records(self, horizon: int | None) -> EpisodeRecords:
        """Give all that has been added, of episodes of at most ``horizon`` steps."""
        length = self._length.squeeze(-1)
        columns = {"length": length}
        tallies = (
            (self._summed, self._sums),
            (self._counted, self._counts),
            (self._happened, self._ever),
            (self._last, self._ends),
            (self._recent, self._means if self._means is not None else self._sums[:, :0]),
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

    With them goes what a policy remembers. On a device where reading ``alive`` would wait, all are paid for.
    """
    if not sync.is_free(alive.device) or alive.all():
        return policy(data)
    chosen = policy(data[alive])
    for key in (entries.ACTION, entries.NEXT_MEMORY):
        of_some = chosen.get(key, None)
        if of_some is not None:
            of_all = of_some.new_zeros(*alive.shape, *of_some.shape[1:])
            of_all[alive] = of_some
            data.set(key, of_all)
    return data
