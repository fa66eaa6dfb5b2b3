"""The faults of a real robot: noisy observations, sections that do nothing, a push on the tip.

The paper's three cases (section "Robustness") are the files of ``conf/perturbation``. Physics, reward, metrics and
sensing are always those of the true state.

Noise is added to what an agent observes of itself: position, velocity and previous action. Target and tip relative to
the agent are computed inside the models from the position that is observed, since a section cannot know where the
target is relative to a place that it does not know: the same noise is in all three. That is at least as hard as noise
on the position alone, which leaves the true position to be read from the other two.
"""

import math
import re
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor


@dataclass
class PerturbationConfig:
    """Strength of every kind; meanings and units in ``conf/perturbation/none.yaml``. The defaults perturb nothing."""

    name: str = "none"
    position_sigma: float = 0.0
    velocity_sigma: float = 0.0
    action_sigma: float = 0.0
    failed_agents: tuple[int, ...] = ()
    tip_force: float = 0.0
    first_step: int = 0
    steps: int = 0

    @property
    def noisy(self) -> bool:
        """True if any observation is noisy."""
        return max(self.position_sigma, self.velocity_sigma, self.action_sigma) > 0.0

    @property
    def nothing(self) -> bool:
        """True if everything stays as it is."""
        return not (self.noisy or self.failed_agents or self.pushes)

    @property
    def pushes(self) -> bool:
        """True if a force ever acts on the tip."""
        return self.tip_force > 0.0

    def __post_init__(self) -> None:
        """Refuse values that describe no perturbation.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        self.failed_agents = tuple(self.failed_agents)
        if not re.fullmatch(r"\w+", self.name):
            raise ValueError(f"perturbation.name is {self.name!r}: use letters and _, it becomes a folder's name")
        for key in ("position_sigma", "velocity_sigma", "action_sigma", "tip_force", "first_step", "steps"):
            value = getattr(self, key)
            if not (math.isfinite(value) and value >= 0):
                raise ValueError(f"perturbation.{key} is {value}: it must be a number from 0 up")
        if self.tip_force > 0.0 and self.steps == 0:
            raise ValueError(f"perturbation.steps is 0 with perturbation.tip_force={self.tip_force}: at least 1")
        if self.name == "none" and not self.nothing:
            changed = next(key for key, value in vars(PerturbationConfig()).items() if getattr(self, key) != value)
            raise ValueError(
                f"perturbation.{changed} is {getattr(self, changed)} with perturbation=none: "
                "add perturbation=noise, section_failure or disturbance, or a perturbation.name of your own"
            )


class Perturbation:
    """Perturbs ``num_envs`` environments.

    Attributes:
        config: what can happen.
        generator: from which everything is drawn, and nothing else: scenes are those without a perturbation.
    """

    def __init__(self, config: PerturbationConfig, n_agents: int, seed: int, device: torch.device) -> None:
        """Prepare; ``begin`` draws.

        Args:
            config: what happens.
            n_agents: sections of each environment.
            seed: the environment's.
            device: of all tensors.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        absent = [agent for agent in config.failed_agents if not 0 <= agent < n_agents]
        if absent:
            raise ValueError(
                f"perturbation.failed_agents holds {absent[0]}: the {n_agents} agents are 0 to {n_agents - 1}"
            )
        self.config = config
        self.generator = torch.Generator(device=device)
        self.seed(seed)
        works = [[agent not in config.failed_agents] for agent in range(n_agents)]
        self._works = torch.tensor(works, device=device)
        self._silence = torch.zeros((), dtype=torch.float32, device=device)

    def seed(self, seed: int) -> None:
        """Begin the own stream of random numbers that belongs to an environment's seed; it is not the scenes'."""
        self.generator.manual_seed(int(np.random.SeedSequence(seed, spawn_key=(1,)).generate_state(1)[0]))

    def begin(self, push: Tensor, mask: Tensor | None = None) -> Tensor:
        """Draw the direction of the force on the tip for the episodes that begin.

        Args:
            push: directions in the episodes so far, ``(num_envs, 3)``; not changed.
            mask: which episodes begin, ``(num_envs,)`` bool; all by default.

        Returns:
            The directions from now on; as they were if no force ever acts.
        """
        if not self.config.pushes:
            return push
        drawn = torch.empty_like(push).normal_(generator=self.generator)
        drawn /= drawn.norm(dim=-1, keepdim=True)
        return drawn if mask is None else torch.where(mask.unsqueeze(-1), drawn, push)

    def applied(self, action: Tensor) -> Tensor:
        """Let failed sections do nothing; actions are ``(num_envs, n_agents, 2)``."""
        return torch.where(self._works, action, self._silence) if self.config.failed_agents else action

    def tip_force(self, push: Tensor, steps: Tensor, active: Tensor) -> Tensor:
        """Compute the force on the tip during a control step, N, ``(num_envs, 3)``.

        Args:
            push: its direction, ``(num_envs, 3)``.
            steps: control steps since the reset, before this one, ``(num_envs,)``.
            active: whether the environment moves, ``(num_envs,)`` bool.
        """
        config = self.config
        now = active & (steps >= config.first_step) & (steps < config.first_step + config.steps)
        return config.tip_force * push * now.unsqueeze(-1)

    def observed(self, position: Tensor, velocity: Tensor, previous_action: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Add noise to agents' own entries: ``(count, n_agents, 3)``, the same, ``(count, n_agents, 2)``; float32."""
        if not self.config.noisy:
            return position, velocity, previous_action
        channels = 2 * position.shape[-1] + previous_action.shape[-1]
        noise = position.new_empty((*position.shape[:-1], channels)).normal_(generator=self.generator)
        return (
            position + self.config.position_sigma * noise[..., :3],
            velocity + self.config.velocity_sigma * noise[..., 3:6],
            previous_action + self.config.action_sigma * noise[..., 6:],
        )
