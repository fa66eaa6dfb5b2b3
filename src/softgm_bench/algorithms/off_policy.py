"""Shared by DDPG and SAC: replay buffer, exploration, and how many gradient steps follow a batch of frames."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.objectives import LossModule, ValueEstimators

from softgm_bench.algorithms.replay_buffer import ReplayBuffer
from softgm_bench.algorithms.team import give_to_agents
from softgm_bench.algorithms.vector_replay_buffer import VectorReplayBuffer
from softgm_bench.envs import entries
from softgm_bench.envs.interface import VECTOR, Environment
from softgm_bench.models.action_value import ActionValueConfig
from softgm_bench.models.heads import actor_saturation
from softgm_bench.upstream import graphs
from softgm_bench.upstream.soft_update import FusedSoftUpdate

# The team's reward and end of episode, as TorchRL's losses read them: per agent, (B, N, 1).
AGENT_REWARD, AGENT_DONE, AGENT_TERMINATED = ("agents", "reward"), ("agents", "done"), ("agents", "terminated")
PRIORITY = ("agents", "td_error")  # written by the losses, read by nobody
ADAM_EPSILON = 1e-6  # BenchMARL's


@dataclass
class OffPolicyConfig:
    """Hyperparameters of every off-policy algorithm; values and meaning in ``conf/algo/common/off_policy.yaml``."""

    name: str
    centralised: bool
    gamma: float
    tau: float
    batch_size: int
    updates_per_frame: float
    random_frames: int
    replay_capacity: int
    checkpoint_replay: bool
    max_grad_norm: float
    actor_lr: float
    critic_lr: float
    critic: ActionValueConfig

    def __post_init__(self) -> None:
        """Refuse values that the algorithm cannot work with.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        if getattr(getattr(self, "actor", None), "memory", None) is not None:
            raise ValueError(
                f"algo.actor.memory with algo={self.name}: recurrent actors are trained by PPO: ippo, mappo, softgm"
            )
        for field in fields(self):
            value, wanted = getattr(self, field.name), BOUNDS.get(field.name)
            if wanted is not None and value is not None and not wanted[0](value):
                raise ValueError(f"algo.{field.name} is {value}: it must {wanted[1]}")
        if self.replay_capacity < self.batch_size:
            raise ValueError(
                f"algo.replay_capacity is {self.replay_capacity}: it must be at least algo.batch_size {self.batch_size}"
            )


_AT_LEAST_ONE = (lambda value: value >= 1, "be at least 1")
_ABOVE_ZERO = (lambda value: value > 0.0, "be above 0")
_NOT_NEGATIVE = (lambda value: value >= 0.0, "not be negative")
BOUNDS = {
    "batch_size": _AT_LEAST_ONE,
    "replay_capacity": _AT_LEAST_ONE,
    "random_frames": _NOT_NEGATIVE,
    "updates_per_frame": _ABOVE_ZERO,
    "max_grad_norm": _ABOVE_ZERO,
    "actor_lr": _ABOVE_ZERO,
    "critic_lr": _ABOVE_ZERO,
    "gamma": (lambda value: 0.0 <= value <= 1.0, "lie between 0 and 1"),
    "tau": (lambda value: 0.0 < value <= 1.0, "be above 0 and at most 1"),
    # DDPG's
    "initial_sigma": _NOT_NEGATIVE,
    "final_sigma": _NOT_NEGATIVE,
    "sigma_frames": _AT_LEAST_ONE,
    "noise_correlation": (lambda value: 0.0 <= value < 1.0, "be at least 0 and below 1"),
    # SAC's
    "alpha_lr": _ABOVE_ZERO,
    "initial_alpha": _ABOVE_ZERO,
}


class Explorer(TensorDictModuleBase):
    """The policy that the collector and the evaluation call.

    Under ``ExplorationType.RANDOM`` it draws actions uniformly while ``uniform`` is set, and explores afterwards;
    otherwise it does what ``actor`` does. It writes ``entries.ACTION`` alone, whatever else the actor writes.

    Attributes:
        uniform: draw from [-1, 1], regardless of the observation.
    """

    out_keys: ClassVar = [entries.ACTION]

    def __init__(self, actor: TensorDictModuleBase, actions: int, config: Any, frames: int) -> None:
        """Explore around ``actor``, whose parameters are shared.

        Args:
            actor: writes ``entries.ACTION``.
            actions: numbers in one agent's action, A.
            config: an ``OffPolicyConfig``.
            frames: it explores as after so many.
        """
        super().__init__()
        self.in_keys = list(actor.in_keys)
        self.actor, self.actions, self.config = actor, actions, config
        self.schedule(frames)

    def schedule(self, frames: int) -> None:
        """Explore as after so many frames of training."""
        self.uniform = frames < self.config.random_frames

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write ``entries.ACTION``."""
        explores = exploration_type() is ExplorationType.RANDOM
        if explores and self.uniform:
            agents = td.get(self.in_keys[0])  # (..., N, any)
            action = torch.empty((*agents.shape[:-1], self.actions), dtype=torch.float32, device=agents.device)
            return td.set(entries.ACTION, action.uniform_(-1.0, 1.0))
        action = self.actor(td.copy()).get(entries.ACTION)
        return td.set(entries.ACTION, self.explore(action, td) if explores else action)

    def explore(self, action: Tensor, td: TensorDictBase) -> Tensor:
        """The action to take instead of the actor's; an actor that samples explores by itself."""
        return action


class OffPolicy:
    """Stores frames, samples transitions, takes gradient steps; subclasses build networks and loss.

    Attributes:
        policy: what the collector and the evaluation call; shares its parameters with the loss.
        loss: TorchRL's, with target networks; its entries that start with ``loss_`` are summed and minimised.
        optimizers: by name, each with the parameters whose gradient norm is limited together.
        frames: learnt from since the beginning.
    """

    reported: ClassVar[tuple[str, ...]]

    def __init__(self, config: Any, env: Environment, policy: Explorer, loss: LossModule, n_privileged: int) -> None:
        """Finish what a subclass began.

        Args:
            config: an ``OffPolicyConfig`` of the subclass.
            env: whose sizes the memory has.
            policy: around the loss's actor.
            loss: without the team's keys and value estimator, which are added here.
            n_privileged: channels of ``entries.PRIVILEGED`` that some network reads.
        """
        self.config = config
        self.policy, self.loss = policy, loss
        self.n_agents = env.sizes.n_agents
        loss.set_keys(reward=AGENT_REWARD, done=AGENT_DONE, terminated=AGENT_TERMINATED, priority=PRIORITY)
        loss.make_value_estimator(ValueEstimators.TD0, gamma=config.gamma)
        self.target_update = FusedSoftUpdate(loss, tau=config.tau)
        self.optimizers: dict[str, torch.optim.Optimizer] = {}
        self._lr: dict[str, float] = {}  # of each
        self.replay = _make_replay(config.replay_capacity, env, n_privileged)
        self.frames = 0
        self._due = 0.0  # gradient steps, of which whole ones are taken
        self._critic_frames = 0  # for which the critic alone learns
        self._recorded: graphs.Recorded | None = None

    def use_graphs(self) -> None:
        """Take gradient steps as replays of a CUDA graph from now on."""
        optimizers = list(self.optimizers.values())
        self._recorded = graphs.gradient_step(self._step, self._networks, optimizers, "the gradient step")

    def begin_with(self, policy: Mapping[str, Tensor] | None, critic_frames: int) -> None:
        """Begin with a trained policy's parameters, and let the critic alone learn from the first frames.

        Args:
            policy: state of ``self.policy`` to begin with; None: it stays as it is.
            critic_frames: until so many frames have been stored, the learning rates of all else are 0.
        """
        if policy is not None:
            self.policy.load_state_dict(policy)
            # made anew, it begins with targets that are what they follow
            self.target_update = FusedSoftUpdate(self.loss, tau=self.config.tau)
        self._critic_frames = critic_frames
        self._let_actor_learn()

    def _let_actor_learn(self) -> None:
        """Set the learning rates of all but the critic, a temperature's too, to 0 or to the settings' own."""
        learns = self.frames >= self._critic_frames
        for name, optimizer in self.optimizers.items():
            if name != "critic":
                graphs.set_lr(optimizer, self._lr[name] * learns)

    def _networks(self) -> list[Tensor]:
        """Networks and target networks."""
        return [value for value in self.loss.state_dict().values() if isinstance(value, Tensor)]

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Store frames, then take ``updates_per_frame`` gradient steps for each of them.

        Args:
            batch: ``(num_envs, steps)`` consecutive frames.

        Returns:
            Means over the gradient steps of losses and gradient norms, NaN if none was taken; how many were taken,
            how many transitions can be sampled, and the saturation of the actor's head.
        """
        self.replay.add(batch)
        self.frames += batch.numel()
        steps = self._steps_for(batch.numel())
        self.policy.schedule(self.frames)
        if self._critic_frames:
            self._let_actor_learn()
        totals, step = None, self._recorded or self._step
        for _ in range(steps):
            metrics = step(self.sample())
            totals = metrics if totals is None else totals + metrics
        # the only look at results: a GPU works through all steps without being waited for
        values = [float("nan")] * len(self._names) if totals is None else (totals / steps).tolist()
        counts = {"gradient_steps": float(steps), "replay_size": float(len(self.replay))}
        return dict(zip(self._names, values, strict=True)) | counts | actor_saturation(self.policy, batch)

    def sample(self) -> TensorDictBase:
        """Transitions as the loss reads them: the team's reward and end of episode given to every agent."""
        transitions = self.replay.sample(self.config.batch_size)
        after = transitions["next"]
        for of_team, of_agent in (
            (entries.REWARD, AGENT_REWARD),
            (entries.DONE, AGENT_DONE),
            (entries.TERMINATED, AGENT_TERMINATED),
        ):
            after[of_agent] = give_to_agents(after[of_team], self.n_agents)
        return transitions

    def state_dict(self) -> dict[str, Any]:
        """Networks, target networks, optimisers, counters, and the replay buffer if ``checkpoint_replay`` says so."""
        state = {
            "loss": self.loss.state_dict(),
            "optimizers": {
                name: graphs.portable_state(optimizer, self._lr[name]) for name, optimizer in self.optimizers.items()
            },
            "frames": self.frames,
            "due": self._due,
        }
        return state | ({"replay": self.replay.state_dict()} if self.config.checkpoint_replay else {})

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from what ``state_dict`` returned.

        Without the replay buffer, gradient steps pause until as many frames are stored again as before the first one.
        """
        self.loss.load_state_dict(state["loss"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.frames, self._due = state["frames"], state["due"]
        if self._recorded is not None:  # the optimisers' tensors are others now
            self.use_graphs()
        self._let_actor_learn()
        if "replay" in state:
            self.replay.load_state_dict(state["replay"])
        self.policy.schedule(self.frames)

    def _optimize(self, name: str, parameters: list[nn.Parameter], lr: float) -> None:
        """Add an optimiser."""
        self._lr[name] = lr
        self.optimizers[name] = torch.optim.Adam(parameters, lr=lr, eps=ADAM_EPSILON, fused=True)

    @property
    def _names(self) -> list[str]:
        """Of the metrics of a gradient step."""
        return [*self.reported, *(f"{name}_grad_norm" for name in self.optimizers)]

    def _steps_for(self, frames: int) -> int:
        """Gradient steps that ``frames`` new frames make due; none before there is enough to sample from."""
        config = self.config
        if self.replay.stored < max(config.batch_size, config.random_frames):
            return 0
        self._due += frames * config.updates_per_frame
        steps = int(self._due)
        self._due -= steps
        return steps

    def _step(self, transitions: TensorDictBase) -> Tensor:
        """One gradient step of every network; metrics in the order of ``_names``."""
        losses = self.loss(transitions)
        total = sum(value for name, value in losses.items() if name.startswith("loss_"))
        for optimizer in self.optimizers.values():
            optimizer.zero_grad(set_to_none=True)
        total.backward()
        norms = []
        for optimizer in self.optimizers.values():
            parameters = optimizer.param_groups[0]["params"]
            norms.append(nn.utils.clip_grad_norm_(parameters, self.config.max_grad_norm))
            optimizer.step()
        self.target_update.step()
        return torch.stack([*(value.detach() for value in self._metrics(losses)), *norms])

    def _metrics(self, losses: TensorDictBase) -> list[Tensor]:
        """Give what ``reported`` names, from what the loss returned."""
        raise NotImplementedError


def _make_replay(capacity: int, env: Environment, n_privileged: int) -> ReplayBuffer | VectorReplayBuffer:
    """Take the memory that fits the layout of the environment's observations."""
    if env.sizes.layout == VECTOR:
        return VectorReplayBuffer(capacity, env.device)
    return ReplayBuffer(capacity, env.batch_size[0], env.sizes, env.device, n_privileged)
