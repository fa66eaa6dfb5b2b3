"""The arm's tasks are played by ``SoftArmEnv``, built here from a run's settings."""

from dataclasses import replace

import torch

from softgm_bench.envs.interface import Kind, Settings, register_kind
from softgm_bench.envs.perturbation import PerturbationConfig
from softgm_bench.envs.soft_arm import SoftArmEnv, sizes_of
from softgm_bench.envs.tasks import TASK_CONFIGS, TaskConfig, make_task
from softgm_bench.rod.backend import default_backend, make_backend
from softgm_bench.rod.parameters import RodParameters

SURFACE = ("friction_coefficient", "velocity_damping_coefficient")  # a task's own in place of the rod's, unless null


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
    own = {name: getattr(task_config, name) for name in SURFACE if getattr(task_config, name) is not None}
    rod = make_backend(backend or default_backend(torch.device(device).type), replace(rod_parameters, **own))
    if not curriculum:
        task_config = replace(task_config, curriculum=replace(task_config.curriculum, enabled=False))
    return SoftArmEnv(make_task(task_config), rod, num_envs, seed, horizon, device, dtype, stagger, perturbation)


def _build(settings: Settings, num_envs: int, seed: int, horizon: int | None, training: bool) -> SoftArmEnv:
    return make_env(
        settings.task,
        settings.rod,
        num_envs=num_envs,
        seed=seed,
        horizon=horizon,
        device=settings.device,
        backend=settings.backend,
        dtype=getattr(torch, settings.dtype),
        stagger=training,
        curriculum=training,
        perturbation=settings.perturbation,
    )


def _check(settings: Settings) -> None:
    """Draw one scene on the CPU, where ranges that leave nothing show.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    make_task(settings.task).sample(1, torch.Generator())


ARM = register_kind(
    Kind(
        base=TaskConfig,
        configs=lambda: TASK_CONFIGS,
        build=_build,
        sizes=lambda config: sizes_of(make_task(config)),
        check=_check,
        has_arm=True,
    )
)
