"""Trained policies: read from a run folder, a checkpoint or a file that holds the actor alone."""

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from tensordict.nn import TensorDictModuleBase

from softgm_bench.algorithms import build_algorithm
from softgm_bench.config import Config, UserError, dtype_of, plain, typed
from softgm_bench.envs import make_env
from softgm_bench.experiment import checkpoint
from softgm_bench.experiment.explain import USER_ERRORS
from softgm_bench.experiment.run_folder import RunFolder, write_atomically


@dataclass
class TrainedPolicy:
    """A policy and what it came from.

    Attributes:
        policy: reads ``keys.OBSERVATION``, writes ``keys.ACTION``; deterministic or exploring as the exploration type
            says.
        config: of the run that trained it.
        frames: that it has learnt from.
        versions: of the packages that the run used.
    """

    policy: TensorDictModuleBase
    config: Config
    frames: int
    versions: dict[str, str]


def load(path: Path, device: str = "cpu") -> TrainedPolicy:
    """The policy in a run folder (its newest checkpoint), a checkpoint or a file that ``save`` wrote.

    Raises:
        UserError: there is none, it is damaged, or this version cannot build its networks.
    """
    file = path
    if path.is_dir():
        newest = checkpoint.latest(RunFolder(path).checkpoints)
        if newest is None:
            raise UserError(f"{path}: no checkpoint here; name a run folder, a checkpoint or a policy's file")
        file = newest
    state = checkpoint.load(file, device)
    try:
        config = typed(OmegaConf.create(state["config"]))
        env = make_env(config.task, config.rod, 1, 0, device=device, dtype=dtype_of(config))
        algorithm = build_algorithm(_without_replay(config.algo), config.model, env, config.oracle)
        if "policy" in state:
            algorithm.policy.load_state_dict(state["policy"])
        else:
            algorithm.load_state_dict(state["algorithm"])
    except (KeyError, RuntimeError, ValueError, *USER_ERRORS) as error:
        raise UserError(f"{file}: this version cannot build its networks; use the version that trained it") from error
    return TrainedPolicy(algorithm.policy, config, state["frames"], state["versions"])


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
            "config": plain(trained.config),
            "versions": trained.versions,
        },
        buffer,
    )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, buffer.getvalue())
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; choose a file that can be written") from error


def _without_replay(algo: Any) -> Any:
    """The algorithm's settings with the smallest memory that they admit."""
    if hasattr(algo, "replay_capacity"):
        algo.replay_capacity = max(algo.batch_size, 2)
        algo.checkpoint_replay = False
    return algo
