"""Action values Q(s, a) on any encoder, for the off-policy algorithms.

- independent: Q_i = f_Q([o_i || g_i || a_i]) (own node, embedding, action of agent i), parameters shared by all
  agents. It knows of other agents what the encoder passes on, and never their actions.
- centralised: Q = f_Q(e), one value for the team, e the model's embedding of all agents' observations and actions side
  by side (``TeamEncoder``). BenchMARL's centralised critics concatenate all agents' inputs too and share one output. A
  mean over agents would tell f_Q only the sum of the actions, but the sections of an arm cannot be exchanged. Only
  training has a critic, so its fixed N binds no policy.
"""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models.heads import feedforward, input_keys, privileged
from softgm_bench.models.mlp import MLPConfig
from softgm_bench.models.registry import Encoder, TeamEncoder, build_encoder, build_team_encoder

ACTION_VALUE = ("agents", "state_action_value")  # (B, N, 1)


@dataclass
class ActionValueConfig:
    """The head f_Q. Values: ``conf/algo``.

    Attributes:
        widths: hidden layers, each followed by tanh.
        mlp: the critic's encoder is this MLP, whatever the actor's; None: the same model as the actor's.
        asymmetric: the head reads ``entries.PRIVILEGED`` too. Only training has a critic; execution does not need it.
        embedding_norm: the encoder's embedding is normalised (paper: no); see ``models.registry.Normalised``.
        hidden_norm: what enters each tanh of the head is normalised (paper: no); see ``heads.feedforward``.
    """

    widths: list[int]
    mlp: MLPConfig | None
    asymmetric: bool
    embedding_norm: bool
    hidden_norm: bool


class AgentActionValue(TensorDictModuleBase):
    """Reads ``entries.OBSERVATION`` and ``entries.ACTION``, writes values ``ACTION_VALUE`` ``(..., N, 1)``."""

    def __init__(self, encoder: Encoder, actions: int, config: ActionValueConfig, n_privileged: int = 0) -> None:
        """Put f_Q on an encoder; ``actions`` is A, the numbers in one agent's action."""
        super().__init__()
        self.in_keys, self.out_keys = [*input_keys(encoder, n_privileged), entries.ACTION], [ACTION_VALUE]
        self.encoder, self.n_privileged = encoder, n_privileged
        in_features = encoder.own_features + encoder.out_features + actions + n_privileged
        self.function = feedforward(in_features, config.widths, 1, 1.0, config.hidden_norm)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write ``ACTION_VALUE``."""
        own = self.encoder.own(td)
        known = privileged(td, self.n_privileged, own).unsqueeze(-2).expand(*own.shape[:-1], self.n_privileged)
        inputs = torch.cat([own, self.encoder(td), td.get(entries.ACTION), known], dim=-1)
        return td.set(ACTION_VALUE, self.function(inputs))


class TeamActionValue(TensorDictModuleBase):
    """Reads ``entries.OBSERVATION`` and ``entries.ACTION``, writes a value N times ``(..., N, 1)``."""

    def __init__(self, encoder: TeamEncoder, n_agents: int, config: ActionValueConfig, n_privileged: int = 0) -> None:
        """Put f_Q on an encoder whose further inputs are the actions, then the privileged channels."""
        super().__init__()
        self.in_keys, self.out_keys = [*input_keys(encoder, n_privileged), entries.ACTION], [ACTION_VALUE]
        self.encoder, self.n_agents, self.n_privileged = encoder, n_agents, n_privileged
        self.function = feedforward(encoder.out_features, config.widths, 1, 1.0, config.hidden_norm)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write ``ACTION_VALUE``."""
        action = td.get(entries.ACTION)
        further = torch.cat([action.flatten(-2), privileged(td, self.n_privileged, action)], dim=-1)
        value = self.function(self.encoder(td, further)).unsqueeze(-2)
        return td.set(ACTION_VALUE, value.expand(*value.shape[:-2], self.n_agents, 1))


def build_action_value(
    encoder_config: Any,
    sizes: Sizes,
    config: ActionValueConfig,
    centralised: bool,
    n_privileged: int = 0,
) -> AgentActionValue | TeamActionValue:
    """Build a critic of actions with an encoder of its own, for an environment's sizes.

    With ``n_privileged`` above 0 it reads ``entries.PRIVILEGED`` too.
    """
    encoder_config = config.mlp or encoder_config
    norm = config.embedding_norm
    if not centralised:
        return AgentActionValue(build_encoder(encoder_config, sizes, norm), sizes.action, config, n_privileged)
    encoder = build_team_encoder(encoder_config, sizes, sizes.n_agents * sizes.action + n_privileged, norm)
    return TeamActionValue(encoder, sizes.n_agents, config, n_privileged)
