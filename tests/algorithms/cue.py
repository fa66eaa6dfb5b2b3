"""A task that only memory solves: every agent is shown a cue of its own in an episode's first step alone.

In the last step, ``DELAY`` steps later, the team is paid the mean over agents of cue times action: 1 at best, and on
average 0 for whoever has forgotten, or remembers another agent's cue.
"""

import torch
from tensordict import TensorDict
from torchrl.data import Binary, Bounded, Composite, Unbounded

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.envs.remembering import RememberingEnv
from softgm_bench.envs.vmas import OBSERVATION

N_AGENTS, DELAY = 2, 3


class CueEnv(RememberingEnv):
    """An observation is the cue, which is -1 or 1 (0 after the first step), and whether an answer is due now."""

    horizon = DELAY + 1
    sizes = Sizes(N_AGENTS, 2, n_features=2)

    def __init__(self, num_envs, seed=0):
        super().__init__(device="cpu", batch_size=(num_envs,))
        agents = (num_envs, N_AGENTS)
        flag = {key: Binary(shape=(num_envs, 1), dtype=torch.bool) for key in ("done", "terminated", "truncated")}
        self.observation_spec = Composite(
            agents=Composite(observation=Unbounded((*agents, 2)), shape=agents),
            is_init=Binary(shape=(num_envs, 1), dtype=torch.bool),
            shape=(num_envs,),
        )
        self.action_spec = Composite(
            agents=Composite(action=Bounded(-1.0, 1.0, (*agents, 2)), shape=agents), shape=(num_envs,)
        )
        self.reward_spec = Unbounded((num_envs, 1))
        self.done_spec = Composite(flag, shape=(num_envs,))
        self.time = torch.zeros(num_envs, dtype=torch.int64)
        self.cue = torch.zeros(agents)
        self.set_seed(seed)

    def _set_seed(self, seed):
        self.generator = torch.Generator().manual_seed(seed)

    def _reset(self, tensordict=None, **kwargs):
        mask = None if tensordict is None else tensordict.get("_reset", None)
        mask = torch.ones_like(self.time, dtype=torch.bool) if mask is None else mask.reshape(-1)
        fresh = torch.randint(0, 2, self.cue.shape, generator=self.generator).float() * 2.0 - 1.0
        self.cue = torch.where(mask.unsqueeze(-1), fresh, self.cue)
        self.time = self.time.masked_fill(mask, 0)
        return self._frame()

    def _step(self, tensordict):
        answers = (self.cue * tensordict[entries.ACTION][..., 0]).mean(-1, keepdim=True)
        reward = torch.where((self.time == DELAY).unsqueeze(-1), answers, 0.0)
        self.time = self.time + 1
        return self._frame().set(entries.REWARD, reward)

    def _frame(self):
        first, due = (self.time == 0).unsqueeze(-1), (self.time == DELAY).unsqueeze(-1)
        shown = torch.stack([self.cue * first, due.float().expand_as(self.cue)], dim=-1)
        over = (self.time > DELAY).unsqueeze(-1)
        flags = {"done": over, "terminated": over.clone(), "truncated": torch.zeros_like(over), "is_init": first}
        td = TensorDict(flags, self.batch_size)
        td["agents"] = TensorDict({OBSERVATION[1]: shown}, self.cue.shape)
        return td
