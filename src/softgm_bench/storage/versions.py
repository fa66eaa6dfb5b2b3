"""Versions of everything that a number may depend on."""

import platform
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version

import softgm_bench

PACKAGES = ("torch", "torchrl", "tensordict", "numba", "numpy")
UNKNOWN = "unknown"


def versions() -> dict[str, str]:
    """Give the versions of Python, of this package and of ``PACKAGES`` by name."""
    own = {"python": platform.python_version(), "softgm_bench": softgm_bench.__version__}
    return own | {package: version_of(package) for package in PACKAGES}


def version_of(package: str) -> str:
    """Give a package's version, also where it can be imported without being installed; it never raises.

    Args:
        package: its name for pip.

    Returns:
        What its metadata say, else the module's ``__version__``, else ``UNKNOWN``.
    """
    try:
        return version(package)
    except PackageNotFoundError:
        pass
    try:
        return str(getattr(import_module(package.replace("-", "_")), "__version__", UNKNOWN))
    except ImportError:
        return UNKNOWN
