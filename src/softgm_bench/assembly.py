"""From settings to the things that they mean: environments, policies, algorithms; and whether these can be built."""

from collections.abc import Sequence
from typing import Any

from tensordict.nn import TensorDictModuleBase

from softgm_bench import algorithms
from softgm_bench.algorithms import Algorithm
from softgm_bench.config import Config, compose, validate
from softgm_bench.envs import Sizes, entries, kind_of
from softgm_bench.envs.interface import VECTOR
from softgm_bench.envs.remembering import RememberingEnv
from softgm_bench.errors import UserError
from softgm_bench.models import build_encoder

FITTING = {VECTOR: "vector_mlp"}  # models by layout; the others observe graphs


def configure(overrides: Sequence[str]) -> Config:
    """Compose and check the configuration that ``python -m softgm_bench <overrides>`` runs with.

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


def build_env(config: Config, num_envs: int, seed: int, horizon: int | None = None, training: bool = False) -> Any:
    """Build ``num_envs`` environments of a checked configuration: an ``EnvBase`` that is an ``Environment``.

    Args:
        config: of which task, arm, device, backend, precision and perturbation count.
        num_envs: simulated at once.
        seed: of everything that the environments draw.
        horizon: control steps of an episode; None: the task's own.
        training: staggered clocks and, if it is enabled, the curriculum.
    """
    return kind_of(config.task).build(config, num_envs, seed, horizon, training)


def build_policy(config: Config, sizes: Sizes, frames: int = 0) -> TensorDictModuleBase:
    """Build what acts, with fresh networks and no environment, critic or optimiser; it explores as after ``frames``."""
    return algorithms.build_policy(config.algo, config.model, sizes, config.oracle, frames)


def build_algorithm(config: Config, env: Any) -> Algorithm:
    """Build the algorithm with fresh networks for an environment.

    Raises:
        UserError: settings that do not fit together.
    """
    try:
        return algorithms.build_algorithm(config.algo, config.model, env, config.oracle)
    except ValueError as error:
        raise UserError(str(error)) from error


def check_by_building(config: Config) -> None:
    """Draw one scene and build one network: what only they can refuse is refused before anything is written.

    Raises:
        UserError: with one line naming the key, its value and what would be right.
    """
    kind = kind_of(config.task)
    try:
        kind.check(config)
        env = kind.build(config, 1, config.seed, None, True)
        observed = set(env.observation_spec.keys(True, True))
        if entries.PREVIOUS_ACTION not in observed:
            _refuse_previous_action(config)
        if getattr(getattr(config.algo, "actor", None), "memory", None) and not isinstance(env, RememberingEnv):
            raise ValueError(
                f"algo.actor.memory: task={config.task.name} hands no memory on from step to step; it must be null"
            )
        if env.sizes.layout == VECTOR and getattr(getattr(config.algo, "critic", None), "mlp", None) is not None:
            raise ValueError(
                "algo.critic.mlp: it reads the arm's observation, "
                f"which task={config.task.name} has not; it must be null"
            )
        encoder = build_encoder(config.model, env.sizes)
    except ValueError as error:
        raise UserError(str(error)) from error
    if not observed.issuperset(encoder.in_keys):
        fitting = FITTING.get(env.sizes.layout, "mlp or softgm")
        raise UserError(f"task={config.task.name} cannot be observed by this model: add model={fitting}")


def _refuse_previous_action(config: Config) -> None:
    """Refuse settings by which a policy reads its previous action where that is not observed.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    needing = {
        "algo.noise_correlation": getattr(config.algo, "noise_correlation", 0.0),
        "algo.actor.persistence": getattr(getattr(config.algo, "actor", None), "persistence", 0.0),
    }
    for key, value in needing.items():
        if value:
            task = f"task={config.task.name}"
            raise ValueError(f"{key} is {value}: {task} does not show agents their previous action; it must be 0")
