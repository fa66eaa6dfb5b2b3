"""Checks of settings that have the right types, as far as they need nothing built."""

import os
import re

from softgm_bench.config.schema import BF16, COMPILES, DTYPES, GRAPHS, MATMULS, OBSERVATIONS, TF32, Config
from softgm_bench.errors import UserError
from softgm_bench.rod.backend import BACKENDS, check_backend


def validate(config: Config) -> None:
    """Refuse settings that have the right types and make no sense; ``assembly.check_by_building`` finds the rest.

    Raises:
        UserError: naming the first such key, its value and what would be right.
    """
    experiment, evaluation, checkpoint = config.experiment, config.experiment.evaluation, config.experiment.checkpoint
    if not 0 <= config.seed < 2**63:
        raise UserError(f"seed={config.seed}: a seed is a whole number from 0 to 2**63 - 1")
    at_least_one = {
        "experiment.total_frames": experiment.total_frames,
        "experiment.num_envs": experiment.num_envs,
        "experiment.steps_per_batch": experiment.steps_per_batch,
        "experiment.train_horizon": experiment.train_horizon,
        "experiment.evaluation.interval": evaluation.interval,
        "experiment.evaluation.episodes": evaluation.episodes,
        "experiment.evaluation.final_episodes": evaluation.final_episodes,
        "experiment.evaluation.horizon": evaluation.horizon,
        "experiment.evaluation.final_horizon": evaluation.final_horizon,
        "experiment.checkpoint.interval": checkpoint.interval,
        "experiment.checkpoint.keep": checkpoint.keep,
    }
    for key, value in at_least_one.items():
        if value is not None and value < 1:
            raise UserError(f"{key}={value}: it must be at least 1")
    if experiment.minutes is not None and not experiment.minutes > 0.0:
        raise UserError(f"experiment.minutes={experiment.minutes}: it must be above 0, or null")
    if config.start.critic_frames < 0:
        raise UserError(f"start.critic_frames={config.start.critic_frames}: it must not be negative")
    if not config.run_dir:
        raise UserError("run_dir is empty: name a folder for the run")
    if config.observation not in OBSERVATIONS:
        raise UserError(f"observation={config.observation}: choose one of {', '.join(OBSERVATIONS)}")
    if config.oracle and "oracle" not in config.run_dir:
        raise UserError(f"run_dir={config.run_dir} with observation=oracle: put the word oracle into the folder's name")
    _validate_machine(config)


def available_threads() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _validate_machine(config: Config) -> None:
    cores = available_threads()
    if config.threads is not None and not 1 <= config.threads <= cores:
        raise UserError(f"threads={config.threads}: choose 1 to {cores}, the cores of this machine, or null")
    if config.backend is not None and config.backend not in BACKENDS:
        raise UserError(f"backend={config.backend}: choose one of {', '.join(BACKENDS)}, or null")
    if config.dtype not in DTYPES:
        raise UserError(f"dtype={config.dtype}: choose one of {', '.join(DTYPES)}")
    if config.compile is not None and config.compile not in COMPILES:
        raise UserError(f"compile={config.compile}: choose one of {', '.join(COMPILES)}, or null")
    if config.matmul is not None and config.matmul not in MATMULS:
        raise UserError(f"matmul={config.matmul}: choose one of {', '.join(MATMULS)}, or null")
    kind = device_type(config.device)
    if config.matmul == (BF16 if kind == "cuda" else TF32):
        raise UserError(f"matmul={config.matmul} with device={config.device}: tf32 is for device=cuda, bf16 for a CPU")
    if config.compile == GRAPHS and kind == "cpu":
        raise UserError(
            f"compile={GRAPHS} with device={config.device}: CUDA graphs need device=cuda; choose none or null"
        )
    if config.backend is not None:
        try:
            check_backend(config.backend, kind, config.dtype)
        except ValueError as error:
            raise UserError(str(error)) from error
    validate_device(config.device)


def device_type(device: str) -> str:
    """Give ``cpu`` or ``cuda``.

    Raises:
        UserError: the name is no device's.
    """
    if not re.fullmatch(r"cpu|cuda(:\d+)?", device):
        raise UserError(f"device={device}: choose cpu, cuda or cuda:<index>")
    return device.partition(":")[0]


def validate_device(device: str) -> None:
    """Refuse a device that there is not.

    Raises:
        UserError: saying what there is.
    """
    if device_type(device) == "cpu":
        return
    import torch  # late: it takes seconds

    if int(device.partition(":")[2] or 0) >= torch.cuda.device_count():
        raise UserError(f"device={device}: this machine has {torch.cuda.device_count()} CUDA devices")
