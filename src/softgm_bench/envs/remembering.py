"""What environments do for policies that remember: their steps hand a policy's memory on, and say where episodes begin.

These are TorchRL's conventions for recurrent policies without its transforms, which compute every environment anew at
a partial reset: a policy reads ``entries.MEMORY`` and writes the next one under ``next``; where ``entries.IS_INIT`` is
true it begins with zeros, whatever it finds.
"""

from tensordict import TensorDictBase
from torchrl.envs import EnvBase

from softgm_bench.envs import entries


class RememberingEnv(EnvBase):
    """An environment whose frames have ``entries.IS_INIT``, (B, 1): true in a reset's frame and in no other.

    What a policy writes to ``("next", entries.MEMORY)`` is ``entries.MEMORY`` of the frame that it is shown next, in
    ``rollout``, in ``step_and_maybe_reset`` and in what is built on them. It is no part of the observation's spec.
    """

    def _post_step_mdp_hooks(
        self, tensordict: TensorDictBase, tensordict_: TensorDictBase
    ) -> tuple[TensorDictBase, TensorDictBase]:
        memory = tensordict.get(entries.NEXT_MEMORY, None)
        if memory is not None:
            tensordict_.set(entries.MEMORY, memory)
        return tensordict, tensordict_
