"""The settings of a run: their types, how they are composed from ``conf/`` and what they must satisfy.

Values live in YAML only, except the arm's, whose dataclass is the source. Hydra composes the YAML; ``typed`` then holds
it against the dataclasses, so a misspelt key or a wrong type is refused wherever it was written.
"""

import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, get_origin, get_type_hints

from hydra import compose as hydra_compose
from hydra import initialize_config_dir
from hydra.core.config_store import ConfigStore
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from softgm_bench import plugins
from softgm_bench.config.loggers import LoggerConfig
from softgm_bench.errors import UserError
from softgm_bench.rod.parameters import RodParameters

DTYPES = ("float64", "float32")
OBSERVATIONS = ("standard", "oracle")
GROUPS = ("task", "rod", "perturbation")  # chosen by name, which trained policies can be evaluated with others of
CHANGEABLE = (*GROUPS, "backend", "dtype")


@dataclass
class EvaluationConfig:
    """When and how the policy is evaluated; see ``conf/experiment/default.yaml``."""

    interval: int
    episodes: int
    final_episodes: int
    deterministic: bool
    horizon: int | None
    final_horizon: int | None


@dataclass
class CheckpointConfig:
    """When checkpoints are written; see ``conf/experiment/default.yaml``."""

    interval: int
    keep: int


@dataclass
class ExperimentConfig:
    """How long to train and how often to look; see ``conf/experiment/default.yaml``."""

    total_frames: int
    num_envs: int
    steps_per_batch: int
    train_horizon: int | None
    evaluation: EvaluationConfig
    checkpoint: CheckpointConfig


@dataclass
class Config:
    """Everything that a run depends on; see ``conf/config.yaml``.

    ``task``, ``algo`` and ``model`` are instances of the dataclass that the key ``name`` in their YAML stands for.
    """

    seed: int
    observation: str
    device: str
    backend: str | None
    dtype: str
    threads: int | None
    run_dir: str
    overwrite: bool
    resume: bool
    task: Any
    algo: Any
    model: Any
    rod: RodParameters
    experiment: ExperimentConfig
    perturbation: Any  # a PerturbationConfig, which brings torch along
    logger: LoggerConfig

    @property
    def oracle(self) -> bool:
        """Whether actors are told what they would have to discover: an upper bound, not a competitor."""
        return self.observation == "oracle"

    @property
    def label(self) -> str:
        """The algorithm's name as results carry it."""
        return labelled(self.algo.name, plain(self)["model"]["name"], self.observation, self.perturbation.name)


def labelled(algo: str, model: str, observation: str, perturbation: str) -> str:
    """``algo``, and whatever in model, observation and perturbation makes its results another kind's.

    SoftGM and its ablations have the model that they are named after, the other algorithms an MLP; any other is named.
    """
    own = "softgm" if algo.startswith("softgm") else "mlp"
    usual = {own: model, "standard": observation, "none": perturbation}
    return "_".join([algo, *(value for default, value in usual.items() if value != default)])


# For conf/config.yaml: the run folder's name.
OmegaConf.register_new_resolver("labelled", labelled, replace=True)

# The arm's YAML is written by its dataclass, so that its values stand in one place.
ConfigStore.instance().store(group="rod", name="paper", node=asdict(RodParameters()))


def config_directory() -> Path:
    """Folder of the YAML files: inside an installed package, or at the top of the repository."""
    package = Path(__file__).resolve().parents[1]
    installed = package / "conf"
    return installed if installed.is_dir() else package.parents[1] / "conf"


def compose(overrides: list[str]) -> Config:
    """The configuration that ``python -m softgm_bench <overrides>`` runs with, checked.

    Raises:
        UserError: a value that makes no sense.
        HydraException, OmegaConfBaseException: an override that cannot be read, a misspelt key or a wrong type.
    """
    config = typed(compose_untyped(overrides))
    validate(config)
    return config


def compose_untyped(overrides: list[str]) -> DictConfig:
    """What the YAML files and the overrides say, before it is held against the dataclasses."""
    with initialize_config_dir(version_base="1.3", config_dir=str(config_directory())), composing():
        return hydra_compose("config", overrides)


@contextmanager
def composing() -> Iterator[None]:
    """Around Hydra's composition, which refuses some settings, such as ``task=0``, with an error of Python's own.

    Raises:
        UserError: instead of it.
    """
    try:
        yield
    except (ValueError, TypeError, AttributeError, AssertionError) as error:
        reason = next(iter(str(error).splitlines()), type(error).__name__)
        raise UserError(f"the settings cannot be composed: {reason}; task, algo and the like take a name") from error


def typed(composed: DictConfig) -> Config:
    """Hold a composed configuration against the dataclasses and make instances of them."""
    schema, values = _schema(Config), composed.copy()
    OmegaConf.set_struct(values, False)
    if "run_dir" in composed:
        values.run_dir = composed.run_dir  # which may name the model, as the key that goes below
    schema.perturbation = _perturbation_schema()
    schema.resume = False  # of runs from before there was such a key
    for group, schemas in _group_schemas().items():
        name = OmegaConf.select(composed, f"{group}.name")
        if name not in schemas:
            raise UserError(f"{group}.name={name}: no such {group}; choose one of {', '.join(schemas)}")
        schema[group] = _schema(schemas[name])
        if "name" not in get_type_hints(schemas[name]):
            del values[group]["name"]
    merged = OmegaConf.merge(schema, values)
    try:
        config = OmegaConf.to_object(merged)
    except OmegaConfBaseException:
        raise
    except ValueError as error:  # a dataclass refuses its values with one line
        raise UserError(str(error)) from error
    assert isinstance(config, Config)
    _restore_tuples(config)
    return config


def plain(config: Config) -> dict[str, Any]:
    """The configuration as plain values; ``typed(OmegaConf.create(plain(config)))`` gives it back."""
    values = asdict(config)
    for group, schemas in _group_schemas().items():
        if "name" not in values[group]:  # a model's: its type says it
            (name,) = (name for name, schema in schemas.items() if schema is type(getattr(config, group)))
            values[group] = {"name": name} | values[group]
    return values


def changed(values: Mapping[str, Any], overrides: Sequence[str]) -> Config:
    """A run's configuration with other settings for the policy that it has trained; not validated.

    Args:
        values: what ``plain`` gave.
        overrides: ``key=value`` each. The name of a group replaces all of the group by what ``conf/`` says, whatever
            stands where; then dotted keys change single values, the last one of a key last.

    Raises:
        UserError: a setting that cannot be read, or that training has settled.
        HydraException, OmegaConfBaseException: an unknown group, a misspelt key or a wrong type.
    """
    settings = OmegaConf.create(dict(values))
    single: list[str] = []
    for override in overrides:
        key, equals, name = override.partition("=")
        if not equals:
            raise UserError(f"{override}: settings are written key=value")
        if key.partition(".")[0] not in CHANGEABLE:
            raise UserError(f"{key}: not a setting of trained policies; those are {', '.join(CHANGEABLE)}")
        if key not in GROUPS:
            single.append(override)
        elif re.fullmatch(r"\w+", name):
            settings[key] = compose_untyped([override])[key]
        else:
            raise UserError(f"{override}: name one of the files in conf/{key}")
    try:
        return typed(OmegaConf.merge(settings, OmegaConf.from_dotlist(single)))  # type: ignore[arg-type]
    except YAMLError as error:
        raise UserError(f"{', '.join(single)}: a value that cannot be read") from error


def validate(config: Config) -> None:
    """Refuse settings that have the right types and make no sense.

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
    if not config.run_dir:
        raise UserError("run_dir is empty: name a folder for the run")
    if config.observation not in OBSERVATIONS:
        raise UserError(f"observation={config.observation}: choose one of {', '.join(OBSERVATIONS)}")
    if config.oracle and "oracle" not in config.run_dir:
        raise UserError(f"run_dir={config.run_dir} with observation=oracle: put the word oracle into the folder's name")
    _validate_machine(config)
    _validate_by_building(config)


def dtype_of(config: Config) -> Any:
    """The ``torch.dtype`` of the rod's state; torch is imported late because that takes seconds."""
    import torch

    return getattr(torch, config.dtype)


def available_threads() -> int:
    """Number of cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _validate_machine(config: Config) -> None:
    from softgm_bench.rod.backend import BACKENDS

    cores = available_threads()
    if config.threads is not None and not 1 <= config.threads <= cores:
        raise UserError(f"threads={config.threads}: choose 1 to {cores}, the cores of this machine, or null")
    if config.backend is not None and config.backend not in BACKENDS:
        raise UserError(f"backend={config.backend}: choose one of {', '.join(BACKENDS)}, or null")
    if config.dtype not in DTYPES:
        raise UserError(f"dtype={config.dtype}: choose one of {', '.join(DTYPES)}")
    if config.device == "cpu" and config.backend == "cuda":
        raise UserError("backend=cuda runs on a CUDA device: add device=cuda, or choose backend=numba")
    if config.device != "cpu" and config.backend == "numba":
        raise UserError(f"device={config.device}: backend=numba runs on the CPU; choose backend=cuda, torch or null")
    validate_device(config.device)


def validate_device(device: str) -> None:
    """Refuse a device that there is not.

    Raises:
        UserError: saying what there is.
    """
    import torch

    cuda = re.fullmatch(r"cpu|cuda(?::(\d+))?", device)
    if cuda is None:
        raise UserError(f"device={device}: choose cpu, cuda or cuda:<index>")
    if device != "cpu" and int(cuda.group(1) or 0) >= torch.cuda.device_count():
        raise UserError(f"device={device}: this machine has {torch.cuda.device_count()} CUDA devices")


def _validate_by_building(config: Config) -> None:
    """Draw one scene and build one network: what only they can refuse is refused before anything is written."""
    import torch

    from softgm_bench.envs import make_env
    from softgm_bench.envs.tasks import make_task
    from softgm_bench.envs.vmas import VmasConfig, VmasEnv
    from softgm_bench.models.registry import build_encoder

    try:
        if isinstance(config.task, VmasConfig):
            _validate_vmas(config)
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
        encoder = build_encoder(config.model, env.sizes)
    except ValueError as error:
        raise UserError(str(error)) from error
    if not observed.issuperset(encoder.in_keys):
        fitting = "vector_mlp" if isinstance(config.task, VmasConfig) else "mlp or softgm"
        raise UserError(f"task={config.task.name} cannot be observed by this model: add model={fitting}")


def _validate_vmas(config: Config) -> None:
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


def _group_schemas() -> dict[str, dict[str, type]]:
    """Dataclass of every task, algorithm and model by name; imported late because it brings torch along."""
    from softgm_bench.algorithms import algorithm_configs
    from softgm_bench.envs.tasks import TASK_CONFIGS
    from softgm_bench.envs.vmas import SCENARIOS, VmasConfig
    from softgm_bench.models.registry import model_configs

    plugins.load()
    tasks = {**TASK_CONFIGS, **dict.fromkeys(SCENARIOS, VmasConfig)}
    return {"task": tasks, "algo": algorithm_configs(), "model": model_configs()}


def _perturbation_schema() -> DictConfig:
    """Of every perturbation; runs from before there were any get the default, none."""
    from softgm_bench.envs.perturbation import PerturbationConfig

    return _schema(PerturbationConfig)


def _schema(cls: type) -> DictConfig:
    """Structured config of a dataclass; OmegaConf would keep a frozen one read-only, even while merging."""
    node = OmegaConf.structured(cls)
    OmegaConf.set_readonly(node, False)
    hints = get_type_hints(cls)
    for item in fields(cls):
        if is_dataclass(hints[item.name]):
            node[item.name] = _schema(hints[item.name])
    return node


def _restore_tuples(instance: Any) -> None:
    """Turn the lists that OmegaConf leaves in fields of type tuple back, so that frozen dataclasses can be hashed."""
    hints = get_type_hints(type(instance))
    for item in fields(instance):
        value = getattr(instance, item.name)
        if is_dataclass(value):
            _restore_tuples(value)
        elif get_origin(hints[item.name]) is tuple:
            object.__setattr__(instance, item.name, tuple(value))
