"""Many sequences of actions played side by side, each in a scene of its own."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from softgm_bench.assembly import build_env
from softgm_bench.config import Config
from softgm_bench.envs import SoftArmEnv
from softgm_bench.envs.simulation import Episodes
from softgm_bench.episodes.certified import dequantised, first_frame
from softgm_bench.episodes.evaluation import evaluation_seed


@dataclass
class Played:
    """What became of sequences; ``(sequences,)`` each.

    Attributes:
        success: bool.
        length: control steps until the episode ended, or all of them.
        left: the shortest way that was left to the target at any step, through the opening, m.
    """

    success: Tensor
    length: Tensor
    left: Tensor


class Bench:
    """The scenes of an evaluation, in which any number of sequences can be tried.

    Attributes:
        env: at the beginning of the scenes' episodes.
        scenes: their number.
        steps: control steps that were simulated so far, of arms that moved.
    """

    def __init__(self, config: Config, scenes: int, seed: int, dtype: str, at_once: int = 128) -> None:
        """Draw the scenes of ``evaluate episodes=scenes seed=seed``; simulate in ``dtype``, ``at_once`` arms together.

        ``float32`` takes half the time and decides the same but for a few sequences: what is found with it is played
        once more in ``float64``.
        """
        self._config = replace(config, dtype=dtype)
        self.env: SoftArmEnv = first_frame(self._config, scenes, evaluation_seed(seed))
        self._first = self.env.simulator.state.episodes.clone()
        self._arms: SoftArmEnv = build_env(self._config, at_once, 0)
        self.scenes, self.steps, self._at_once = scenes, 0, at_once

    @property
    def beginning(self) -> Episodes:
        """The scenes' episodes before their first step; not to be changed."""
        return self._first

    @property
    def target(self) -> Tensor:
        """Targets, m, ``(scenes, 3)``."""
        return self._first.scene.target

    @property
    def privileged(self) -> Tensor:
        """What the task tells of its scenes, ``(scenes, P)``; a wall's opening comes first."""
        return self._first.scene.privileged

    def play(self, scene: Tensor, action: Tensor) -> Played:
        """Play sequences ``(n, T, N, 2)`` int8 in the scenes ``(n,)``, each until its episode ends."""
        parts = [
            self._play(scene[first : first + self._at_once], action[first : first + self._at_once])
            for first in range(0, len(scene), self._at_once)
        ]
        return Played(*(torch.cat([getattr(part, name) for part in parts]) for name in ("success", "length", "left")))

    def _play(self, scene: Tensor, action: Tensor) -> Played:
        count, simulator = len(scene), self._arms.simulator
        rows = torch.cat([scene, scene.new_zeros(self._at_once - count)])
        episodes = self._first[rows].clone()
        episodes.truncated[count:] = True  # rests
        simulator.state.episodes = episodes
        action = torch.cat([action, action.new_zeros((self._at_once - count, *action.shape[1:]))])
        success = torch.zeros(self._at_once, dtype=torch.bool)
        length = torch.zeros(self._at_once, dtype=torch.int64)
        left = torch.full((self._at_once,), torch.inf, dtype=torch.float64)
        opening = self.privileged[rows].double()
        for k in range(action.shape[1]):
            now = simulator.state.episodes
            active = ~(now.terminated | now.truncated)
            if not active.any():
                break
            self.steps += int(active.sum())
            verdict = simulator.step(dequantised(action[:, k])).verdict
            success |= verdict.success & active
            length += active
            now = simulator.state.episodes
            way = way_left(now.rod.position[..., -1].double(), now.scene.target.double(), opening)
            left = torch.where(active, torch.minimum(left, way), left)
        return Played(success[:count], length[:count], left[:count])


def way_left(tip: Tensor, target: Tensor, privileged: Tensor) -> Tensor:
    """Length of the way from a tip to its target, m, ``(n,)``; through the opening as long as the tip is before it.

    Args:
        tip: m, ``(n, 3)``.
        target: m, ``(n, 3)``.
        privileged: of a wall: the opening's centre and side, m, and perhaps a yaw, rad; without columns: no wall.
    """
    straight = (target - tip).norm(dim=-1)
    if not privileged.shape[-1]:
        return straight
    opening, side = privileged[:, :3], privileged[:, 3]
    yaw = privileged[:, 4] if privileged.shape[-1] > 4 else torch.zeros_like(side)
    offset = tip - opening
    depth = offset[:, 0] * yaw.cos() + offset[:, 1] * yaw.sin()
    aside = (offset[:, 1] * yaw.cos() - offset[:, 0] * yaw.sin()).abs()
    # a tip in a dead end is behind the plane, and no nearer
    through = (depth > 0.15) | ((depth > 0.0) & (aside < side))
    return torch.where(through, straight, offset.norm(dim=-1) + (target - opening).norm(dim=-1))


def to_tensor(values: Any) -> Tensor:
    """Give a tensor that shares no memory with an array."""
    return torch.from_numpy(np.array(values))
