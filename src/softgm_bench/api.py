"""The commands as Python functions. ``overrides`` are settings as on the command line: ``"task=wall"``, ``"seed=1"``.

Everything raises ``UserError`` with one line about what is wrong; Hydra and OmegaConf raise their own for settings that
cannot be read. Loading this module takes seconds, for torch.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench import assembly, plugins
from softgm_bench.algorithms import Algorithm
from softgm_bench.assembly import build_env
from softgm_bench.config import Config
from softgm_bench.envs import entries
from softgm_bench.episodes import folder as evaluation_folder
from softgm_bench.episodes import policy, recording
from softgm_bench.episodes.evaluation import DISCOUNT, EpisodeRecords
from softgm_bench.episodes.policy import TrainedPolicy
from softgm_bench.episodes.protocol import Protocol, check_seed, whole_from_one
from softgm_bench.episodes.summary import summarise, table
from softgm_bench.episodes.trajectory import Trajectory
from softgm_bench.errors import UserError
from softgm_bench.runs import loop

Source = str | Path | TrainedPolicy
add_plugins = plugins.add


@dataclass(frozen=True)
class TrainedRun:
    """A run that has finished.

    Attributes:
        folder: of its files.
        summary: what ``summary.json`` holds.
    """

    folder: Path
    summary: dict[str, Any]


@dataclass(frozen=True)
class Evaluation:
    """Episodes that a policy has played.

    Attributes:
        records: one entry an episode.
        metrics: mean and standard deviation of everything, the success rate with its interval; ``print`` shows them.
    """

    records: EpisodeRecords
    metrics: dict[str, Any]

    def __str__(self) -> str:
        """A table."""
        return table(self.metrics, f"{self.metrics['episodes']} episodes:")


def configure(*overrides: str) -> Config:
    """The checked settings that ``python -m softgm_bench <overrides>`` runs with."""
    return assembly.configure(overrides)


def make_env(*overrides: str, num_envs: int = 1, seed: int = 0, horizon: int | None = None) -> EnvBase:
    """A TorchRL environment of ``num_envs`` arms, as evaluations use it.

    Args:
        overrides: settings, of which task, arm, perturbation, device, backend and precision count.
        num_envs: simulated at once.
        seed: of everything that the environments draw.
        horizon: control steps of an episode; None: the task's own.
    """
    whole_from_one("num_envs", num_envs)
    whole_from_one("horizon", horizon, optional=True)
    check_seed(seed)
    return build_env(configure(*overrides), num_envs, seed, horizon)


def build_algorithm(config: Config, env: EnvBase) -> Algorithm:
    """The algorithm that the settings mean, with fresh networks for ``env``: for a training loop of your own."""
    return assembly.build_algorithm(config, env)


def train(*overrides: str) -> TrainedRun:
    """Train and evaluate, as ``python -m softgm_bench <overrides>`` does; Ctrl-C leaves a checkpoint."""
    config = configure(*overrides)
    return TrainedRun(Path(config.run_dir), loop.train(config))


def load(source: str | Path, *overrides: str, device: str = "cpu") -> TrainedPolicy:
    """The policy in a run folder (its newest checkpoint), a checkpoint or a policy's file.

    Args:
        source: of one of them.
        overrides: settings to act in instead of the run's: a task, an arm, a perturbation, or single keys of them.
        device: to act on.
    """
    return policy.load(Path(source), device, overrides)


def act(
    trained: TrainedPolicy | TensorDictModuleBase, observation: TensorDictBase, deterministic: bool = True
) -> Tensor:
    """Actions ``(num_envs, N, 2)`` in [-1, 1] for what ``env.reset()`` or ``step_mdp(env.step(...))`` gave.

    What a policy with memory has to remember is written into ``observation``, with which ``env.step`` takes it on.
    """
    module = trained.policy if isinstance(trained, TrainedPolicy) else trained
    remembers = entries.MEMORY in module.in_keys
    optional = [entries.MEMORY] if remembers and observation.get(entries.MEMORY, None) is None else []
    with torch.no_grad(), set_exploration_type(_exploration(deterministic)):
        chosen = module(observation.select(*(key for key in module.in_keys if key not in optional)))
    if remembers:
        observation.set(entries.NEXT_MEMORY, chosen.get(entries.NEXT_MEMORY))
    return chosen[entries.ACTION]


def rollout(
    env: EnvBase,
    trained: TrainedPolicy | TensorDictModuleBase | None = None,
    steps: int = 100,
    deterministic: bool = True,
) -> TensorDictBase:
    """``steps`` control steps from a reset on, ``(num_envs, steps)``; an arm whose episode ends begins another.

    Args:
        env: of ``make_env``.
        trained: who acts; None: actions are uniform.
        steps: control steps.
        deterministic: act by the mode of the policy, otherwise by a sample.
    """
    whole_from_one("steps", steps)
    module = trained.policy if isinstance(trained, TrainedPolicy) else trained
    with torch.no_grad(), set_exploration_type(_exploration(deterministic)):
        return env.rollout(steps, module, break_when_any_done=False)


def evaluate(
    source: Source,
    *overrides: str,
    episodes: int = 100,
    seed: int = 0,
    deterministic: bool = True,
    horizon: int | None = None,
    gamma: float = DISCOUNT,
    batch: int | None = None,
    intervention: str = "none",
    out: str | Path | None = None,
) -> Evaluation:
    """Play ``episodes`` episodes that training has never seen, as ``python -m softgm_bench.evaluate`` does.

    Args:
        source: as ``load`` takes it, or what it gave.
        overrides: settings to act in, as for ``load``.
        episodes: one in each environment.
        seed: of targets, obstacles and perturbations; the same gives the same episodes.
        deterministic: act by the mode of the policy, otherwise by a sample.
        horizon: control steps of an episode; None: the task's own.
        gamma: of the discounted return.
        batch: environments at once, to save memory; None: all. Others play other episodes.
        intervention: what the policy is shown in place of what its agents see; see ``episodes.interventions``.
        out: folder for ``episodes.csv`` and ``summary.json``; None: nothing is written.
    """
    protocol = Protocol(episodes, seed, deterministic, horizon, gamma, batch, intervention)
    protocol.check()
    trained = _loaded(source, overrides)
    protocol.check_fits(trained)
    if out is not None:
        evaluation_folder.check(Path(out), overwrite=False)
    records = protocol.play(trained)
    if out is not None:
        settings = protocol.describe(trained, overrides)
        evaluation_folder.write(Path(out), records, evaluation_folder.describe(trained, records, settings))
    return Evaluation(records, summarise(records))


def record(
    source: Source,
    *overrides: str,
    seed: int = 0,
    episode: int = 0,
    horizon: int | None = None,
    deterministic: bool = True,
    attention: bool = False,
) -> Trajectory:
    """One episode of an evaluation as arrays, for ``trajectory.save`` and for drawing; see ``recording.record``."""
    return recording.record(_loaded(source, overrides), seed, episode, horizon, deterministic, attention)


def _loaded(source: Source, overrides: tuple[str, ...]) -> TrainedPolicy:
    if not isinstance(source, TrainedPolicy):
        return load(source, *overrides)
    if overrides:
        raise UserError(f"{overrides[0]}: the policy is loaded already; give its settings to load")
    return source


def _exploration(deterministic: bool) -> ExplorationType:
    return ExplorationType.DETERMINISTIC if deterministic else ExplorationType.RANDOM
