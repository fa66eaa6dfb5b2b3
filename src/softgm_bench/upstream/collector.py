"""Frames from the training environments, and what of their collection a checkpoint needs."""

from collections.abc import Mapping
from typing import Any

from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType


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
