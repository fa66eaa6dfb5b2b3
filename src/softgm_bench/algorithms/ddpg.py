"""Deep deterministic policy gradient for a team: IDDPG and, with a centralised critic, MADDPG.

BenchMARL's semantics: one actor for all agents; in MADDPG's actor loss every action is the current policy's, so that
the actor climbs the team's Q in all of them at once.
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.objectives import DDPGLoss

from softgm_bench.algorithms.off_policy import Explorer, OffPolicy, OffPolicyConfig
from softgm_bench.algorithms.registry import register_algorithm
from softgm_bench.envs import entries
from softgm_bench.envs.interface import Environment, Sizes
from softgm_bench.models.action_value import ACTION_VALUE, build_action_value
from softgm_bench.models.heads import build_head
from softgm_bench.models.memory import MemoryConfig
from softgm_bench.models.mirror import check_mirror
from softgm_bench.models.registry import Encoder, build_encoder


@dataclass
class DeterministicActorConfig:
    """The policy's head. Values: ``conf/algo/iddpg.yaml``.

    Attributes:
        widths: hidden layers, each followed by tanh.
        embedding_norm: g_i is normalised before it enters the head (paper: no); see ``models.registry.Normalised``.
        hidden_norm: what enters each tanh of the head is normalised (paper: no); see ``models.heads.feedforward``.
        relative_points: an oracle's actor is told the privileged points relative to each agent too.
        memory: None; PPO alone trains recurrent actors.
        mirror: the way in which the action commutes with the mirror in the plane y = 0, ``average`` or ``canonical``
            (see ``models.mirror``); None: it does not (paper).
    """

    widths: list[int]
    embedding_norm: bool
    hidden_norm: bool
    relative_points: bool
    memory: MemoryConfig | None
    mirror: str | None

    def __post_init__(self) -> None:
        """Refuse values that give no policy.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        check_mirror(self.mirror)


@dataclass
class DDPGConfig(OffPolicyConfig):
    """Hyperparameters; values and meaning in ``conf/algo/iddpg.yaml``."""

    target_actor: bool
    initial_sigma: float
    final_sigma: float
    sigma_frames: int
    noise_correlation: float
    actor: DeterministicActorConfig


class DeterministicPolicy(TensorDictModuleBase):
    """Writes ``entries.ACTION`` = tanh(f([o_i || g_i])), ``(..., N, 2)``; parameters shared by all agents."""

    def __init__(self, encoder: Encoder, sizes: Sizes, config: DeterministicActorConfig, n_privileged: int = 0) -> None:
        """Put the policy's head on an encoder."""
        super().__init__()
        self.head = build_head(encoder, sizes, config, sizes.action, n_privileged)
        self.in_keys, self.out_keys = self.head.in_keys, [entries.ACTION]

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write ``entries.ACTION``."""
        return td.set(entries.ACTION, self.head(td).tanh())


class NoisyExplorer(Explorer):
    """Adds Gaussian noise that may be correlated in time, and cuts the action to [-1, 1].

    With correlation rho and the standard deviation sigma, ``a_t = (1 - rho) mu_t + rho a_{t-1} + sqrt(1 - rho^2) sigma
    xi_t``. While mu is constant, a_t - mu is the Ornstein-Uhlenbeck process in discrete time, whose standard deviation
    is sigma whatever rho. It needs no memory, because the previous action is observed.

    Attributes:
        sigma: standard deviation of the noise.
    """

    def __init__(self, actor: TensorDictModuleBase, actions: int, config: DDPGConfig, frames: int) -> None:
        """Explore around ``actor``; arguments as of ``Explorer``."""
        self.correlation = config.noise_correlation
        super().__init__(actor, actions, config, frames)

    def schedule(self, frames: int) -> None:
        """Let the noise fall linearly too."""
        super().schedule(frames)
        config = self.config
        progress = min(1.0, frames / config.sigma_frames)
        self.sigma = config.initial_sigma + progress * (config.final_sigma - config.initial_sigma)

    def explore(self, action: Tensor, td: TensorDictBase) -> Tensor:
        """The actor's action with noise."""
        if self.correlation:
            action = torch.lerp(action, td.get(entries.PREVIOUS_ACTION), self.correlation)
        fresh = math.sqrt(1.0 - self.correlation**2) * self.sigma
        return (action + fresh * torch.randn_like(action)).clamp(-1.0, 1.0)


@register_algorithm("iddpg", "maddpg", config=DDPGConfig)
class DDPG(OffPolicy):
    """TorchRL's ``DDPGLoss``."""

    policy: NoisyExplorer
    reported = ("loss_actor", "loss_value", "q_mean", "target_mean")

    @staticmethod
    def build_policy(
        config: DDPGConfig, model_config: Any, sizes: Sizes, oracle: bool = False, frames: int = 0
    ) -> NoisyExplorer:
        """Build the actor alone; see ``algorithms.build_policy``."""
        known = sizes.n_privileged if oracle else 0
        encoder = build_encoder(model_config, sizes, config.actor.embedding_norm)
        actor = DeterministicPolicy(encoder, sizes, config.actor, known)
        return NoisyExplorer(actor, sizes.action, config, frames)

    def __init__(self, config: DDPGConfig, model_config: Any, env: Environment, oracle: bool = False) -> None:
        """Build networks, loss and optimisers for an environment's sizes and device.

        An asymmetric critic, and actor and critic of an oracle, read ``entries.PRIVILEGED``.
        """
        sizes = env.sizes
        known = sizes.n_privileged if oracle or config.critic.asymmetric else 0
        policy = self.build_policy(config, model_config, sizes, oracle).to(env.device)
        critic = build_action_value(model_config, sizes, config.critic, config.centralised, known).to(env.device)
        loss = DDPGLoss(policy.actor, critic, loss_function="l2", delay_actor=config.target_actor, delay_value=True)
        loss.set_keys(state_action_value=ACTION_VALUE)
        super().__init__(config, env, policy, loss, known)
        self._optimize("actor", list(policy.actor.parameters()), config.actor_lr)
        self._optimize("critic", list(critic.parameters()), config.critic_lr)

    def _metrics(self, losses: TensorDictBase) -> list[Tensor]:
        loss_actor = losses["loss_actor"]
        return [loss_actor, losses["loss_value"], -loss_actor, losses["target_value"].mean()]
