"""A replay buffer for off-policy learning: compact, and what is sampled equals what was stored bit by bit.

A transition's two observations are one frame and the next one of the same environment, so each frame is stored once.
What does not change within an episode, the descriptors of discovered obstacles, is stored once an episode: slots are
only ever added, so a frame's slots are the first ``count`` rows of its episode's table. Flags are packed to bits.
An episode's last observation, which no frame follows, lies beside its table.
"""

from collections.abc import Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes

Key = str | tuple[str, str]
Columns = dict[str, Tensor]

# Of an observation, what is stored of every frame as it is; edges and active slots are packed.
PLAIN: tuple[Key, ...] = (
    entries.AGENT_POSITION,
    entries.AGENT_VELOCITY,
    entries.PREVIOUS_ACTION,
    entries.TIP,
    entries.TARGET,
)
FRAMES_PER_EPISODE = 8  # room for one episode in so many frames; shorter ones make old frames go earlier


class ReplayBuffer:
    """The newest frames of ``num_envs`` environments, each a ring of its own in memory that is taken at once.

    Entries ``(rows, num_envs, ...)`` are rings over time, entries ``(episodes, num_envs, ...)`` rings over episodes.
    Environments are stored in step, so time is one number for all.

    Attributes:
        rows: frames of each environment.
        episodes: episodes of each environment, the running one included; when a new one begins, the frames of the
            oldest are given up.
    """

    def __init__(
        self,
        capacity: int,
        num_envs: int,
        sizes: Sizes,
        device: torch.device | str,
        n_privileged: int = 0,
    ) -> None:
        """Take the memory for ``capacity`` transitions, with ``entries.PRIVILEGED`` if ``n_privileged`` is above 0.

        On a CPU the system provides it page by page when it is written.

        Raises:
            ValueError: if there is no room for two frames of every environment.
        """
        if capacity < 2 * num_envs:
            raise ValueError(
                f"algo.replay_capacity is {capacity}: it must be at least two frames of each of {num_envs} environments"
            )
        n_slots = sizes.n_slots
        self.num_envs, self.n_slots = num_envs, n_slots
        self.rows = -(-capacity // num_envs)
        self.episodes = max(2, -(-self.rows // FRAMES_PER_EPISODE))
        self.device = torch.device(device)
        self._bytes = -(-n_slots // 8)  # of one agent's edges
        self._plain: tuple[Key, ...] = (*PLAIN, entries.PRIVILEGED) if n_privileged else PLAIN
        observation = {_name(key): (entries.shape_of(key, sizes), torch.float32) for key in self._plain}
        observation |= {
            "edge": ((sizes.n_agents, self._bytes), torch.uint8),
            "count": ((), torch.int32),
        }
        step = {
            "action": (entries.shape_of(entries.ACTION, sizes), torch.float32),
            "reward": ((1,), torch.float32),
            "done": ((1,), torch.bool),
            "terminated": ((1,), torch.bool),
            "closed": ((), torch.bool),  # the next observation is the episode's last, not the next frame
            "episode": ((), torch.int32),  # which entry of the rings over episodes
        }
        self._frames = self._allocate(self.rows, observation | step)
        self._last = self._allocate(self.episodes, observation)  # each episode's newest observation
        self._table = self._allocate(self.episodes, {"descriptor": ((n_slots, 9), torch.float32)})["descriptor"]
        self._begin = torch.zeros((self.episodes, num_envs), dtype=torch.int64, device=self.device)  # times
        self._episode = torch.zeros(num_envs, dtype=torch.int64, device=self.device)  # running or about to begin
        self._oldest = torch.zeros(num_envs, dtype=torch.int64, device=self.device)  # times
        self._environment = torch.arange(num_envs, device=self.device)
        self._powers = (2 ** torch.arange(8, device=self.device)).to(torch.uint8)
        self._now = 0  # frames of each environment that were ever stored
        self._size = 0

    def __len__(self) -> int:
        """Number of transitions that can be sampled."""
        return self._size

    @property
    def stored(self) -> int:
        """Number of frames that were ever stored."""
        return self._now * self.num_envs

    @property
    def bytes_per_transition(self) -> float:
        """Memory taken, per transition."""
        tensors = (*self._frames.values(), *self._last.values(), self._table, self._begin)
        return sum(tensor.nbytes for tensor in tensors) / (self.rows * self.num_envs)

    def add(self, batch: TensorDictBase) -> None:
        """Store consecutive frames.

        Args:
            batch: ``(num_envs, steps)`` with entries under "next". Where it does not go on from the observation at
                which the previous batch ended, that episode ends without being done.

        Raises:
            ValueError: if the batch is longer than the memory, or its active slots are not the first ones.
        """
        if batch.shape[1] > self.rows:
            raise ValueError(
                f"algo.replay_capacity is {self.rows * self.num_envs}: it must hold the {batch.numel()} frames of one "
                "iteration"
            )
        # within a chunk no entry of the rings over episodes is written twice: on a GPU either could come last
        for chunk in batch.split(self.episodes, dim=1):
            self._add(chunk)
        lower = self._lower()
        self._size = int((self._now - lower).sum())

    def sample(self, size: int) -> TensorDict:
        """Independent, uniformly drawn transitions ``(size,)``: ``entries.OBSERVATION``, action and "next".

        Under "next": ``entries.OBSERVATION``, reward, done and terminated, of the team.
        """
        held = self._now - self._lower()
        ends = held.cumsum(0)
        drawn = torch.randint(self._size, (size,), device=self.device)
        environment = torch.searchsorted(ends, drawn, right=True)
        time = self._now - (ends[environment] - drawn)
        return self._transitions(time, environment)

    def state_dict(self) -> dict[str, Any]:
        """All that is stored."""
        return {"tensors": dict(self._tensors()), "now": self._now, "size": self._size}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from what ``state_dict`` returned for a memory of the same sizes."""
        for name, tensor in self._tensors().items():
            tensor.copy_(state["tensors"][name])
        self._now, self._size = state["now"], state["size"]

    # storing

    def _add(self, batch: TensorDictBase) -> None:
        steps = batch.shape[1]
        before, after = self._pack(batch), self._pack(batch.get("next"))
        done = batch["next", entries.DONE].squeeze(-1).T  # (steps, num_envs)
        begins = torch.ones_like(done)
        begins[0] = self._begins({name: column[0] for name, column in before.items()})
        begins[1:] = done[:-1]
        episode = self._episode + done.cumsum(0) - done.long()
        entry = episode % self.episodes
        time = torch.arange(self._now, self._now + steps, device=self.device)
        frames = before | {
            "action": _by_time(batch[entries.ACTION]),
            "reward": _by_time(batch["next", entries.REWARD]),
            "done": done.unsqueeze(-1),
            "terminated": _by_time(batch["next", entries.TERMINATED]),
            "closed": done,
            "episode": entry.to(torch.int32),
        }
        for name, column in frames.items():
            self._frames[name][time % self.rows] = column

        step, environment = begins.nonzero(as_tuple=True)
        self._begin[entry[step, environment], environment] = time[step]
        self._oldest = torch.maximum(self._oldest, self._begin[(episode[-1] + 1) % self.episodes, self._environment])

        newest = done.clone()
        newest[-1] = True
        step, environment = newest.nonzero(as_tuple=True)
        where = (entry[step, environment], environment)
        for name, column in after.items():
            self._last[name][where] = column[step, environment]
        self._table[where] = batch["next", entries.SLOT_DESCRIPTOR][environment, step]

        self._now += steps
        self._episode = episode[-1] + done[-1].long()

    def _begins(self, first: Columns) -> Tensor:
        """Tell whether the new frames, whose first is ``first`` ``(num_envs, ...)``, begin an episode, ``(num_envs,)``.

        Where they do although the newest frame was not done, its episode is ended.
        """
        if not self._now:
            return torch.ones(self.num_envs, dtype=torch.bool, device=self.device)
        closed = self._frames["closed"][(self._now - 1) % self.rows]
        entry = self._episode % self.episodes
        goes_on = torch.ones_like(closed)
        for name, column in first.items():
            same = self._last[name][entry, self._environment] == column
            goes_on &= same.flatten(1).all(-1) if same.ndim > 1 else same
        self._episode = self._episode + (~closed & ~goes_on).long()
        closed |= ~goes_on  # in place, in the ring
        return closed.clone()

    def _pack(self, td: TensorDictBase) -> Columns:
        """An observation ``(num_envs, steps)`` as it is stored, ``(steps, num_envs, ...)``."""
        active = td[entries.SLOT_ACTIVE]
        count = active.sum(-1, dtype=torch.int32)
        if not torch.equal(active, self._active(count)):
            raise ValueError("the active slots of a frame are not its first ones")
        columns = {_name(key): _by_time(td[key]) for key in self._plain}
        edge = torch.nn.functional.pad(_by_time(td[entries.EDGE]), (0, -self.n_slots % 8)).unflatten(
            -1, (self._bytes, 8)
        )
        return columns | {"edge": (edge * self._powers).sum(-1, dtype=torch.uint8), "count": _by_time(count)}

    # reading

    def _lower(self) -> Tensor:
        """Time of the oldest frame that is held of every environment, ``(num_envs,)``."""
        return self._oldest.clamp(min=self._now - self.rows)

    def _transitions(self, time: Tensor, environment: Tensor) -> TensorDict:
        row = time % self.rows
        frames = {name: column[row, environment] for name, column in self._frames.items()}
        entry = frames["episode"].long()
        descriptor = self._table[entry, environment]
        # the newest frame's next observation is still the newest of its episode
        closed = frames["closed"] | (time == self._now - 1)
        following = (time + 1) % self.rows
        after = {
            name: _choose(closed, last[entry, environment], self._frames[name][following, environment])
            for name, last in self._last.items()
        }
        transition = self._unpack(frames, descriptor)
        transition[entries.ACTION] = frames["action"]
        next_transition = self._unpack(after, descriptor)
        next_transition[entries.REWARD] = frames["reward"]
        next_transition[entries.DONE] = frames["done"]
        next_transition[entries.TERMINATED] = frames["terminated"]
        transition["next"] = next_transition
        return transition

    def _unpack(self, columns: Columns, descriptor: Tensor) -> TensorDict:
        """Entries ``entries.OBSERVATION`` of stored observations ``(size, ...)`` with tables ``(size, M, 9)``."""
        td = TensorDict({}, batch_size=[len(descriptor)], device=self.device)
        for key in self._plain:
            td[key] = columns[_name(key)]
        edge = (columns["edge"].unsqueeze(-1) & self._powers).bool()
        active = self._active(columns["count"])
        td[entries.EDGE] = edge.flatten(-2)[..., : self.n_slots]
        td[entries.SLOT_ACTIVE] = active
        td[entries.SLOT_DESCRIPTOR] = torch.where(active.unsqueeze(-1), descriptor, 0.0)
        return td

    def _active(self, count: Tensor) -> Tensor:
        return torch.arange(self.n_slots, device=self.device) < count.unsqueeze(-1)

    # memory

    def _allocate(self, length: int, columns: Mapping[str, tuple[tuple[int, ...], torch.dtype]]) -> Columns:
        lead = (length, self.num_envs)
        return {
            name: torch.empty((*lead, *shape), dtype=dtype, device=self.device)
            for name, (shape, dtype) in columns.items()
        }

    def _tensors(self) -> Columns:
        rings = {f"frames.{name}": tensor for name, tensor in self._frames.items()}
        rings |= {f"last.{name}": tensor for name, tensor in self._last.items()}
        one_by_one = {"table": self._table, "begin": self._begin, "episode": self._episode, "oldest": self._oldest}
        return rings | one_by_one


def _name(key: Key) -> str:
    """Name an entry as its column is."""
    return key if isinstance(key, str) else key[1]


def _by_time(values: Tensor) -> Tensor:
    """``(num_envs, steps, ...)`` to ``(steps, num_envs, ...)``."""
    return values.transpose(0, 1)


def _choose(where: Tensor, one: Tensor, other: Tensor) -> Tensor:
    """``torch.where`` over leading dimensions."""
    return torch.where(where.view(-1, *(1,) * (one.ndim - 1)), one, other)
