"""Algorithms: how a batch of frames improves a model. One class each for PPO, DDPG and SAC, known by several names."""

from importlib import import_module
from pkgutil import iter_modules

from softgm_bench.algorithms.ddpg import DDPG, DDPGConfig
from softgm_bench.algorithms.ppo import PPO, PPOConfig
from softgm_bench.algorithms.registry import (
    Algorithm,
    algorithm_configs,
    build_algorithm,
    build_policy,
    learns_mixtures,
    named_parameters,
    register_algorithm,
)
from softgm_bench.algorithms.sac import SAC, SACConfig

for _module in iter_modules(__path__):  # each registers what it defines
    import_module(f"{__name__}.{_module.name}")

__all__ = [
    "DDPG",
    "PPO",
    "SAC",
    "Algorithm",
    "DDPGConfig",
    "PPOConfig",
    "SACConfig",
    "algorithm_configs",
    "build_algorithm",
    "build_policy",
    "learns_mixtures",
    "named_parameters",
    "register_algorithm",
]
