"""Action values Q(s, a) on any encoder, for the off-policy algorithms.

With x_i = [o_i || g_i || a_i] (own node, embedding, action of agent i):

- independent: Q_i = f_Q(x_i), parameters shared by all agents. It knows of other agents what the encoder passes on,
  and never their actions.
- centralised: Q = f_Q([x_1 || .. || x_N]), one value for the team. BenchMARL's centralised critics concatenate all
  agents' inputs too and share one output. A mean over agents would tell f_Q only the sum of the actions, but the
  sections of an arm cannot be exchanged. Only training has a critic, so its fixed N binds no policy.
"""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from softgm_bench.envs import keys
from softgm_bench.models import graph
from softgm_bench.models.heads import ACTIONS, feedforward, input_keys
from softgm_bench.models.registry import Encoder, build_encoder

ACTION_VALUE = ("agents", "state_action_value")  # (B, N, 1)


@dataclass
class ActionValueConfig:
    """The head f_Q. Values: ``conf/algo``.

    Attributes:
        widths: hidden layers, each followed by tanh.
        asymmetric: the head reads ``keys.PRIVILEGED`` too. Only training has a critic, so execution does not need it.
    """

    widths: list[int]
    asymmetric: bool


class ActionValue(TensorDictModuleBase):
    """Reads ``keys.OBSERVATION`` and ``keys.ACTION``, writes ``ACTION_VALUE`` ``(..., N, 1)``.

    A centralised one writes its only value N times. Privileged channels follow f_Q's other inputs.
    """

    def __init__(
        self,
        encoder: Encoder,
        n_agents: int,
        config: ActionValueConfig,
        centralised: bool,
        n_privileged: int = 0,
    ) -> None:
        """Put f_Q on an encoder."""
        super().__init__()
        self.in_keys, self.out_keys = [*input_keys(n_privileged), keys.ACTION], [ACTION_VALUE]
        self.encoder, self.centralised, self.n_privileged = encoder, centralised, n_privileged
        per_agent = graph.CHANNELS + encoder.out_features + ACTIONS
        in_features = n_agents * per_agent if centralised else per_agent
        self.function = feedforward(in_features + n_privileged, config.widths, 1, last_gain=1.0)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write ``ACTION_VALUE``."""
        own = graph.agent_channels(td, self.encoder.velocity_scale)
        parts = torch.cat([own, self.encoder(td), td.get(keys.ACTION)], dim=-1)
        inputs = parts.flatten(-2).unsqueeze(-2) if self.centralised else parts  # one row for the team, or N
        if self.n_privileged:
            known = td.get(keys.PRIVILEGED).unsqueeze(-2)
            inputs = torch.cat([inputs, known.expand(*inputs.shape[:-1], self.n_privileged)], dim=-1)
        return td.set(ACTION_VALUE, self.function(inputs).expand(*parts.shape[:-1], 1))


def build_action_value(
    encoder_config: Any,
    n_agents: int,
    n_slots: int,
    config: ActionValueConfig,
    centralised: bool,
    n_privileged: int = 0,
) -> ActionValue:
    """A critic of actions with an encoder of its own, for N agents and M slots.

    With ``n_privileged`` above 0 its head reads ``keys.PRIVILEGED`` too.
    """
    encoder = build_encoder(encoder_config, n_agents, n_slots)
    return ActionValue(encoder, n_agents, config, centralised, n_privileged)
