"""The environment that a configuration means, and whether what it means can be built."""

from collections.abc import Sequence

import torch

from softgm_bench.config import Config, UserError, compose, dtype_of, validate
from softgm_bench.envs import SoftArmEnv, make_env
from softgm_bench.envs.tasks import make_task
from softgm_bench.envs.vmas import VmasConfig, VmasEnv
from softgm_bench.models import build_encoder


def configure(overrides: Sequence[str]) -> Config:
    """The checked configuration that ``python -m softgm_bench <overrides>`` runs with.

    Raises:
        UserError: a value that makes no sense.
        HydraException, OmegaConfBaseException: an override that cannot be read, a misspelt key or a wrong type.
    """
    config = compose(list(overrides))
    check(config)
    return config


def check(config: Config) -> None:
    """Refuse settings that make no sense, each by itself or together.

    Raises:
        UserError: with one line naming the key, its value and what would be right.
    """
    validate(config)
    check_by_building(config)


def build_env(
    config: Config, num_envs: int, seed: int, horizon: int | None = None, training: bool = False
) -> SoftArmEnv | VmasEnv:
    """``num_envs`` environments of a checked configuration.

    Args:
        config: of which task, arm, device, backend, precision and perturbation count.
        num_envs: simulated at once.
        seed: of everything that the environments draw.
        horizon: control steps of an episode; None: the task's own.
        training: staggered clocks and, if it is enabled, the curriculum.
    """
    if isinstance(config.task, VmasConfig):
        return VmasEnv(config.task, num_envs, seed, horizon)
    return make_env(
        config.task,
        config.rod,
        num_envs=num_envs,
        seed=seed,
        horizon=horizon,
        device=config.device,
        backend=config.backend,
        dtype=dtype_of(config),
        stagger=training,
        curriculum=training,
        perturbation=config.perturbation,
    )


def check_by_building(config: Config) -> None:
    """Draw one scene and build one network: what only they can refuse is refused before anything is written.

    Raises:
        UserError: with one line naming the key, its value and what would be right.
    """
    try:
        if isinstance(config.task, VmasConfig):
            _check_vmas(config)
            env = VmasEnv(config.task, 1, config.seed)
        else:
            make_task(config.task).sample(1, torch.Generator())  # on the CPU, where ranges that leave nothing show
            env = make_env(
                config.task,
                config.rod,
                1,
                config.seed,
                device=config.device,
                backend=config.backend,
                dtype=dtype_of(config),
                curriculum=True,
                perturbation=config.perturbation,
            )
        observed = set(env.observation_spec.keys(True, True))
        encoder = build_encoder(config.model, env.n_agents, env.n_slots)
    except ValueError as error:
        raise UserError(str(error)) from error
    if not observed.issuperset(encoder.in_keys):
        fitting = "vector_mlp" if isinstance(config.task, VmasConfig) else "mlp or softgm"
        raise UserError(f"task={config.task.name} cannot be observed by this model: add model={fitting}")


def _check_vmas(config: Config) -> None:
    """Refuse what only the arm has.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    task = f"task={config.task.name}"
    if config.device != "cpu":
        raise ValueError(f"device={config.device}: {task} runs on the CPU")
    if not config.perturbation.nothing:
        raise ValueError(f"perturbation={config.perturbation.name}: {task} has no arm; it must be none")
    if config.oracle:
        raise ValueError(f"observation=oracle: {task} has nothing that an oracle would be told")
    needing_memory = {
        "algo.noise_correlation": getattr(config.algo, "noise_correlation", 0.0),
        "algo.actor.persistence": getattr(getattr(config.algo, "actor", None), "persistence", 0.0),
    }
    for key, value in needing_memory.items():
        if value:
            raise ValueError(f"{key} is {value}: {task} does not show agents their previous action; it must be 0")
    if getattr(getattr(config.algo, "critic", None), "mlp", None) is not None:
        raise ValueError(f"algo.critic.mlp: it reads the arm's observation, which {task} has not; it must be null")
