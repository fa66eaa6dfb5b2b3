"""A replay buffer for observations that are a plain vector per agent: whole transitions side by side."""

from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase

from softgm_bench.envs import entries
from softgm_bench.envs.vmas import OBSERVATION

STORED = (
    OBSERVATION,
    entries.ACTION,
    ("next", OBSERVATION),
    ("next", entries.REWARD),
    ("next", entries.DONE),
    ("next", entries.TERMINATED),
)


class VectorReplayBuffer:
    """A ring of the newest ``capacity`` transitions, with what ``ReplayBuffer`` offers.

    TorchRL's buffers do the same; a sample of 128 takes them three times as long.

    Attributes:
        stored: number of frames that were ever stored.
    """

    def __init__(self, capacity: int, device: torch.device | str) -> None:
        """Take memory for nothing yet."""
        self.capacity, self.device = capacity, torch.device(device)
        self.stored = 0
        self._ring: TensorDictBase | None = None

    def __len__(self) -> int:
        """Number of transitions that can be sampled."""
        return min(self.stored, self.capacity)

    def add(self, batch: TensorDictBase) -> None:
        """Store frames ``(num_envs, steps)`` with entries under "next".

        Raises:
            ValueError: if they are more than the memory holds.
        """
        if batch.numel() > self.capacity:
            raise ValueError(
                f"algo.replay_capacity is {self.capacity}: it must hold the {batch.numel()} frames of one iteration"
            )
        frames = batch.select(*STORED).reshape(-1)
        if self._ring is None:
            self._ring = frames.new_empty((self.capacity,))  # a CPU's memory is provided when it is written
        where = torch.arange(self.stored, self.stored + len(frames), device=self.device) % self.capacity
        self._ring[where] = frames
        self.stored += len(frames)

    def sample(self, size: int) -> TensorDictBase:
        """Independent, uniformly drawn transitions ``(size,)``: ``STORED``."""
        assert self._ring is not None
        return self._ring[torch.randint(len(self), (size,), device=self.device)]

    def state_dict(self) -> dict[str, Any]:
        """All that is stored."""
        held = None if self._ring is None else self._ring[: len(self)].clone().to_dict()
        return {"held": held, "stored": self.stored}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from what ``state_dict`` returned for a memory of the same capacity."""
        self.stored = state["stored"]
        if state["held"] is not None:
            held = TensorDict(state["held"], [len(self)], device=self.device)
            self._ring = held.new_empty((self.capacity,))
            self._ring[: len(self)] = held
