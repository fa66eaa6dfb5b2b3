"""Environments: the soft arm, and VMAS tasks that other people's algorithms were measured on.

Importing this room registers both kinds of tasks.
"""

from softgm_bench.envs import vmas
from softgm_bench.envs.arm import make_env
from softgm_bench.envs.interface import Environment, Kind, Sizes, kind_of, register_kind, task_configs
from softgm_bench.envs.perturbation import PerturbationConfig
from softgm_bench.envs.section_mixture import SectionMixture
from softgm_bench.envs.soft_arm import SoftArmEnv

__all__ = [
    "Environment",
    "Kind",
    "PerturbationConfig",
    "SectionMixture",
    "Sizes",
    "SoftArmEnv",
    "kind_of",
    "make_env",
    "register_kind",
    "task_configs",
    "vmas",
]
