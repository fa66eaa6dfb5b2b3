"""Proximal policy optimisation for a team: one reward, one probability ratio per agent.

SoftGM and MAPPO have a centralised critic, one value of the state; IPPO an independent one, a value per agent of what
that agent observes. Actors and, in IPPO, critics share their parameters among agents.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential
from torch import Tensor
from torchrl.modules.value_norm import PopArtValueNorm
from torchrl.objectives.value import GAE

from softgm_bench.algorithms.groups import joined, minibatches, standardised, weighted_mean
from softgm_bench.algorithms.registry import register_algorithm
from softgm_bench.algorithms.team import give_to_agents
from softgm_bench.envs import entries
from softgm_bench.envs.interface import Environment, Sizes
from softgm_bench.models.heads import (
    STATE_VALUE,
    ActorConfig,
    ValueConfig,
    actor_saturation,
    build_actor,
    build_value,
)
from softgm_bench.upstream import graphs
from softgm_bench.upstream.ppo_loss import LeanPPOLoss

ADVANTAGE, VALUE_TARGET = "advantage", "value_target"
REPORTED = ("loss_objective", "loss_critic", "kl_approx", "clip_fraction")
ENTROPY = ("loss_entropy", "entropy")  # reported too
LR_MARGIN, LR_FACTOR = 1.5, 1.2  # of the actor's learning rate's adaptation to ``target_kl``
LR_SCHEDULES = ("constant", "linear")


@dataclass
class PPOConfig:
    """Hyperparameters; values and meaning in ``conf/algo/common/ppo.yaml``."""

    name: str
    centralised: bool
    clip_epsilon: float
    gamma: float
    gae_lambda: float
    entropy_coeff: float
    critic_coeff: float
    max_grad_norm: float
    actor_lr: float
    critic_lr: float
    lr_schedule: str
    lr_schedule_frames: int
    target_kl: float | None
    epochs: int
    minibatch_size: int
    normalize_advantage: bool
    advantage_clip: float | None
    value_norm_decay: float | None
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
        if self.lr_schedule not in LR_SCHEDULES:
            raise ValueError(f"algo.lr_schedule is {self.lr_schedule}: choose one of {', '.join(LR_SCHEDULES)}")
        if self.lr_schedule != "constant" and self.lr_schedule_frames < 1:
            raise ValueError(f"algo.lr_schedule_frames is {self.lr_schedule_frames}: it must be at least 1")
        if self.value_norm_decay is not None and not 0.0 <= self.value_norm_decay < 1.0:
            raise ValueError(
                f"algo.value_norm_decay is {self.value_norm_decay}: it must be at least 0 and below 1, or null"
            )


@register_algorithm("softgm", "ippo", "mappo", config=PPOConfig)
class PPO:
    """TorchRL's ``ClipPPOLoss`` and ``GAE`` with an optimiser each for actor and critic.

    An actor with memory is trained on sequences: each environment's steps of a batch, from the hidden state that its
    first frame was met with, which is the older policy's and no gradient passes (truncated backpropagation through
    time). Critics read frames alone.

    Attributes:
        policy: what the collector and the evaluation call; shares its parameters with the loss.
        trained_frames: how many frames the updates so far have learnt from.
    """

    @staticmethod
    def build_policy(
        config: PPOConfig, model_config: Any, sizes: Sizes, oracle: bool = False, frames: int = 0
    ) -> ProbabilisticTensorDictSequential:
        """Build the actor alone, which explores the same whatever ``frames``; see ``algorithms.build_policy``."""
        return build_actor(model_config, sizes, config.actor, sizes.n_privileged if oracle else 0)

    def __init__(self, config: PPOConfig, model_config: Any, env: Environment, oracle: bool = False) -> None:
        """Build networks, loss and optimisers for an environment's sizes and device.

        An asymmetric critic, and actor and critic of an oracle, read ``entries.PRIVILEGED``.
        """
        self.config = config
        sizes = env.sizes
        known = sizes.n_privileged if oracle or config.critic.asymmetric else 0
        self.policy = self.build_policy(config, model_config, sizes, oracle).to(env.device)
        self.critic = build_value(model_config, sizes, config.critic, config.centralised, known).to(env.device)
        self.loss = LeanPPOLoss(
            self.policy,
            self.critic,
            clip_epsilon=config.clip_epsilon,
            entropy_bonus=config.entropy_coeff > 0.0,
            entropy_coeff=config.entropy_coeff,
            critic_coeff=config.critic_coeff,
            loss_critic_type="l2",
            log_explained_variance=False,
            functional=False,  # there are no target networks, for which parameters would be swapped at every call
            normalize_advantage=False,  # done once an iteration, over all of its frames
        )
        self.loss.set_keys(action=entries.ACTION, sample_log_prob=entries.LOG_PROB, value=STATE_VALUE)
        self.advantage = GAE(gamma=config.gamma, lmbda=config.gae_lambda, value_network=None, average_gae=False)
        self.value_norm: PopArtValueNorm | None = None
        if config.value_norm_decay is not None:
            self.value_norm = PopArtValueNorm(beta=config.value_norm_decay, device=env.device)
        # What an update reads of a frame; everything else stays out of the minibatches.
        read = dict.fromkeys((*self.policy.in_keys, *self.critic.in_keys))
        self._trained_on = (*read, entries.ACTION, entries.LOG_PROB, ADVANTAGE, VALUE_TARGET)
        self._in_sequences = config.actor.memory is not None  # minibatches are of whole environments, not of frames
        self._actor_parameters = list(self.policy.parameters())
        self._critic_parameters = list(self.critic.parameters())
        self.actor_optimizer = torch.optim.Adam(self._actor_parameters, lr=config.actor_lr, eps=1e-5, fused=True)
        self.critic_optimizer = torch.optim.Adam(self._critic_parameters, lr=config.critic_lr, eps=1e-5, fused=True)
        self.trained_frames = 0
        self._kl_scale = 1.0  # of the actor's learning rate
        self._critic_frames = 0  # for which the actor waits
        self._recorded: graphs.Recorded | None = None

    def use_graphs(self) -> None:
        """Take gradient steps as replays of a CUDA graph from now on, those on minibatches of the usual size."""
        networks = [*self._actor_parameters, *self._critic_parameters]
        self._recorded = graphs.gradient_step(self._step, lambda: networks, self._optimizers, "PPO's gradient step")

    def begin_with(self, policy: Mapping[str, Tensor] | None, critic_frames: int) -> None:
        """Begin with a trained policy's parameters, and let the critic alone learn from the first frames.

        Args:
            policy: state of ``self.policy`` to begin with; None: it stays as it is.
            critic_frames: until so many frames have been learnt from, the actor's learning rate is 0.
        """
        if policy is not None:
            self.policy.load_state_dict(policy)
        self._critic_frames = critic_frames
        self._set_learning_rates()

    @property
    def _optimizers(self) -> tuple[torch.optim.Optimizer, torch.optim.Optimizer]:
        return self.actor_optimizer, self.critic_optimizer

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Improve actor and critic on fresh frames.

        Args:
            batch: ``(num_envs, steps)`` consecutive frames of the current policy.

        Returns:
            Means over all minibatches of losses, entropy, KL divergence, clip fraction and gradient norms; the learning
            rates that the next update begins with; how saturated the actor's head is. Without an entropy bonus, entropy
            is that of the frames' actions.
        """
        return self.update_mixture((batch,))

    def update_mixture(self, batches: Sequence[TensorDictBase]) -> dict[str, float]:
        """Improve actor and critic on fresh frames of arms with several numbers of sections.

        Every frame weighs the same, whatever its number of agents: the loss of a minibatch is the mean of the groups'
        losses by their frames, each a mean over its frames and agents. Advantages and value targets are normalised over
        the frames of all groups.

        Args:
            batches: one for each number, ``(num_envs, steps)`` consecutive frames of the current policy each.

        Returns:
            As ``update``, over the frames of all groups.
        """
        groups = self._prepared(batches)
        # results are first looked at here: a GPU works through all minibatches without being waited for
        read = torch.stack([self._epoch(groups) for _ in range(self.config.epochs)]).tolist()
        epochs = [dict(zip(self._names, values, strict=True)) for values in read]
        frames = [batch.numel() for batch in batches]
        self.trained_frames += sum(frames)
        self._adapt(epochs[-1]["kl_approx"])
        self._set_learning_rates()
        means = {name: sum(epoch[name] for epoch in epochs) / len(epochs) for name in self._names}
        if not self.loss.entropy_bonus:
            entropies = [-batch.get(entries.LOG_PROB).mean().item() for batch in batches]
            means |= {"loss_entropy": 0.0, "entropy": weighted_mean(entropies, frames)}
        rates = dict(zip(("actor_lr", "critic_lr"), self._learning_rates, strict=True))
        saturations = [actor_saturation(self.policy, batch) for batch in batches]
        saturation = {name: weighted_mean([one[name] for one in saturations], frames) for name in saturations[0]}
        return means | rates | saturation

    def prepare(self, batch: TensorDictBase) -> TensorDictBase:
        """Estimate advantages and value targets, and flatten to frames ``(num_envs * steps,)``.

        Advantages are every agent's, ``(frames, N, 1)``. Value targets have the shape of the critic's values, and with
        value normalisation their scale. An actor with memory needs frames in their order: nothing is flattened then.
        """
        (frames,) = self._prepared((batch,))
        return frames

    def _prepared(self, batches: Sequence[TensorDictBase]) -> list[TensorDictBase]:
        """``prepare`` each batch, with advantages and value targets in scales that all batches share."""
        groups = [self._estimate(batch).select(*self._trained_on) for batch in batches]
        if self.value_norm is not None:
            self.value_norm.update(joined([frames.get(VALUE_TARGET) for frames in groups]))
            for frames in groups:
                frames.set(VALUE_TARGET, self.value_norm.normalize(frames.get(VALUE_TARGET)))
        if not self._in_sequences:
            groups = [frames.reshape(-1) for frames in groups]
        for frames, advantage in zip(groups, self._scaled([frames.get(ADVANTAGE) for frames in groups]), strict=True):
            n_agents = frames.get(entries.LOG_PROB).shape[-1]
            frames.set(ADVANTAGE, give_to_agents(advantage, n_agents) if self.config.centralised else advantage)
        return groups

    def _scaled(self, advantages: list[Tensor]) -> list[Tensor]:
        """Normalise and cut the advantages of all batches together, as the settings say."""
        limit, normalised = self.config.advantage_clip, self.config.normalize_advantage
        if normalised:
            advantages = standardised(advantages)
        if limit is not None:
            # a few successes among thousands of frames would otherwise leave nothing of all the other frames' say
            advantages = [advantage.clamp(-limit, limit) for advantage in advantages]
            if normalised:
                advantages = standardised(advantages)
        return advantages

    @torch.no_grad()
    def _estimate(self, batch: TensorDictBase) -> TensorDictBase:
        """Add ``ADVANTAGE`` and ``VALUE_TARGET`` to a copy of the batch, of the team or (independent) of each agent."""
        after = batch.get("next")
        outcome = after.select(entries.REWARD, entries.DONE, entries.TERMINATED)
        if not self.config.centralised:
            n_agents = batch.get(entries.LOG_PROB).shape[-1]
            outcome = outcome.apply(lambda of_team: give_to_agents(of_team, n_agents))
        estimates = self.advantage(
            TensorDict(
                {STATE_VALUE: self._values(batch), "next": outcome.set(STATE_VALUE, self._values(after))},
                batch.batch_size,
            )
        )
        return batch.copy().update(estimates.select(ADVANTAGE, VALUE_TARGET))

    def _values(self, td: TensorDictBase) -> Tensor:
        """The critic's values in the reward's scale."""
        value = self.critic(td.select(*self.critic.in_keys)).get(STATE_VALUE)
        return value if self.value_norm is None else self.value_norm.denormalize(value)

    @property
    def _names(self) -> list[str]:
        """Of the metrics of a gradient step."""
        return [*REPORTED, *(ENTROPY if self.loss.entropy_bonus else ()), "actor_grad_norm", "critic_grad_norm"]

    def _epoch(self, groups: Sequence[TensorDictBase]) -> Tensor:
        """Pass once over all frames in random minibatches; means over the minibatches, in the order of ``_names``."""
        size = self.config.minibatch_size
        if self._in_sequences:
            size = max(1, round(size / groups[0].shape[1]))
        if len(groups) > 1:
            return torch.stack([self._descend(self._losses(parts)) for parts in minibatches(groups, size)]).mean(0)
        step = self._recorded or self._step
        return torch.stack([step(minibatch) for (minibatch,) in minibatches(groups, size)]).mean(0)

    def _adapt(self, kl: float) -> None:
        """Scale the actor's learning rate so that the policy's change per update stays near ``target_kl``.

        That is held against ``kl``, the mean KL divergence over the last epoch. With a constant step the change grows
        as sigma shrinks, until updates undo each other. ``actor_lr`` is the upper bound: above it, learning was slower
        even where the divergence was small.
        """
        config = self.config
        if config.target_kl is not None and kl > LR_MARGIN * config.target_kl:
            self._kl_scale /= LR_FACTOR
        elif config.target_kl is not None and kl < config.target_kl / LR_MARGIN:
            self._kl_scale = min(self._kl_scale * LR_FACTOR, 1.0)

    @property
    def _learning_rates(self) -> tuple[float, float]:
        """Actor's and critic's for the next update: the settings, times what is left of a linear schedule's frames."""
        config, left = self.config, 1.0
        if config.lr_schedule == "linear":
            left = max(0.0, 1.0 - self.trained_frames / config.lr_schedule_frames)
        acts = self.trained_frames >= self._critic_frames
        return config.actor_lr * self._kl_scale * left * acts, config.critic_lr * left

    def _set_learning_rates(self) -> None:
        for optimizer, lr in zip(self._optimizers, self._learning_rates, strict=True):
            graphs.set_lr(optimizer, lr)

    def _step(self, minibatch: TensorDictBase) -> Tensor:
        """One gradient step of actor and critic; metrics in the order of ``_names``."""
        return self._descend(self.loss(minibatch))

    def _losses(self, parts: Sequence[TensorDictBase]) -> dict[str, Tensor]:
        """What the loss gives of a minibatch, the mean of the groups' by their frames."""
        frames = sum(map(len, parts))
        means: dict[str, Tensor] = {}
        for part in parts:
            share = len(part) / frames
            for name, value in self.loss(part).items():
                means[name] = value * share if name not in means else means[name] + value * share
        return means

    def _descend(self, losses: Mapping[str, Any] | TensorDictBase) -> Tensor:
        """Step along what ``self.loss`` gave."""
        total = sum(value for name, value in losses.items() if name.startswith("loss_"))
        self.actor_optimizer.zero_grad(set_to_none=True)
        self.critic_optimizer.zero_grad(set_to_none=True)
        total.backward()
        limit = self.config.max_grad_norm
        actor_norm = torch.nn.utils.clip_grad_norm_(self._actor_parameters, limit)
        critic_norm = torch.nn.utils.clip_grad_norm_(self._critic_parameters, limit)
        self.actor_optimizer.step()
        self.critic_optimizer.step()
        return torch.stack([*(losses[name].detach() for name in self._names[:-2]), actor_norm, critic_norm])

    def state_dict(self) -> dict[str, Any]:
        """Networks, optimisers, statistics of the value targets and where the schedules are."""
        actor_lr, critic_lr = self._learning_rates
        return {
            "loss": self.loss.state_dict(),
            "actor_optimizer": graphs.portable_state(self.actor_optimizer, actor_lr),
            "critic_optimizer": graphs.portable_state(self.critic_optimizer, critic_lr),
            "value_norm": None if self.value_norm is None else self.value_norm.state_dict(),
            "trained_frames": self.trained_frames,
            "kl_scale": self._kl_scale,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from what ``state_dict`` returned."""
        self.loss.load_state_dict(state["loss"])
        self.actor_optimizer.load_state_dict(state["actor_optimizer"])
        self.critic_optimizer.load_state_dict(state["critic_optimizer"])
        if self.value_norm is not None:
            self.value_norm.load_state_dict(state["value_norm"])
        self.trained_frames, self._kl_scale = state["trained_frames"], state["kl_scale"]
        if self._recorded is not None:  # the optimisers' tensors are others now
            self.use_graphs()
