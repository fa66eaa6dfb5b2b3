"""Trained policies: read from a run folder, a checkpoint or a file that holds the actor alone."""

import io
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase

from softgm_bench.algorithms import Algorithm, build_algorithm
from softgm_bench.algorithms.off_policy import OffPolicy
from softgm_bench.assembly import build_env, check
from softgm_bench.config import Config, UserError, changed, plain, typed, validate_device
from softgm_bench.config.explain import USER_ERRORS
from softgm_bench.envs.vmas import VmasConfig
from softgm_bench.runs import checkpoint
from softgm_bench.runs.folder import RunFolder, write_where_asked


@dataclass
class TrainedPolicy:
    """A policy, what it came from, and where it is to act.

    Attributes:
        policy: reads ``keys.OBSERVATION``, writes ``keys.ACTION``; deterministic or exploring as the exploration type
            says.
        config: to act in: the run's, on the device and with the settings that were asked for.
        frames: that it has learnt from.
        versions: of the packages that the run used.
        run: configuration of the run that trained it.
    """

    policy: TensorDictModuleBase
    config: Config
    frames: int
    versions: dict[str, str]
    run: Config

    @property
    def label(self) -> str:
        """The algorithm's name as results carry it, whatever the policy is to act in."""
        return self.run.label


def load(path: Path, device: str = "cpu", overrides: Sequence[str] = ()) -> TrainedPolicy:
    """The policy in a run folder (its newest checkpoint), a checkpoint or a file that ``save`` wrote.

    Args:
        path: of one of them.
        device: to act on.
        overrides: settings ``key=value`` to act in instead of the run's; see ``softgm_bench.config.changed``. Its
            networks must take what is observed there: SoftGM's take any N and M, an MLP's any N.

    Raises:
        UserError: there is none, it is damaged, this version cannot build its networks, they do not fit the settings,
            or the settings make no sense.
        HydraException, OmegaConfBaseException: a setting cannot be read, is misspelt or of a wrong type.
    """
    validate_device(device)
    file = _file(path)
    state = checkpoint.load(file, device)
    try:
        run = typed(OmegaConf.create(state["config"]))
        trained, slots = _build(_on(run, device))
        if "policy" in state:
            trained.policy.load_state_dict(state["policy"])
        else:
            trained.load_state_dict(state["algorithm"])
        _settle(trained, state["frames"])
        policy = trained.policy
        result = TrainedPolicy(policy, _on(run, device), state["frames"], state["versions"], run)
    except (KeyError, AttributeError, TypeError, RuntimeError, ValueError, *USER_ERRORS) as error:
        raise UserError(
            f"{file}: this version cannot build its networks; use the version that trained it, with the same plugins"
        ) from error
    if overrides:
        result.config = changed(plain(result.config), overrides)
        result.policy = _fitted(file, result, slots)
    return result


def save(trained: TrainedPolicy, path: Path) -> None:
    """Write what acting needs: the actor's parameters and the configuration; no critic, optimiser or simulation.

    Raises:
        UserError: the file cannot be written.
    """
    buffer = io.BytesIO()
    torch.save(
        {
            "format": checkpoint.FORMAT,
            "frames": trained.frames,
            "policy": trained.policy.state_dict(),
            "config": plain(trained.run),
            "versions": trained.versions,
        },
        buffer,
    )
    write_where_asked(path, buffer.getvalue())


def _file(path: Path) -> Path:
    if not path.is_dir():
        return path
    newest = checkpoint.latest(RunFolder(path).checkpoints)
    if newest is None:
        raise UserError(f"{path}: no checkpoint here; name a run folder, a checkpoint or a policy's file")
    return newest


def _on(config: Config, device: str) -> Config:
    """The configuration on a device, where the other device's kernel is replaced by its own."""
    foreign = "cuda" if device == "cpu" else "numba"
    return replace(config, device=device, backend=None if config.backend == foreign else config.backend)


def _build(config: Config) -> tuple[Algorithm, int]:
    """The algorithm with fresh networks, and how many obstacle slots it observes."""
    env = build_env(config, 1, 0)
    return build_algorithm(_without_replay(config.algo), config.model, env, config.oracle), env.n_slots


def _fitted(file: Path, trained: TrainedPolicy, slots: int) -> TensorDictModuleBase:
    """The trained policy for what is observed in ``trained.config`` instead of ``slots`` obstacle slots."""
    config, run = trained.config, trained.run
    task = f"task={config.task.name}"
    if isinstance(config.task, VmasConfig) is not isinstance(run.task, VmasConfig):
        raise UserError(f"{file}: it was trained on {run.task.name}, whose observations are not those of {task}")
    check(replace(config, threads=None))  # the run's may be more than this machine has
    fitted, found = _build(config)
    try:
        fitted.policy.load_state_dict(trained.policy.state_dict())
    except RuntimeError as error:
        advice = f": add task.slots={slots}" if slots and found else ""
        raise UserError(
            f"{file}: its networks read {slots} obstacle slots, {task} with {config.task.n_agents} agents has {found}"
            f"{advice}"
        ) from error
    _settle(fitted, trained.frames)
    return fitted.policy


def _settle(algorithm: Algorithm, frames: int) -> None:
    """Let it explore as after so many frames of training, if it is asked to explore."""
    if isinstance(algorithm, OffPolicy):
        algorithm.frames = frames
        algorithm._schedule()


def _without_replay(algo: Any) -> Any:
    """The algorithm's settings with the smallest memory that they admit."""
    if not hasattr(algo, "replay_capacity"):
        return algo
    return replace(algo, replay_capacity=max(algo.batch_size, 2), checkpoint_replay=False)
