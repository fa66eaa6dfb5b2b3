"""Frames from the training environments, and what of their collection a checkpoint needs."""

from collections.abc import Iterator, Mapping
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench.upstream.graphs import Recorded, copy_into, leaves


class FrameCollector(Collector):
    """TorchRL's collector, without end, whose place between two batches can be kept and returned to.

    Between two batches it holds what the policy will be shown next. That cannot be had from the environment again:
    noise in it is drawn already, and to ask the environment means to reset it.
    """

    def __init__(self, env: EnvBase, policy: TensorDictModuleBase, frames_per_batch: int) -> None:
        """Reset the environment; batches are sampled from the policy when they are asked for.

        Args:
            env: of which every batch takes equally many consecutive steps.
            policy: explores.
            frames_per_batch: over all environments.
        """
        super().__init__(
            env,
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=-1,
            exploration_type=ExplorationType.RANDOM,
            auto_register_policy_transforms=False,
            track_traj_ids=False,  # nobody reads them, and counting them would wait for the device at every step
        )

    def shown(self) -> dict[str, Any]:
        """A copy of what the policy will be shown next; tensors by name, nested."""
        return self._carrier.clone().to_dict()

    def show(self, frame: Mapping[str, Any]) -> None:
        """Resume from what ``shown`` returned; the environment must be put where it was then, too."""
        self._carrier.update(TensorDict(dict(frame), self._carrier.batch_size, device=self._carrier.device))


class MixtureCollector:
    """Collectors by name, which are asked in turn; a batch of each together is a batch of the mixture."""

    def __init__(self, collectors: Mapping[str, FrameCollector]) -> None:
        """Take collectors that nobody else asks."""
        self._collectors = dict(collectors)

    def __iter__(self) -> Iterator[tuple[TensorDictBase, ...]]:
        """Collect without end, a batch of each collector in their order."""
        return zip(*self._collectors.values(), strict=True)

    def shown(self) -> dict[str, Any]:
        """A copy of what policies will be shown next, by the collectors' names."""
        return {name: collector.shown() for name, collector in self._collectors.items()}

    def show(self, frames: Mapping[str, Any]) -> None:
        """Resume from what ``shown`` returned; the environments must be put where they were then, too."""
        for name, collector in self._collectors.items():
            collector.show(frames[name])

    def shutdown(self) -> None:
        """Expect no more batches."""
        for collector in self._collectors.values():
            collector.shutdown()


class RecordingCollector(FrameCollector):
    """``FrameCollector`` whose step of policy and environment is recorded once as a CUDA graph and replayed.

    The first batch is collected without a graph and says what the frames look like. The environment has, beside what
    an ``EnvBase`` has, ``in_place``, ``tensors`` and ``generators`` (see ``SoftArmEnv``); the policy is a function of
    its parameters and its input, and explores by the device's default generator.
    """

    _carrier: TensorDictBase  # what the policy is shown next

    def __init__(self, env: Any, policy: TensorDictModuleBase, frames_per_batch: int) -> None:
        """Arguments as of ``FrameCollector``."""
        super().__init__(env, policy, frames_per_batch)
        self._batch: Any = None  # (num_envs, steps)
        self._time = torch.zeros(1, dtype=torch.int64, device=env.device)  # of the frame to be collected
        self._advance = Recorded(self._step, self._changed, env.device, "collection", env.generators())

    def show(self, frame: Mapping[str, Any]) -> None:
        """Resume from what ``shown`` returned."""
        super().show(frame)
        self._batch = None
        self._advance.forget()

    def rollout(self) -> TensorDictBase:
        """Collect a batch ``(num_envs, steps)``, which the next one overwrites."""
        if self._advance.failed or self._batch is None:
            self._batch = super().rollout()
            self._carrier = self._carrier.clone()
            return self._batch
        self._time.zero_()
        for _ in range(self._batch.shape[1]):
            self._advance()
        return self._batch

    @torch.no_grad()
    def _step(self) -> None:
        """Collect one frame, with every tensor that changes changed in place."""
        with set_exploration_type(ExplorationType.RANDOM), self.env.in_place():
            frame, following = self.env.step_and_maybe_reset(self.policy(self._carrier.copy()))
        for column, value in zip(leaves(self._batch), leaves(frame), strict=True):
            column.index_copy_(1, self._time, value.unsqueeze(1))
        self._time.add_(1).remainder_(self._batch.shape[1])
        copy_into(leaves(self._carrier), leaves(following))

    def _changed(self) -> list[Tensor]:
        return [self._time, *leaves(self._carrier), *self.env.tensors()]
