"""Collects the frames of episodes while they are played side by side, in the layout of a data set's files."""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from softgm_bench.datasets import layout
from softgm_bench.envs import entries
from softgm_bench.episodes.evaluation import EpisodeRecords

Columns = dict[NestedKey, Tensor]
Tell = Callable[[int], None]  # told how many transitions were collected since it was told last


class Collector:
    """What one evaluation hands to ``keep``, frame by frame; episodes that have ended are not stored any further."""

    def __init__(self, env: EnvBase, tell: Tell) -> None:
        """Collect the episodes that are played in ``env``, one in each of its environments; ``tell`` follows."""
        self._tell = tell
        self._observed, self._paid = layout.observed(env), layout.paid(env)
        self._plain = [key for key in self._observed if key not in layout.PACKED]
        (self._episodes,) = env.batch_size
        self._columns: dict[NestedKey, list[Tensor]] = {}
        self._environment: list[Tensor] = []
        slots: int = env.sizes.n_slots
        self._table = _Table(self._episodes, slots) if slots else None

    def keep(self, data: TensorDictBase, alive: Tensor) -> None:
        """Take a step, ``(episodes,)`` with its end under "next", of the episodes in ``alive``, ``(episodes,)``."""
        playing = data[alive].cpu()
        rows = alive.cpu().nonzero().squeeze(-1)
        after = playing["next"]
        steps = {layout.under_next(key): after[key] for key in self._paid} | {entries.ACTION: playing[entries.ACTION]}
        self._append(rows, self._packed(rows, playing), steps)
        self._tell(len(rows))
        done = after[entries.DONE].squeeze(-1)
        if done.any():
            nothing = {key: torch.zeros_like(value[done]) for key, value in steps.items()}
            self._append(rows[done], self._packed(rows[done], after[done]), nothing, final=True)

    def content(self, records: EpisodeRecords, about: Mapping[str, int], first: int, at_least: int) -> TensorDict:
        """Give the content of a file: the first episodes that have ``at_least`` transitions together, or all.

        Args:
            records: what the episodes say of themselves.
            about: columns of all episodes, such as the policy.
            first: number of the first episode in the data set.
            at_least: transitions.
        """
        ends = np.cumsum(records["length"])
        count = min(int(np.searchsorted(ends, at_least)) + 1, len(ends))
        length = torch.from_numpy(np.asarray(records["length"][:count], dtype=np.int64))
        environment = torch.cat(self._environment)
        order = environment.argsort(stable=True)  # frames of an episode came in order
        order = order[: int((length + 1).sum())]
        columns = {key: torch.cat(values)[order] for key, values in self._columns.items()}
        parts = {}
        if self._table is not None:
            version = columns.pop(layout.SLOT_BEGIN)
            table, columns[layout.SLOT_BEGIN] = self._table.rows(environment[order], version)
            parts[layout.TABLE] = TensorDict({"descriptor": table}, [len(table)])
        columns[layout.EPISODE] = (first + environment[order]).to(torch.int32)
        columns[layout.POLICY] = torch.full((len(order),), about["policy"], dtype=torch.int16)
        begin = torch.cumsum(length + 1, 0) - (length + 1)
        episodes = {"begin": begin} | {name: torch.full((count,), value) for name, value in about.items()}
        episodes["environment"] = torch.arange(count)
        episodes |= {name: torch.from_numpy(np.ascontiguousarray(values[:count])) for name, values in records.items()}
        parts[layout.FRAMES] = layout.nested(columns, len(order))
        return TensorDict(parts | {layout.EPISODES: TensorDict(episodes, [count])})

    def _append(self, rows: Tensor, frame: Columns, steps: Columns, final: bool = False) -> None:
        ends = torch.full((len(rows), 1), final)
        for key, value in (frame | steps | {layout.FINAL: ends}).items():
            self._columns.setdefault(key, []).append(value)
        self._environment.append(rows)

    def _packed(self, rows: Tensor, frame: TensorDictBase) -> Columns:
        """Give what is stored of a frame ``(len(rows),)``; in place of where descriptors begin, their version."""
        columns = {key: frame[key].clone() for key in self._plain}
        if self._table is None:
            return columns
        version, count = self._table.note(rows, frame[entries.SLOT_DESCRIPTOR], frame[entries.SLOT_ACTIVE])
        return columns | {
            layout.EDGE_BITS: layout.bits(frame[entries.EDGE]),
            layout.SLOT_BEGIN: version,
            layout.SLOT_COUNT: count.to(torch.int16),
        }


class _Table:
    """Descriptors of every episode's obstacles, in versions: one that only grows is one version."""

    def __init__(self, episodes: int, slots: int) -> None:
        self._newest = torch.zeros(episodes, slots, layout.DESCRIPTOR)
        self._count = torch.zeros(episodes, dtype=torch.int64)
        self._version = torch.zeros(episodes, dtype=torch.int64)
        self._slots = torch.arange(slots)
        self._closed: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []

    def note(self, rows: Tensor, descriptor: Tensor, active: Tensor) -> tuple[Tensor, Tensor]:
        """Note a frame of the episodes ``rows``; gives the version of each one's descriptors and how many it has.

        Raises:
            ValueError: active slots are not the first ones.
        """
        count = active.sum(-1)
        if not torch.equal(active, self._slots < count.unsqueeze(-1)):
            raise ValueError("active slots are not the first ones")
        held = self._slots < self._count[rows].unsqueeze(-1)
        other = ((descriptor != self._newest[rows]).any(-1) & held).any(-1) | (count < self._count[rows])
        self._close(rows[other])
        self._version[rows[other]] += 1
        self._newest[rows], self._count[rows] = descriptor, count
        return self._version[rows], count

    def rows(self, episode: Tensor, version: Tensor) -> tuple[Tensor, Tensor]:
        """Give the rows of these frames' versions, ``(rows, 9)``, and where each frame's begin among them."""
        self._close(torch.arange(len(self._count)))
        owner, which, count, rows = (torch.cat(column) for column in zip(*self._closed, strict=True))
        most = int(self._version.max()) + 1
        wanted, inverse = torch.unique(episode * most + version, return_inverse=True)
        key = owner * most + which
        order = key.argsort()  # every version was closed once
        chosen = order[torch.searchsorted(key[order], wanted)]
        starts = count.cumsum(0) - count
        ends = count[chosen].cumsum(0)
        begin = ends - count[chosen]
        where = torch.arange(int(ends[-1])) + (starts[chosen] - begin).repeat_interleave(count[chosen])
        return rows[where], begin[inverse]

    def _close(self, episodes: Tensor) -> None:
        count = self._count[episodes]
        used = self._newest[episodes][self._slots < count.unsqueeze(-1)]
        self._closed.append((episodes, self._version[episodes].clone(), count, used))
