"""Versions of everything that a number may depend on."""

import platform
from importlib.metadata import version

import softgm_bench

PACKAGES = ("torch", "torchrl", "tensordict", "numba", "numpy")


def versions() -> dict[str, str]:
    """Give the versions of Python, of this package and of ``PACKAGES`` by name."""
    own = {"python": platform.python_version(), "softgm_bench": softgm_bench.__version__}
    return own | {package: version(package) for package in PACKAGES}
