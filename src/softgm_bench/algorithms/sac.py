"""Soft actor-critic for a team: ISAC and, with centralised critics, MASAC.

BenchMARL's semantics: one actor and one temperature for all agents; each agent's target holds its own entropy, also
where the critics are centralised. Their common value then learns the mean over agents of the targets.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.objectives import SACLoss

from softgm_bench.algorithms.off_policy import Explorer, OffPolicy, OffPolicyConfig
from softgm_bench.algorithms.registry import register_algorithm
from softgm_bench.envs import SoftArmEnv
from softgm_bench.models.action_value import ACTION_VALUE, build_action_value
from softgm_bench.models.heads import ACTIONS, ActorConfig, build_actor

CRITICS = 2  # the smaller value is believed


@dataclass
class SACConfig(OffPolicyConfig):
    """Hyperparameters; values and meaning in ``conf/algo/isac.yaml``."""

    alpha_lr: float
    initial_alpha: float
    target_entropy: float | None
    actor: ActorConfig


class _Loss(SACLoss):
    """TorchRL's loss with its own way through the critics: one after another, keeping of each what the loss reads.

    TorchRL's way (``deactivate_vmap``) copies the whole transition through a general imitation of vmap and takes the
    networks apart and together again for each critic: a quarter of a gradient step of small networks.
    """

    def _make_vmap(self) -> None:
        self._vmap_qnetworkN0 = self._values
        # where the network looks for each of its parameters
        self._places = []
        for name in self.qvalue_network_params.keys(True, True):
            *path, last = (name,) if isinstance(name, str) else name
            self._places.append((self.qvalue_network.get_submodule(".".join(path))._parameters, last))
        self._meta = [holder[name] for holder, name in self._places]

    def _values(self, td: TensorDictBase, parameters: TensorDictBase) -> TensorDict:
        """``ACTION_VALUE`` of every critic ``(critics, B, N, 1)``; ``parameters`` has the critics in front too."""
        values = []
        try:
            for of_one in zip(*(leaf.unbind(0) for leaf in parameters.values(True, True)), strict=True):
                self._compute_with(of_one)
                values.append(self.qvalue_network(td.copy()).get(ACTION_VALUE))
        finally:
            self._compute_with(self._meta)
        return TensorDict({ACTION_VALUE: torch.stack(values)}, [len(values), *td.batch_size])

    def _compute_with(self, parameters: Sequence[Any]) -> None:
        for (holder, name), parameter in zip(self._places, parameters, strict=True):
            holder[name] = parameter


@register_algorithm("isac", "masac", config=SACConfig)
class SAC(OffPolicy):
    """TorchRL's ``SACLoss`` with two critics and a learnt temperature.

    The loss draws its actions by ``rsample_and_log_prob``, which scores the sample before it is rounded by the tanh.
    """

    reported = ("loss_actor", "loss_qvalue", "loss_alpha", "alpha", "entropy", "q_mean")

    def __init__(self, config: SACConfig, model_config: Any, env: SoftArmEnv, oracle: bool = False) -> None:
        """Build networks, loss and optimisers for an environment's sizes and device.

        An asymmetric critic, and actor and critic of an oracle, read ``keys.PRIVILEGED``.
        """
        sizes = (model_config, env.n_agents, env.n_slots)
        known_to_actor = env.n_privileged if oracle else 0
        known_to_critic = env.n_privileged if oracle or config.critic.asymmetric else 0
        actor = build_actor(*sizes, config.actor, known_to_actor).to(env.device)
        # two modules: SACLoss would draw a second critic's weights from a box around the first one's
        critics = [
            build_action_value(*sizes, config.critic, config.centralised, known_to_critic).to(env.device)
            for _ in range(CRITICS)
        ]
        loss = _Loss(
            actor,
            critics,
            num_qvalue_nets=CRITICS,
            loss_function="l2",
            alpha_init=config.initial_alpha,
            # of one agent; "auto" would take it from a spec and be wrong without the agents' dimension
            target_entropy=-float(ACTIONS) if config.target_entropy is None else config.target_entropy,
            delay_qvalue=True,
        )
        loss.set_keys(state_action_value=ACTION_VALUE)
        super().__init__(config, env, Explorer(actor), loss, known_to_critic)
        critic_parameters = list(loss.qvalue_network_params.parameters())
        self._optimize("actor", list(actor.parameters()), config.actor_lr)
        self._optimize("critic", critic_parameters, config.critic_lr)
        self._optimize("alpha", [loss.log_alpha], config.alpha_lr)
        _ = loss.target_entropy  # becomes a part of the loss's state when it is first read

    def _metrics(self, losses: TensorDictBase) -> list[Tensor]:
        # the actor's loss is the mean of alpha log pi - Q
        q_mean = -losses["alpha"] * losses["entropy"] - losses["loss_actor"]
        return [*(losses[name] for name in self.reported[:-1]), q_mean]
