"""Plays an evaluation until one of its episodes has ended, and keeps everything about that one."""

import json
from dataclasses import replace
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from softgm_bench.assembly import build_env
from softgm_bench.config import UserError, plain
from softgm_bench.envs import SoftArmEnv, keys
from softgm_bench.envs.vmas import VmasConfig
from softgm_bench.episodes.evaluation import act, evaluation_seed
from softgm_bench.episodes.policy import TrainedPolicy
from softgm_bench.episodes.summary import versions
from softgm_bench.episodes.trajectory import CYLINDER_FIELDS, ROD, Array, Trajectory

OBSERVED = (*keys.OBSERVATION, keys.PRIVILEGED)


def record_episode(
    trained: TrainedPolicy,
    seed: int,
    episode: int,
    horizon: int | None,
    deterministic: bool,
    attention: bool,
    episodes: int | None,
) -> Trajectory:
    """See ``softgm_bench.episodes.trajectory.record``."""
    episodes = episode + 1 if episodes is None else episodes
    _check(trained, seed, episode, episodes, horizon)
    config = trained.config
    backend = "torch" if config.backend == "torch" else "numba"
    own = evaluation_seed(seed)
    env = cast(SoftArmEnv, build_env(replace(config, device="cpu", backend=backend), episodes, own, horizon))
    exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    with torch.random.fork_rng([]), torch.no_grad(), set_exploration_type(exploration):
        env.set_seed(own)
        torch.manual_seed(own)
        recorder = _play(trained.policy, env, episode, attention_encoder(trained.policy) if attention else None)
    info = {
        "label": trained.label,
        "task": config.task.name,
        "frames": trained.frames,
        "seed": seed,
        "episode": episode,
        "episodes": episodes,
        "deterministic": deterministic,
        "backend": backend,
        "versions": versions(),
    }
    return recorder.trajectory(json.loads(json.dumps(plain(config))), info)  # lists for tuples, as a file has them


def attention_encoder(policy: nn.Module) -> Any | None:
    """The module of a policy that can tell its attention weights, by ``forward_with_attention``; None without one."""
    return next((module for module in policy.modules() if hasattr(module, "forward_with_attention")), None)


class _Recorder:
    """Collects what one of an environment's arms does."""

    def __init__(self, env: SoftArmEnv, row: int) -> None:
        self.env, self.row = env, row
        self.states: dict[str, list[Array]] = {name: [] for name in (*ROD, "contact")}
        self.steps: dict[str, list[Array]] = {"action": [], "tip_force": [], "reward": []}
        self.observation: dict[str, list[Array]] = {}
        self.terms: dict[str, list[Array]] = {name: [] for name in keys.REWARD_TERM_NAMES}
        self.attention: dict[str, list[Array]] = {}
        self.success = self.diverged = False

    def state(self, data: TensorDictBase) -> None:
        """Note the arm as it is now and what the policy is shown of it."""
        rod = self.env.rod
        for name in ROD:
            self.states[name].append(self._own(getattr(rod, name)))
        self.states["contact"].append(self._own(self.env.contacts()))
        for key in OBSERVED:
            values = data.get(key, None)
            if values is not None:
                name = key if isinstance(key, str) else "/".join(key)
                self.observation.setdefault(name, []).append(self._own(values))

    def step(self, after: TensorDictBase) -> None:
        """Note what a step did and paid."""
        force = self.env.tip_force
        self.steps["action"].append(self._own(self.env.applied_action))
        self.steps["tip_force"].append(np.zeros(3) if force is None else self._own(force).astype(np.float64))
        self.steps["reward"].append(self._own(after[keys.REWARD])[0])
        for name, values in self.terms.items():
            values.append(self._own(after[keys.REWARD_TERMS, name])[0])
        self.success = bool(self._own(after[keys.SUCCESS])[0])
        self.diverged = bool(self._own(after[keys.DIVERGED])[0])

    def attend(self, encoder: Any, data: TensorDictBase) -> None:
        """Note the attention weights with which the next actions are chosen."""
        _, weights = encoder.forward_with_attention(data[self.row : self.row + 1])
        for stage, values in weights.items():
            self.attention.setdefault(stage, []).append(values[0].numpy(force=True))

    def trajectory(self, config: dict[str, Any], info: dict[str, Any]) -> Trajectory:
        """What was collected."""
        cylinders = self.env.scene.cylinders
        exists = self._own(cylinders.mask)
        return Trajectory(
            **{name: np.stack(values) for name, values in (self.states | self.steps).items()},
            target=self._own(self.env.scene.target).astype(np.float64),
            observation={name: np.stack(values) for name, values in self.observation.items()},
            reward_terms={name: np.stack(values) for name, values in self.terms.items()},
            cylinders={
                name: self._own(getattr(cylinders, name))[exists].astype(np.float64) for name in CYLINDER_FIELDS
            },
            attention={stage: np.stack(values) for stage, values in self.attention.items()},
            success=self.success,
            diverged=self.diverged,
            config=config,
            info=info,
        )

    def _own(self, values: Tensor) -> Array:
        return values[self.row].numpy(force=True).copy()


def _play(policy: nn.Module, env: SoftArmEnv, row: int, encoder: Any | None) -> _Recorder:
    """One episode in every environment, as ``evaluation.evaluate`` has it, until that of ``row`` ends."""
    recorder = _Recorder(env, row)
    data = env.reset()
    alive = torch.ones(env.batch_size, dtype=torch.bool)
    recorder.state(data)
    while alive[row]:
        if encoder is not None:
            recorder.attend(encoder, data)
        data = env.step(act(policy, data, alive))
        alive = alive & ~data["next", keys.DONE].squeeze(-1)
        recorder.step(data["next"])
        data = step_mdp(data)
        recorder.state(data)
    return recorder


def _check(trained: TrainedPolicy, seed: int, episode: int, episodes: int, horizon: int | None) -> None:
    if isinstance(trained.config.task, VmasConfig):
        raise UserError(f"task={trained.config.task.name}: it has no arm; trajectories are those of an arm")
    if not 0 <= seed < 2**63:
        raise UserError(f"seed={seed}: a seed is a whole number from 0 to 2**63 - 1")
    if episode < 0:
        raise UserError(f"episode={episode}: episodes are counted from 0")
    if episode >= episodes:
        raise UserError(f"episode={episode}: of {episodes} episodes, choose 0 to {episodes - 1}")
    if horizon is not None and horizon < 1:
        raise UserError(f"horizon={horizon}: it must be at least 1")
