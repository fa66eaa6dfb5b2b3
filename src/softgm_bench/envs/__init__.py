"""The soft arm as TorchRL environments."""

from dataclasses import replace

import torch

from softgm_bench.envs.perturbation import PerturbationConfig
from softgm_bench.envs.soft_arm import SoftArmEnv
from softgm_bench.envs.tasks import TaskConfig, make_task
from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import RodParameters


def make_env(
    task_config: TaskConfig,
    rod_parameters: RodParameters,
    num_envs: int,
    seed: int,
    horizon: int | None = None,
    device: torch.device | str = "cpu",
    backend: str | None = None,
    dtype: torch.dtype = torch.float64,
    stagger: bool = False,
    curriculum: bool = False,
    perturbation: PerturbationConfig | None = None,
) -> SoftArmEnv:
    """Build ``num_envs`` environments of one task; see ``SoftArmEnv`` for the arguments.

    ``curriculum``: for training alone, follow the task's if it is enabled; otherwise all scenes are the task's own.
    ``backend`` is a name that ``make_backend`` knows; None: the fused kernel of the device.
    """
    fused = "numba" if torch.device(device).type == "cpu" else "cuda"
    rod = make_backend(backend or fused, rod_parameters)
    if not curriculum:
        task_config = replace(task_config, curriculum=replace(task_config.curriculum, enabled=False))
    return SoftArmEnv(make_task(task_config), rod, num_envs, seed, horizon, device, dtype, stagger, perturbation)


__all__ = ["PerturbationConfig", "SoftArmEnv", "make_env"]
