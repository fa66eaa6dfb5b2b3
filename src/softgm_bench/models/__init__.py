"""Encoders from the observation to one embedding per agent, and the heads that make actors and critics of them.

They know the environment only through the names of its entries (``envs.entries``).
"""

from importlib import import_module
from pkgutil import iter_modules

from softgm_bench.models.heads import ActorConfig, ValueConfig, build_actor, build_value
from softgm_bench.models.mlp import MLPConfig, MLPEncoder
from softgm_bench.models.registry import build_encoder, model_configs, register_model
from softgm_bench.models.softgm import SoftGMConfig, SoftGMEncoder
from softgm_bench.models.vector_mlp import VectorMLPConfig, VectorMLPEncoder

for _module in iter_modules(__path__):  # each registers what it defines
    import_module(f"{__name__}.{_module.name}")

__all__ = [
    "ActorConfig",
    "MLPConfig",
    "MLPEncoder",
    "SoftGMConfig",
    "SoftGMEncoder",
    "ValueConfig",
    "VectorMLPConfig",
    "VectorMLPEncoder",
    "build_actor",
    "build_encoder",
    "build_value",
    "model_configs",
    "register_model",
]
