"""Record one episode of an evaluation: play all of them until it has ended, and keep everything about that one."""

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from softgm_bench.assembly import build_env
from softgm_bench.config import plain
from softgm_bench.envs import SoftArmEnv, entries, kind_of
from softgm_bench.envs.section_mixture import refuse_mixture
from softgm_bench.episodes import policy, trajectory
from softgm_bench.episodes.evaluation import act, evaluation_seed
from softgm_bench.episodes.policy import TrainedPolicy
from softgm_bench.episodes.trajectory import CYLINDER_FIELDS, PATH, ROD, Array, Trajectory
from softgm_bench.errors import UserError
from softgm_bench.models.mirror import seen
from softgm_bench.rod.backend import default_backend, runs_on
from softgm_bench.rod.randomise import FACTORS
from softgm_bench.storage.versions import versions

OBSERVED = (*entries.OBSERVATION, entries.PRIVILEGED)


def record(
    trained: TrainedPolicy,
    seed: int,
    episode: int = 0,
    horizon: int | None = None,
    deterministic: bool = True,
    attention: bool = False,
    episodes: int | None = None,
    watch: Callable[[], None] | None = None,
) -> Trajectory:
    """An episode of an evaluation, bit by bit.

    Scenes are drawn for all episodes of an evaluation together, and a network's rounding depends on how many it acts
    for; so all of them are simulated until this one ends.

    Args:
        trained: a ``TrainedPolicy``.
        seed: of the evaluation.
        episode: number of the episode in the evaluation, from 0.
        horizon: control steps until an episode ends, the task's by default.
        deterministic: act by the mode of the policy, otherwise by a sample.
        attention: record the attention weights too, if the policy has an encoder with attention.
        episodes: of the evaluation, all at once; ``episode + 1`` by default. Another number gives another episode.
        watch: called after each step.

    Raises:
        UserError: an argument makes no sense, or the task has no arm.
    """
    episodes = episode + 1 if episodes is None else episodes
    _check(trained, seed, episode, episodes, horizon)
    config = trained.config
    backend = config.backend if config.backend and runs_on(config.backend, "cpu") else default_backend("cpu")
    own = evaluation_seed(seed)
    env = cast(SoftArmEnv, build_env(replace(config, device="cpu", backend=backend), episodes, own, horizon))
    exploration = ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
    with torch.random.fork_rng([]), torch.no_grad(), set_exploration_type(exploration):
        env.set_seed(own)
        torch.manual_seed(own)
        recorder = _play(trained.policy, env, episode, attention_encoder(trained.policy) if attention else None, watch)
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
    if not config.randomise.nothing:
        info["body"] = recorder.body
    simulated = plain(config) | {"rod": asdict(env.backend.parameters)}  # a task may have a surface of its own
    return recorder.trajectory(json.loads(json.dumps(simulated)), info)  # lists for tuples, as a file has them


def record_or_load(
    path: Path,
    seed: int = 0,
    episode: int = 0,
    horizon: int | None = None,
    deterministic: bool = True,
    attention: bool = False,
    episodes: int | None = None,
    overrides: Sequence[str] = (),
    watch: Callable[[], None] | None = None,
) -> Trajectory:
    """The trajectory in an ``.npz`` file; or ``record`` with the policy of a run folder, checkpoint or policy's file.

    ``overrides`` are settings on top of those that the policy was trained with. A file takes none of the arguments.

    Raises:
        UserError: the source is missing or damaged, or an argument makes no sense.
    """
    if path.suffix == ".npz":
        if overrides:
            raise UserError(f"{overrides[0]}: {path} is a recorded episode, which takes no settings; name a policy")
        return trajectory.load(path)
    trained = policy.load(path, overrides=overrides)
    return record(trained, seed, episode, horizon, deterministic, attention, episodes, watch)


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
        self.terms: dict[str, list[Array]] = {name: [] for name in entries.REWARD_TERM_NAMES}
        self.attention: dict[str, list[Array]] = {}
        self.path: list[Array] = []
        self.success = self.diverged = False
        self.body: dict[str, float] = {}

    def state(self, data: TensorDictBase) -> None:
        """Note the arm as it is now and what the policy is shown of it."""
        self.body = dict(
            zip(FACTORS, self._own(self.env.body).tolist(), strict=False)
        )  # empty if it is the nominal one
        rod = self.env.rod
        for name in ROD:
            self.states[name].append(self._own(getattr(rod, name)))
        self.states["contact"].append(self._own(self.env.contacts()))
        self.path.append(self._own(self.env.scene.cylinders.start).astype(np.float64))
        for key in OBSERVED:
            values = data.get(key, None)
            if values is not None:
                name = key if isinstance(key, str) else "/".join(key)
                self.observation.setdefault(name, []).append(self._own(values))

    def step(self, after: TensorDictBase) -> None:
        """Note what a step did and paid."""
        self.steps["action"].append(self._own(self.env.applied_action))
        self.steps["tip_force"].append(self._own(self.env.tip_force).astype(np.float64))
        self.steps["reward"].append(self._own(after[entries.REWARD])[0])
        for name, values in self.terms.items():
            values.append(self._own(after[entries.REWARD_TERMS, name])[0])
        self.success = bool(self._own(after[entries.SUCCESS])[0])
        self.diverged = bool(self._own(after[entries.DIVERGED])[0])

    def attend(self, encoder: Any, frame: TensorDictBase) -> None:
        """Note the attention weights with which the next actions are chosen; ``frame`` ``(1,)``, the arm's own."""
        _, weights = encoder.forward_with_attention(frame)
        for stage, values in weights.items():
            self.attention.setdefault(stage, []).append(values[0].numpy(force=True))

    def trajectory(self, config: dict[str, Any], info: dict[str, Any]) -> Trajectory:
        """Give what was collected."""
        cylinders = self.env.scene.cylinders
        exists = self._own(cylinders.mask)
        path = np.stack(self.path)[:, exists]
        shapes = {name: self._own(getattr(cylinders, name))[exists].astype(np.float64) for name in CYLINDER_FIELDS}
        return Trajectory(
            **{name: np.stack(values) for name, values in (self.states | self.steps).items()},
            target=self._own(self.env.scene.target).astype(np.float64),
            observation={name: np.stack(values) for name, values in self.observation.items()},
            reward_terms={name: np.stack(values) for name, values in self.terms.items()},
            cylinders=shapes | ({"start": path[0], PATH: path} if self.env.task.moves else {}),
            attention={stage: np.stack(values) for stage, values in self.attention.items()},
            success=self.success,
            diverged=self.diverged,
            config=config,
            info=info,
        )

    def _own(self, values: Tensor) -> Array:
        return values[self.row].numpy(force=True).copy()


def _play(
    module: nn.Module, env: SoftArmEnv, row: int, encoder: Any | None, watch: Callable[[], None] | None
) -> _Recorder:
    """One episode in every environment, as ``evaluation.evaluate`` has it, until that of ``row`` ends."""
    recorder = _Recorder(env, row)
    data = env.reset()
    alive = torch.ones(env.batch_size, dtype=torch.bool)
    recorder.state(data)
    while alive[row]:
        if encoder is not None:
            recorder.attend(encoder, seen(module, data[row : row + 1]))
        data = env.step(act(module, data, alive))
        alive = alive & ~data["next", entries.DONE].squeeze(-1)
        recorder.step(data["next"])
        data = step_mdp(data)
        recorder.state(data)
        if watch is not None:
            watch()
    return recorder


def _check(trained: TrainedPolicy, seed: int, episode: int, episodes: int, horizon: int | None) -> None:
    if not kind_of(trained.config.task).has_arm:
        raise UserError(f"task={trained.config.task.name}: it has no arm; trajectories are those of an arm")
    refuse_mixture(trained.config.task)
    if not 0 <= seed < 2**63:
        raise UserError(f"seed={seed}: a seed is a whole number from 0 to 2**63 - 1")
    if episode < 0:
        raise UserError(f"episode={episode}: episodes are counted from 0")
    if episode >= episodes:
        raise UserError(f"episode={episode}: of {episodes} episodes, choose 0 to {episodes - 1}")
    if horizon is not None and horizon < 1:
        raise UserError(f"horizon={horizon}: it must be at least 1")
