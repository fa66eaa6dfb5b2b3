"""Proximal policy optimisation for a team: one reward and one state value, one probability ratio per agent."""

from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.objectives import ClipPPOLoss
from torchrl.objectives.value import GAE

from softgm_bench.envs import SoftArmEnv, keys
from softgm_bench.models.heads import STATE_VALUE, ActorConfig, ValueConfig, build_actor, build_value

ADVANTAGE, VALUE_TARGET = "advantage", "value_target"
# What an update reads of a frame; everything else stays out of the minibatches.
TRAINED_ON = (*keys.OBSERVATION, keys.ACTION, keys.LOG_PROB, ADVANTAGE, VALUE_TARGET)
REPORTED = ("loss_objective", "loss_critic", "loss_entropy", "entropy", "kl_approx", "clip_fraction")
LR_MARGIN, LR_FACTOR = 1.5, 1.2  # of the actor's learning rate's adaptation to ``target_kl``


@dataclass
class PPOConfig:
    """Hyperparameters; values and meaning in ``conf/algo/softgm.yaml``."""

    name: str
    clip_epsilon: float
    gamma: float
    gae_lambda: float
    entropy_coeff: float
    critic_coeff: float
    max_grad_norm: float
    actor_lr: float
    critic_lr: float
    target_kl: float | None
    epochs: int
    minibatch_size: int
    normalize_advantage: bool
    advantage_clip: float | None
    actor: ActorConfig
    critic: ValueConfig

    def __post_init__(self) -> None:
        """Refuse values that PPO cannot work with.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        for name in ("epochs", "minibatch_size"):
            if getattr(self, name) < 1:
                raise ValueError(f"algo.{name} is {getattr(self, name)}: it must be at least 1")
        for name in ("clip_epsilon", "max_grad_norm", "actor_lr", "critic_lr"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"algo.{name} is {getattr(self, name)}: it must be above 0")
        for name in ("target_kl", "advantage_clip"):
            value = getattr(self, name)
            if value is not None and not value > 0.0:
                raise ValueError(f"algo.{name} is {value}: it must be above 0, or null")
        for name in ("gamma", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"algo.{name} is {getattr(self, name)}: it must lie between 0 and 1")
        for name in ("entropy_coeff", "critic_coeff"):
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"algo.{name} is {getattr(self, name)}: it must not be negative")


class PPO:
    """TorchRL's ``ClipPPOLoss`` and ``GAE`` with an optimiser each for actor and critic.

    Attributes:
        policy: what the collector and the evaluation call; shares its parameters with the loss.
    """

    def __init__(self, config: PPOConfig, model_config: Any, env: SoftArmEnv) -> None:
        """Build networks, loss and optimisers for an environment's sizes and device."""
        self.config = config
        self.policy = build_actor(model_config, env.n_agents, env.n_slots, config.actor).to(env.device)
        value = build_value(model_config, env.n_agents, env.n_slots, config.critic).to(env.device)
        self.loss = ClipPPOLoss(
            self.policy,
            value,
            clip_epsilon=config.clip_epsilon,
            entropy_coeff=config.entropy_coeff,
            critic_coeff=config.critic_coeff,
            loss_critic_type="l2",
            normalize_advantage=False,  # done once an iteration, over all of its frames
        )
        self.loss.set_keys(action=keys.ACTION, sample_log_prob=keys.LOG_PROB, value=STATE_VALUE)
        # vmap over (now, next) would forbid the encoder's data-dependent shapes
        self.advantage = GAE(
            gamma=config.gamma, lmbda=config.gae_lambda, value_network=value, deactivate_vmap=True, average_gae=False
        )
        self._actor_parameters = list(self.policy.parameters())
        self._critic_parameters = list(value.parameters())
        self.actor_optimizer = torch.optim.Adam(self._actor_parameters, lr=config.actor_lr, eps=1e-5)
        self.critic_optimizer = torch.optim.Adam(self._critic_parameters, lr=config.critic_lr, eps=1e-5)

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Improve actor and critic on fresh frames.

        Args:
            batch: ``(num_envs, steps)`` consecutive frames of the current policy.

        Returns:
            Means over all minibatches of losses, entropy, KL divergence, clip fraction and gradient norms.
        """
        frames = self.prepare(batch)
        totals, counts = zip(*(self._epoch(frames) for _ in range(self.config.epochs)), strict=True)
        names = list(totals[0])
        # the only look at results: a GPU works through all minibatches without being waited for
        read = torch.stack([torch.stack([total[name] for name in names]) for total in totals]).tolist()
        epochs = [
            {name: value / count for name, value in zip(names, values, strict=True)}
            for values, count in zip(read, counts, strict=True)
        ]
        if self.config.target_kl is not None:
            self._adapt_actor_lr(epochs[-1]["kl_approx"], self.config.target_kl)
        means = {name: sum(epoch[name] for epoch in epochs) / len(epochs) for name in names}
        return means | {"actor_lr": self.actor_optimizer.param_groups[0]["lr"]}

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Estimate advantages and value targets, and flatten to frames ``(num_envs * steps,)``.

        The team's advantage is given to every agent, ``(frames, N, 1)``: here and nowhere else.
        """
        with torch.no_grad():
            batch = self.advantage(batch)
        frames = batch.select(*TRAINED_ON).reshape(-1)
        advantage = frames.get(ADVANTAGE)
        if self.config.normalize_advantage:
            advantage = _standardised(advantage)
        if self.config.advantage_clip is not None:
            # a few successes among thousands of frames would otherwise leave nothing of all the other frames' say
            limit = self.config.advantage_clip
            advantage = advantage.clamp(-limit, limit)
            if self.config.normalize_advantage:
                advantage = _standardised(advantage)
        n_agents = frames.get(keys.LOG_PROB).shape[-1]
        return frames.set(ADVANTAGE, advantage.unsqueeze(-2).expand(-1, n_agents, 1))

    def _epoch(self, frames: TensorDictBase) -> tuple[dict[str, Tensor], int]:
        """Pass once over all frames in random minibatches; sums over the minibatches, and how many there were."""
        totals: dict[str, Tensor] = {}
        count, size = 0, self.config.minibatch_size
        for chosen in torch.randperm(len(frames), device=frames.device).split(size):
            # a rest much smaller than a minibatch would weigh its few frames too much
            if 2 * len(chosen) >= min(size, len(frames)):
                for name, value in self._step(frames[chosen]).items():
                    totals[name] = totals.get(name, torch.zeros_like(value)) + value
                count += 1
        return totals, count

    def _adapt_actor_lr(self, kl: float, target: float) -> None:
        """Keep the policy's change per update near ``target``, the mean KL divergence over the last epoch.

        With a constant step the change grows as sigma shrinks, until updates undo each other. ``actor_lr`` is the
        upper bound: above it, learning was slower even where the divergence was small.
        """
        for group in self.actor_optimizer.param_groups:
            if kl > LR_MARGIN * target:
                group["lr"] /= LR_FACTOR
            elif kl < target / LR_MARGIN:
                group["lr"] = min(group["lr"] * LR_FACTOR, self.config.actor_lr)

    def _step(self, minibatch: TensorDictBase) -> dict[str, Tensor]:
        losses = self.loss(minibatch)
        total = losses["loss_objective"] + losses["loss_critic"] + losses["loss_entropy"]
        self.actor_optimizer.zero_grad(set_to_none=True)
        self.critic_optimizer.zero_grad(set_to_none=True)
        total.backward()
        limit = self.config.max_grad_norm
        actor_norm = torch.nn.utils.clip_grad_norm_(self._actor_parameters, limit)
        critic_norm = torch.nn.utils.clip_grad_norm_(self._critic_parameters, limit)
        self.actor_optimizer.step()
        self.critic_optimizer.step()
        metrics = {name: losses[name].detach() for name in REPORTED}
        return metrics | {"actor_grad_norm": actor_norm.detach(), "critic_grad_norm": critic_norm.detach()}

    def state_dict(self) -> dict[str, Any]:
        """Networks and optimisers."""
        return {
            "loss": self.loss.state_dict(),
            "actor_optimizer": self.actor_optimizer.state_dict(),
            "critic_optimizer": self.critic_optimizer.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""
        self.loss.load_state_dict(state["loss"])
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])


def _standardised(values: Tensor) -> Tensor:
    return (values - values.mean()) / (values.std() + 1e-8)
