"""An environment whose episodes are known in advance: environment i ends after ``lengths[i]`` steps."""

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase

from softgm_bench.envs import entries

N_AGENTS = 2


class CountingEnv(EnvBase):
    """Every step gives reward 1 and moves the tip by 0.5; an even environment ends in success, an odd one diverges."""

    def __init__(self, lengths):
        self.lengths = torch.tensor(lengths)
        super().__init__(device="cpu", batch_size=(len(lengths),))
        batch = self.batch_size
        self.observation_spec = Composite({entries.TIP: Unbounded((*batch, 3))}, shape=batch)
        self.action_spec = Composite(
            agents=Composite(action=Bounded(-1.0, 1.0, (*batch, N_AGENTS, 2)), shape=batch), shape=batch
        )
        self.reward_spec = Composite(reward=Unbounded((*batch, 1)), shape=batch)
        self.rng_seed = None
        self.n_seen = []

    def _set_seed(self, seed):
        self.rng_seed = seed

    def _reset(self, tensordict=None):
        self.count = torch.zeros(self.batch_size, dtype=torch.int64)
        return TensorDict({entries.TIP: torch.zeros(*self.batch_size, 3)}, self.batch_size)

    def _step(self, tensordict):
        self.count += 1
        done = (self.count >= self.lengths).unsqueeze(-1)
        even = (torch.arange(len(self.lengths)) % 2 == 0).unsqueeze(-1)
        one = torch.ones(*self.batch_size, 1)
        action = tensordict[entries.ACTION]
        return TensorDict(
            {
                entries.TIP: torch.zeros(*self.batch_size, 3),
                entries.REWARD: one,
                entries.DONE: done,
                entries.TERMINATED: done,
                "info": {
                    "success": done & even,
                    "diverged": done & ~even,
                    "distance": self.count.unsqueeze(-1).float(),
                    "tip_step": 0.5 * one,
                    "torque_per_agent": action.norm(dim=-1).mean(-1, keepdim=True),
                    "torque_joint": action.flatten(1).norm(dim=-1, keepdim=True),
                },
            },
            self.batch_size,
        )
