"""Reads a data set: ready replay buffers of TorchRL whose transitions are made of what is mapped into memory.

A transition is what ``env.step`` gives: an observation and an action, and under ``next`` the observation after it,
``reward``, ``done``, ``terminated`` and ``truncated``; beside these the number of its ``episode`` and ``policy``.
"""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from omegaconf import OmegaConf
from tensordict import TensorDict
from torch import Tensor
from torchrl.data import SliceSampler, TensorDictReplayBuffer
from torchrl.data.replay_buffers import ImmutableDatasetWriter, Storage
from torchrl.data.replay_buffers.samplers import RandomSampler
from torchrl.envs import EnvBase

from softgm_bench.assembly import build_env
from softgm_bench.config import Config, typed
from softgm_bench.datasets import chunks, layout, writing
from softgm_bench.envs import Sizes, entries, kind_of
from softgm_bench.errors import UserError


@dataclass(frozen=True)
class Dataset:
    """A data set in a folder.

    Attributes:
        folder: of its files.
        settings: what ``dataset.json`` holds: policies, seeds, the configuration that was acted in.
        episodes: one entry an episode in every column, ``(episodes,)``: policy, seed, environment, chunk, begin (its
            first frame there), and the columns of an evaluation's episodes, such as length and success.
    """

    folder: Path
    settings: dict[str, Any]
    episodes: dict[str, NDArray[Any]]

    @property
    def transitions(self) -> int:
        """Number of transitions."""
        return int(self.episodes["length"].sum())

    @cached_property
    def config(self) -> Config:
        """The configuration that was acted in."""
        return typed(OmegaConf.create(self.settings["config"]))

    @cached_property
    def sizes(self) -> Sizes:
        """Sizes of actions and observations."""
        return kind_of(self.config.task).sizes(self.config.task)

    def make_env(self, num_envs: int = 1, seed: int = 0) -> EnvBase:
        """Build the environment that was acted in; with a part's ``batch`` and seed it has that part's scenes."""
        return build_env(self.config, num_envs, seed, self.settings["horizon"])

    def verify(self) -> None:
        """Compare all files with their checksums.

        Raises:
            UserError: naming the first one that has changed.
        """
        writing.verify(self.folder)

    def storage(self, policy: int | None = None, reward_terms: bool = False) -> "TransitionStorage":
        """Give the transitions, or those of one policy by its number, as a storage for TorchRL's replay buffers."""
        chosen = np.arange(len(self.episodes["policy"]))
        if policy is not None:
            if not 0 <= policy < len(self.settings["policies"]):
                raise UserError(f"policy={policy}: the data set has 0 to {len(self.settings['policies']) - 1}")
            chosen = np.flatnonzero(self.episodes["policy"] == policy)
        return TransitionStorage(self, chosen, reward_terms)

    def replay_buffer(
        self,
        batch_size: int,
        slice_length: int | None = None,
        policy: int | None = None,
        reward_terms: bool = False,
        **settings: Any,
    ) -> TensorDictReplayBuffer:
        """Give a replay buffer, which cannot be written to, of all transitions.

        Args:
            batch_size: transitions of a sample.
            slice_length: None: transitions are drawn one by one; otherwise consecutive ones of an episode, so many, of
                episodes that are as long. A sample then has ``batch_size / slice_length`` of these one behind another.
            policy: number of the policy whose transitions count; None: all.
            reward_terms: whether the terms of the reward are read too, where there are any.
            settings: others of ``TensorDictReplayBuffer``: transform, prefetch, pin_memory and so on.
        """
        storage = self.storage(policy, reward_terms)
        sampler: Any = RandomSampler()
        if slice_length is not None:
            sampler = SliceSampler(slice_len=slice_length, ends=storage.ends(), cache_values=True)
        fixed = {"sampler": sampler, "writer": ImmutableDatasetWriter(), "collate_fn": _as_it_is}
        return TensorDictReplayBuffer(storage=storage, batch_size=batch_size, **fixed, **settings)


def load(folder: str | Path, unfinished: bool = False) -> Dataset:
    """Read a data set that the command ``dataset`` wrote.

    Args:
        folder: of the data set.
        unfinished: take what chunks there are if the writing has not come to its end.

    Raises:
        UserError: there is none, it is not finished, or it is damaged.
    """
    folder = Path(folder)
    settings = writing.read_settings(folder)
    if not unfinished and not (folder / writing.SUMS).exists():
        raise UserError(f"{folder}: the writing of this data set has not finished; the same command goes on")
    episodes = writing.episodes_of(folder)
    if not episodes:
        raise UserError(f"{folder}: no chunk of this data set is there")
    return Dataset(folder, settings, episodes)


class TransitionStorage(Storage):
    """A data set's transitions for TorchRL's replay buffers; they are put together when they are asked for.

    Transitions of an episode follow each other. Files are mapped, and only what is asked for is read.
    """

    def __init__(self, dataset: Dataset, episodes: NDArray[np.int64], reward_terms: bool) -> None:
        """Take these episodes of the data set."""
        length = torch.from_numpy(dataset.episodes["length"][episodes].astype(np.int64))
        super().__init__(int(length.sum()))
        self._sizes, self._terms = dataset.sizes, reward_terms
        self._ends = length.cumsum(0)
        self._begin = torch.from_numpy(dataset.episodes["begin"][episodes].astype(np.int64)) - (self._ends - length)
        self._chunk = torch.from_numpy(dataset.episodes["chunk"][episodes].astype(np.int64))
        self._files = writing.written(dataset.folder)
        self._mapped: dict[int, tuple[TensorDict, Tensor]] = {}

    def __len__(self) -> int:
        """Number of transitions."""
        return self.max_size

    def ends(self) -> Tensor:
        """Tell of every transition, ``(transitions,)``, whether it is its episode's last, for a ``SliceSampler``."""
        ends = torch.zeros(len(self), dtype=torch.bool)
        ends[self._ends - 1] = True
        return ends

    def get(self, index: Any) -> TensorDict:
        """Give one transition, or as many as ``index`` (a slice, a list, a tensor ``(size,)``) asks for."""
        if isinstance(index, tuple):  # as samplers give it: one index for each of one dimension
            (index,) = index
        if isinstance(index, int | np.integer) or (isinstance(index, Tensor) and index.ndim == 0):
            return self.get([int(index)])[0]
        if isinstance(index, slice):
            index = torch.arange(*index.indices(len(self)))
        index = torch.as_tensor(index, dtype=torch.int64)
        index = torch.where(index < 0, index + len(self), index)
        if ((index < 0) | (index >= len(self))).any():
            raise IndexError(f"a data set of {len(self)} transitions has no such index")
        episode = torch.searchsorted(self._ends, index, right=True)
        chunk, row = self._chunk[episode], self._begin[episode] + index
        numbers = chunk.unique().tolist() or [0]
        if len(numbers) == 1:
            return self._transitions(numbers[0], row)
        asked = [(chunk == number).nonzero().squeeze(-1) for number in numbers]
        found = torch.cat([self._transitions(number, row[at]) for number, at in zip(numbers, asked, strict=True)])
        return found[torch.cat(asked).argsort()]

    def _transitions(self, number: int, row: Tensor) -> TensorDict:
        """Transitions whose frames are these rows of a chunk, ``(size,)``."""
        if number not in self._mapped:
            self._mapped[number] = _map(self._files[number], self._terms)
        frames, table = self._mapped[number]
        both = frames[torch.cat([row, row + 1])]
        steps = both.pop("next")[: len(row)]
        shown = entries.frame(layout.unpack(both, table, self._sizes), both.shape, self._sizes, torch.device("cpu"))
        transition = shown[: len(row)].exclude(layout.FINAL)
        after = shown[len(row) :].exclude(entries.ACTION, layout.EPISODE, layout.POLICY, layout.FINAL)
        return transition.set("next", after.update(steps))

    def set(self, cursor: Any, data: Any, *, set_cursor: bool = True) -> None:
        """Refuse to be written to."""
        raise RuntimeError(ImmutableDatasetWriter.WRITING_ERR)

    def contains(self, item: Any) -> bool:
        """Tell whether there is such an index."""
        return 0 <= int(item) < len(self)

    def state_dict(self) -> dict[str, Any]:
        """Give nothing: the files hold everything."""
        return {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Do nothing."""

    def _empty(self) -> None:
        raise RuntimeError(ImmutableDatasetWriter.WRITING_ERR)


def _as_it_is(transitions: TensorDict) -> TensorDict:
    return transitions


def _map(file: Path, terms: bool) -> tuple[TensorDict, Tensor]:
    frames = chunks.read(file, layout.FRAMES)
    if not terms:
        frames = frames.exclude(("next", entries.REWARD_TERMS))
    has_table = layout.SLOT_BEGIN in frames.keys(include_nested=True)
    return frames, chunks.read(file, layout.TABLE)["descriptor"] if has_table else torch.zeros(0, layout.DESCRIPTOR)
