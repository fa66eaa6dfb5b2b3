"""Trained policies as players of the adapters' environments: arrays in, arrays out, and a memory from step to step."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench.envs import entries, kind_of
from softgm_bench.envs.section_mixture import refuse_mixture
from softgm_bench.episodes import policy
from softgm_bench.episodes.policy import TrainedPolicy
from softgm_bench.errors import UserError

Array = NDArray[Any]
OF_AGENTS = {"position": entries.AGENT_POSITION, "velocity": entries.AGENT_VELOCITY}
OF_AGENTS |= {"previous_action": entries.PREVIOUS_ACTION, "edge": entries.EDGE}
OF_ALL = {"slot_descriptor": entries.SLOT_DESCRIPTOR, "slot_active": entries.SLOT_ACTIVE}
OF_ALL |= {"tip": entries.TIP, "target": entries.TARGET}


class Player:
    """A policy that plays ``parallel_env(..., observation="dict")`` and the Gymnasium environments of its task.

    One player plays one environment, or one vector of them: it holds what its policy remembers of their episodes.
    """

    def __init__(
        self,
        source: str | Path | TrainedPolicy,
        overrides: Sequence[str] = (),
        deterministic: bool = True,
    ) -> None:
        """Take the policy of a run folder, a checkpoint or a policy's file, or one that is loaded already.

        Args:
            source: of one of them.
            overrides: settings to act in instead of the run's, as ``episodes.policy.load`` takes them.
            deterministic: act by the mode of the policy, otherwise by a sample.

        Raises:
            UserError: there is no such policy, or it reads what these environments do not show.
        """
        self.trained = source if isinstance(source, TrainedPolicy) else policy.load(Path(source), overrides=overrides)
        shown = {*entries.OBSERVATION, entries.MEMORY, entries.IS_INIT}
        if not shown.issuperset(self.trained.policy.in_keys):
            raise UserError(f"{self.trained.label} on {self.trained.config.task.name}: it reads what no adapter shows")
        task = self.trained.config.task
        refuse_mixture(task)
        self._sizes = kind_of(task).sizes(task)
        self._exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
        self.begin()

    def begin(self) -> None:
        """Forget everything: episodes begin in all environments, as after their ``reset``."""
        self._memory: Tensor | None = None

    def actions(self, observations: Mapping[str, Mapping[str, Array]]) -> dict[str, Array]:
        """Every agent's action, ``(A,)``, for PettingZoo's observations of one step, of which each is used once."""
        (first, *_), agents = observations.values(), list(observations)
        values: dict[NestedKey, Tensor] = {}
        for name, key in OF_AGENTS.items():
            if name in first:
                values[key] = torch.from_numpy(np.stack([observations[agent][name] for agent in agents])).unsqueeze(0)
        for name, key in OF_ALL.items():
            if name in first:
                values[key] = torch.from_numpy(np.array(first[name])).unsqueeze(0)
        joint = self._act(values, 1, None)
        return dict(zip(agents, joint[0].numpy(), strict=True))

    def joint_actions(self, observations: Array, begins: Array | None = None) -> Array:
        """Joint actions ``(num_envs, N A)`` for Gymnasium's observations ``(num_envs, S)``; or one row for one.

        Args:
            observations: of one step, of which each is used once.
            begins: ``(num_envs,)`` bool, where an episode ended in the step before and the observation is the next
                one's first: ``terminated | truncated`` of ``SoftArmVectorEnv``.
        """
        rows = np.atleast_2d(observations)
        shapes = {key: entries.shape_of(key, self._sizes) for key in entries.OBSERVATION}
        lengths = [math.prod(shape) for shape in shapes.values()]
        if rows.shape[1] != sum(lengths):
            raise ValueError(f"observations have {rows.shape[1]} numbers: the policy's have {sum(lengths)}")
        parts = torch.from_numpy(rows).split(lengths, dim=1)
        values = {key: part.reshape(len(rows), *shapes[key]) for key, part in zip(shapes, parts, strict=True)}
        actions = self._act(values, len(rows), begins).flatten(1).numpy()
        return actions if observations.ndim == 2 else actions[0]

    def _act(self, values: Mapping[NestedKey, Tensor], count: int, begins: Array | None) -> Tensor:
        """Actions ``(count, N, A)`` for an observation's entries; those of slots may be absent where there are none.

        Raises:
            ValueError: an entry has another shape than the policy's task gives it.
        """
        typed: dict[NestedKey, Tensor] = {}
        for key in entries.OBSERVATION:
            shape, dtype = (count, *entries.shape_of(key, self._sizes)), entries.TABLE[key].dtype
            value = values.get(key, torch.zeros(0))
            if value.numel() != math.prod(shape):
                raise ValueError(f"{key} has shape {tuple(value.shape)}: the policy's task has {shape}")
            typed[key] = value.to(dtype).reshape(shape)
        fresh = np.full(count, self._memory is None) if begins is None else np.asarray(begins, dtype=bool)
        typed[entries.IS_INIT] = torch.from_numpy(fresh.copy()).reshape(count, 1)
        frame = entries.frame(typed, [count], self._sizes, torch.device("cpu"))
        if self._memory is not None:
            frame.set(entries.MEMORY, self._memory)
        with torch.no_grad(), set_exploration_type(self._exploration):
            chosen = self.trained.policy(frame)
        self._memory = chosen.get(entries.NEXT_MEMORY, None)
        return chosen[entries.ACTION]
