"""Soft actor-critic for a team: ISAC and, with centralised critics, MASAC.

BenchMARL's semantics: one actor and one temperature for all agents; each agent's target holds its own entropy, also
where the critics are centralised. Their common value then learns the mean over agents of the targets.
"""

from dataclasses import dataclass
from typing import Any

from tensordict import TensorDictBase
from torch import Tensor

from softgm_bench.algorithms.off_policy import Explorer, OffPolicy, OffPolicyConfig
from softgm_bench.algorithms.registry import register_algorithm
from softgm_bench.envs.interface import Environment, Sizes
from softgm_bench.models.action_value import ACTION_VALUE, build_action_value
from softgm_bench.models.heads import ActorConfig, build_actor
from softgm_bench.upstream.sac_loss import SequentialSACLoss

CRITICS = 2  # the smaller value is believed


@dataclass
class SACConfig(OffPolicyConfig):
    """Hyperparameters; values and meaning in ``conf/algo/isac.yaml``."""

    alpha_lr: float
    initial_alpha: float
    target_entropy: float | None
    actor: ActorConfig


@register_algorithm("isac", "masac", config=SACConfig)
class SAC(OffPolicy):
    """TorchRL's ``SACLoss`` with two critics and a learnt temperature.

    The loss draws its actions by ``rsample_and_log_prob``, which scores the sample before it is rounded by the tanh.
    """

    reported = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", "q_mean")

    @staticmethod
    def build_policy(
        config: SACConfig, model_config: Any, sizes: Sizes, oracle: bool = False, frames: int = 0
    ) -> Explorer:
        """Build the actor alone; see ``algorithms.build_policy``."""
        actor = build_actor(model_config, sizes, config.actor, sizes.n_privileged if oracle else 0)
        return Explorer(actor, sizes.action, config, frames)

    def __init__(self, config: SACConfig, model_config: Any, env: Environment, oracle: bool = False) -> None:
        """Build networks, loss and optimisers for an environment's sizes and device.

        An asymmetric critic, and actor and critic of an oracle, read ``entries.PRIVILEGED``.
        """
        sizes = env.sizes
        known = sizes.n_privileged if oracle or config.critic.asymmetric else 0
        policy = self.build_policy(config, model_config, sizes, oracle).to(env.device)
        # two modules: SACLoss would draw a second critic's weights from a box around the first one's
        critics = [
            build_action_value(model_config, sizes, config.critic, config.centralised, known).to(env.device)
            for _ in range(CRITICS)
        ]
        loss = SequentialSACLoss(
            policy.actor,
            critics,
            num_qvalue_nets=CRITICS,
            loss_function="l2",
            alpha_init=config.initial_alpha,
            # of one agent; "auto" would take it from a spec and be wrong without the agents' dimension
            target_entropy=-float(sizes.action) if config.target_entropy is None else config.target_entropy,
            delay_qvalue=True,
        )
        loss.set_keys(state_action_value=ACTION_VALUE)
        super().__init__(config, env, policy, loss, known)
        critic_parameters = list(loss.qvalue_network_params.parameters())
        self._optimize("actor", list(policy.actor.parameters()), config.actor_lr)
        self._optimize("critic", critic_parameters, config.critic_lr)
        self._optimize("alpha", [loss.log_alpha], config.alpha_lr)
        _ = loss.target_entropy  # becomes a part of the loss's state when it is first read

    def _metrics(self, losses: TensorDictBase) -> list[Tensor]:
        # the actor's loss is the mean of alpha log pi - Q
        q_mean = -losses["alpha"] * losses["entropy"] - losses["loss_actor"]
        return [*(losses[name] for name in self.reported[:-1]), q_mean]
