"""The settings of a run: their types, how they are composed from ``conf/`` and what they must satisfy."""

from softgm_bench.config.checks import available_threads, validate, validate_device
from softgm_bench.config.composition import (
    CHANGEABLE,
    GROUPS,
    changed,
    compose,
    compose_untyped,
    composing,
    config_directory,
    plain,
    typed,
)
from softgm_bench.config.loggers import LoggerConfig
from softgm_bench.config.schema import (
    CheckpointConfig,
    Config,
    EvaluationConfig,
    ExperimentConfig,
    labelled,
    model_name,
)

__all__ = [
    "CHANGEABLE",
    "GROUPS",
    "CheckpointConfig",
    "Config",
    "EvaluationConfig",
    "ExperimentConfig",
    "LoggerConfig",
    "available_threads",
    "changed",
    "compose",
    "compose_untyped",
    "composing",
    "config_directory",
    "labelled",
    "model_name",
    "plain",
    "typed",
    "validate",
    "validate_device",
]
