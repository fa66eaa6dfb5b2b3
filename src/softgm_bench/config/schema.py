"""The types of a run's settings, what results are named after, and which dataclass a chosen name stands for."""

from dataclasses import dataclass
from typing import Any

from softgm_bench import plugins
from softgm_bench.config.loggers import LoggerConfig
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.randomise import RandomiseConfig

DTYPES = ("float64", "float32")
NO_GRAPHS, GRAPHS = "none", "graph"
COMPILES = (NO_GRAPHS, GRAPHS)
TF32, BF16, FLOAT32 = "tf32", "bf16", "float32"
MATMULS = (TF32, BF16, FLOAT32)
OBSERVATIONS = ("standard", "oracle")
TUNED, PAPER = "tuned", "paper"
RECIPES = (TUNED, PAPER)


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
    """Length of training, intervals of evaluations and checkpoints; see ``conf/experiment/default.yaml``."""

    name: str
    total_frames: int
    minutes: float | None
    num_envs: int
    steps_per_batch: int
    train_horizon: int | None
    evaluation: EvaluationConfig
    checkpoint: CheckpointConfig


@dataclass
class StartConfig:
    """Which trained policy training begins with, if any; see ``conf/config.yaml``."""

    policy: str | None
    critic_frames: int


@dataclass
class Config:
    """Everything that a run depends on; see ``conf/config.yaml``.

    ``task``, ``algo`` and ``model`` are instances of the dataclass that the key ``name`` in their YAML stands for.
    ``recipe`` is one of ``RECIPES``, also under a recipe of a user's own, which builds on one of them; it is empty for
    runs from before it was written down.
    """

    recipe: str
    seed: int
    observation: str
    start: StartConfig
    device: str
    backend: str | None
    dtype: str
    compile: str | None
    matmul: str | None
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
    randomise: RandomiseConfig
    logger: LoggerConfig

    @property
    def oracle(self) -> bool:
        """Tell whether actors are told what they would have to discover; such a policy is no competitor."""
        return self.observation == "oracle"

    @property
    def mixed(self) -> bool:
        """Tell whether arms of several numbers of sections are side by side (``envs.section_mixture``)."""
        return isinstance(getattr(self.task, "n_agents", None), list)

    @property
    def graphs(self) -> bool:
        """Tell whether what a run repeats is recorded as CUDA graphs; a mixture's batches are not."""
        return (self.compile or (NO_GRAPHS if self.device == "cpu" or self.mixed else GRAPHS)) == GRAPHS

    @property
    def label(self) -> str:
        """The algorithm's name as results carry it."""
        memory = getattr(getattr(self.algo, "actor", None), "memory", None)
        cell = None if memory is None else memory.cell
        changed = (self.perturbation.name, self.randomise.name)
        started = self.start.policy is not None
        return labelled(self.algo.name, model_name(self.model), self.observation, *changed, cell, started)


def labelled(
    algo: str,
    model: str,
    observation: str,
    perturbation: str,
    randomise: str,
    memory: str | None = None,
    started: bool = False,
) -> str:
    """``algo``, and whatever in model, memory, observation, perturbation, bodies, start makes results another kind's.

    SoftGM has the model that it is named after, the other algorithms an MLP; any other is named. A model whose name
    begins with the algorithm's, such as an ablation's, names both.
    """
    own = "softgm" if algo.startswith("softgm") else "mlp"
    if model.startswith(f"{algo}_"):
        algo, own = model, model
    bodies = "none" if randomise == "none" else f"randomised_{randomise}"
    start = "started" if started else None
    usual = (
        (own, model),
        (None, memory),
        ("standard", observation),
        ("none", perturbation),
        ("none", bodies),
        (None, start),
    )
    return "_".join([algo, *(value for default, value in usual if value is not None and value != default)])


def group_schemas() -> dict[str, dict[str, type]]:
    """Dataclass of every task, algorithm and model by name; imported late because it brings torch along."""
    from softgm_bench.algorithms import algorithm_configs
    from softgm_bench.envs import task_configs
    from softgm_bench.models.registry import model_configs

    plugins.load()
    return {"task": task_configs(), "algo": algorithm_configs(), "model": model_configs()}


def model_name(model: Any) -> str:
    """A model's name: where several share a dataclass its settings say it, otherwise their type does."""
    if hasattr(model, "name"):
        return model.name
    (name,) = (name for name, schema in group_schemas()["model"].items() if schema is type(model))
    return name
