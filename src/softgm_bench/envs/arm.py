"""The arm's tasks are played by ``SoftArmEnv``, built here from a run's settings."""

import math
from dataclasses import replace
from typing import Any

import torch

from softgm_bench.envs.interface import Kind, Settings, register_kind
from softgm_bench.envs.perturbation import PerturbationConfig
from softgm_bench.envs.soft_arm import SoftArmEnv, sizes_of
from softgm_bench.envs.tasks import TASK_CONFIGS, TaskConfig, make_task
from softgm_bench.rod import forks
from softgm_bench.rod.backend import default_backend, make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.randomise import RandomiseConfig
from softgm_bench.rod.stability import check_time_step

SCENES = 1024  # of a check

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
    randomise: RandomiseConfig | None = None,
) -> SoftArmEnv:
    """Build ``num_envs`` environments of one task; see ``SoftArmEnv`` for the arguments.

    ``curriculum``: for training alone, follow the task's if it is enabled; otherwise all scenes are the task's own.
    ``backend`` is a name that ``make_backend`` knows; None: the fused kernel of the device.
    """
    rod = make_backend(backend or default_backend(torch.device(device).type), _surfaced(task_config, rod_parameters))
    if not curriculum:
        task_config = replace(task_config, curriculum=replace(task_config.curriculum, enabled=False))
    disturbed = (perturbation, randomise)
    return SoftArmEnv(make_task(task_config), rod, num_envs, seed, horizon, device, dtype, stagger, *disturbed)


def _surfaced(task_config: TaskConfig, parameters: RodParameters) -> RodParameters:
    """Give the arm the surface that it has on a task."""
    own = {name: getattr(task_config, name) for name in SURFACE if getattr(task_config, name) is not None}
    return replace(parameters, **own)


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
        randomise=settings.randomise,
    )


def _check(settings: Settings) -> None:
    """Refuse steps that are too long, more sections than nodes, and tasks with nothing to draw or out of reach.

    Scenes are drawn on the CPU, where ranges that leave nothing show.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    forks.check()  # before tensors are computed with
    config, rod = settings.task, settings.rod
    check_time_step(rod)
    settings.randomise.check(_surfaced(config, rod))
    if config.n_agents >= rod.n_elements:
        raise ValueError(
            f"task.n_agents={config.n_agents} with rod.n_elements={rod.n_elements}: every section needs an inner node "
            f"of its own and there are {rod.n_elements - 1}; give fewer or rod.n_elements={config.n_agents + 1}"
        )
    task, drawn = make_task(config), torch.Generator()
    scenes = [task.sample(SCENES, drawn)]
    if config.curriculum.enabled:
        scenes.append(task.sample(SCENES, drawn, torch.zeros((), dtype=torch.float64)))
    reach = rod.base_length + config.success_radius
    furthest = max(float(scene.target.norm(dim=-1).max()) for scene in scenes)
    if furthest > reach:
        keys = ", ".join(f"task.{name}={list(value)}" for name, value in _targets(config).items())
        raise ValueError(
            f"rod.base_length={rod.base_length} with {keys or f'task={config.name}'}: targets lie up to "
            f"{furthest:.2f} m from the base, the arm reaches {reach:.2f} m; bring them nearer or give "
            f"rod.base_length={math.ceil(100 * furthest) / 100}"
        )
    if (tip := getattr(config, "resting_tip", None)) is not None and abs(tip[2] - rod.base_length) > 1e-9:
        raise ValueError(
            f"task.resting_tip={list(tip)} with rod.base_length={rod.base_length}: "
            f"the arm's tip rests at {[0.0, 0.0, rod.base_length]}"
        )
    if reach < (way := getattr(config, "max_path", 0.0)) < math.inf:
        raise ValueError(
            f"task.max_path={way} with rod.base_length={rod.base_length}: the arm's way to a target is at most "
            f"{reach:.2f} m; give task.max_path={0.92 * rod.base_length:.3g}"
        )


def _targets(config: TaskConfig) -> dict[str, Any]:
    """Settings of a task that say where targets are."""
    return {name: value for name, value in vars(config).items() if name.startswith("target_") and "angle" not in name}


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
