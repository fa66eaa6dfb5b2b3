"""From settings to the things that they mean: environments, policies, algorithms; and whether these can be built."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs import EnvBase

from softgm_bench import algorithms
from softgm_bench.algorithms import Algorithm
from softgm_bench.config import Config, compose, validate
from softgm_bench.config.schema import GRAPHS, model_name
from softgm_bench.envs import SectionMixture, Sizes, entries, kind_of
from softgm_bench.envs.interface import VECTOR
from softgm_bench.envs.remembering import RememberingEnv
from softgm_bench.envs.section_mixture import members, refuse_mixture, shares
from softgm_bench.errors import UserError
from softgm_bench.models import build_encoder
from softgm_bench.models.registry import Encoder

FITTING = {VECTOR: "vector_mlp"}  # models by layout; the others observe graphs
MOST_PARAMETERS = 10**9  # of a network that acts for one section


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
        config: of which task, arm, its bodies, device, backend, precision and perturbation count.
        num_envs: simulated at once.
        seed: of everything that the environments draw.
        horizon: control steps of an episode; None: the task's own.
        training: staggered clocks and, if it is enabled, the curriculum.

    Raises:
        UserError: the task has several numbers of sections.
    """
    refuse_mixture(config.task)
    return kind_of(config.task).build(config, num_envs, seed, horizon, training)


def build_envs(
    config: Config, num_envs: int, seed: int, horizon: int | None = None, training: bool = False
) -> EnvBase | SectionMixture:
    """``build_env``; or ``num_envs`` environments in all, shared out among a task's several numbers of sections.

    In training no two numbers draw the same scenes; otherwise all draw from ``seed``.
    """
    of_number = members(config)
    if not of_number:
        return build_env(config, num_envs, seed, horizon, training)
    seeds = [seed] * len(of_number)
    if training:
        seeds[1:] = np.random.SeedSequence(seed).generate_state(len(of_number) - 1).tolist()
    each = zip(of_number.items(), shares(num_envs, len(of_number)), seeds, strict=True)
    return SectionMixture(
        {number: build_env(one, count, own, horizon, training) for (number, one), count, own in each if count}
    )


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
    of_number = members(config)
    for one in of_number.values() or [config]:
        _check_one(one)
    if of_number:
        _check_mixture(config, of_number)


def _check_mixture(config: Config, of_number: Mapping[int, Config]) -> None:
    """Refuse a mixture that the algorithm, its networks or the run cannot have.

    Raises:
        UserError: with one line naming the key, its value and what would be right.
    """
    given = f"task.n_agents={list(of_number)}"
    advice = "give task.n_agents one number, or choose algo=softgm or ippo"
    if not algorithms.learns_mixtures(config.algo):
        raise UserError(f"{given}: algo={config.algo.name} learns from arms of one number of sections; {advice}")
    if config.experiment.num_envs < len(of_number):
        raise UserError(f"experiment.num_envs={config.experiment.num_envs} with {given}: at least one for each number")
    if config.compile == GRAPHS:
        raise UserError(f"compile={GRAPHS} with {given}: a mixture is not recorded; choose none or null")
    shapes: list[dict[str, torch.Size]] = []
    for one in of_number.values():
        learner = build_algorithm(one, build_env(one, 1, config.seed))
        shapes.append({name: value.shape for name, value in algorithms.named_parameters(learner)})
    other = next((name for one in shapes for name in one if one[name] != shapes[0].get(name)), None)
    if other is not None:
        raise UserError(
            f"{given}: {other} of algo={config.algo.name} has another shape for each number of sections; "
            "give algo.critic.pooling=mean, or task.n_agents one number"
        )


def _check_one(config: Config) -> None:
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
        if getattr(getattr(config.algo, "actor", None), "mirror", None):
            _refuse_mirror(config, env.sizes)
        encoder = _outlined(config.model, env.sizes)
    except ValueError as error:
        raise UserError(str(error)) from error
    if not observed.issuperset(encoder.in_keys):
        fitting = FITTING.get(env.sizes.layout, "mlp or softgm")
        raise UserError(f"task={config.task.name} cannot be observed by this model: add model={fitting}")


def _outlined(model: Any, sizes: Sizes) -> Encoder:
    """Build a network without memory for its parameters.

    Raises:
        ValueError: it has more parameters than anything that could be meant, with one line naming the model.
    """
    advice = f"model={model_name(model)} of these sizes has more than {MOST_PARAMETERS:,} parameters; give smaller ones"
    try:
        with torch.device("meta"):
            encoder = build_encoder(model, sizes)
    except (RuntimeError, OverflowError) as error:  # more than a tensor can have
        raise ValueError(advice) from error
    if sum(parameter.numel() for parameter in encoder.parameters()) > MOST_PARAMETERS:
        raise ValueError(advice)
    return encoder


def _refuse_mirror(config: Config, sizes: Sizes) -> None:
    """Refuse a mirrored policy where what it reads has no mirror image.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    mirror, task = f"algo.actor.mirror is {config.algo.actor.mirror}", f"task={config.task.name}"
    if sizes.layout == VECTOR:
        raise ValueError(f"{mirror}: {task} shows a plain vector, whose mirror image is unknown; it must be null")
    if config.oracle and len(sizes.privileged_image) != sizes.n_privileged:
        raise ValueError(
            f"{mirror} with observation=oracle: {task} does not say what mirrors the numbers that an oracle is told "
            "(privileged_image); it must be null"
        )


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
