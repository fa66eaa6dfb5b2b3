"""The registry knows the rod's implementations by name, says where each one runs, and builds them.

A new backend is its module, with a class that does what ``Backend`` says, and a line in ``_REGISTRY``. The classes are
imported when one is built; nothing else here needs torch, whose import takes seconds, or a CUDA compiler.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:
    from torch import Tensor

    from softgm_bench.rod.bodies import Bodies
    from softgm_bench.rod.parameters import RodParameters
    from softgm_bench.rod.state import Cylinders, RodState


class Backend(Protocol):
    """Every implementation of the rod offers this; see ``NumbaBackend.control_step`` for shapes and units."""

    parameters: RodParameters

    def control_step(
        self,
        state: RodState,
        couple: Tensor,
        force: Tensor | None = None,
        cylinders: Cylinders | None = None,
        active: Tensor | None = None,
        substeps: int | None = None,
        cylinder_velocity: Tensor | None = None,
        bodies: Bodies | None = None,
        touched: Tensor | None = None,
    ) -> RodState:
        """Advance every active rod by one control step and return a new state."""
        ...


class _Registered(NamedTuple):
    """This is one backend's declaration of itself.

    Attributes:
        module: path of the module that holds its class.
        factory: name of the class, which takes ``RodParameters``.
        device_types: torch's names of the device types on which it runs.
        default_on: those of them on which it is the one to take where nobody chose.
        dtypes: of states that it can move.
    """

    module: str
    factory: str
    device_types: tuple[str, ...]
    default_on: tuple[str, ...] = ()
    dtypes: tuple[str, ...] = ("float64", "float32")


_REGISTRY = {
    "numba": _Registered("softgm_bench.rod.numba_backend", "NumbaBackend", ("cpu",), default_on=("cpu",)),
    "torch": _Registered("softgm_bench.rod.torch_backend", "TorchBackend", ("cpu", "cuda")),
    "cuda": _Registered("softgm_bench.rod.cuda_backend", "CudaBackend", ("cuda",), default_on=("cuda",)),
    "pyelastica": _Registered(
        "softgm_bench.rod.pyelastica_backend", "PyElasticaBackend", ("cpu",), dtypes=("float64",)
    ),
}

BACKENDS = tuple(_REGISTRY)


def make_backend(name: str, parameters: RodParameters) -> Backend:
    """Build a backend for one arm.

    ``numba`` and ``cuda`` are fused kernels, ``torch`` is the differentiable reference, ``pyelastica`` is PyElastica.

    Raises:
        ValueError: for a name that is not in ``BACKENDS``, or if the backend cannot hold such a rod.
        UserError: ``pyelastica`` where PyElastica is not installed, or has no such contact.
    """
    registered = _registered(name)
    backend: Backend = getattr(import_module(registered.module), registered.factory)(parameters)
    return backend


def default_backend(device_type: str) -> str:
    """Name the backend to take on a device type (``cpu``, ``cuda``) where nobody chose one: its fused kernel.

    Raises:
        ValueError: if no backend is the default there.
    """
    for name, registered in _REGISTRY.items():
        if device_type in registered.default_on:
            return name
    known = [kind for registered in _REGISTRY.values() for kind in registered.default_on]
    raise ValueError(f"device={device_type}: no backend is made for it; choose device={' or '.join(known)}")


def runs_on(name: str, device_type: str) -> bool:
    """Tell whether a backend runs on a device type (``cpu``, ``cuda``).

    Raises:
        ValueError: for a name that is not in ``BACKENDS``.
    """
    return device_type in _registered(name).device_types


def check_backend(name: str, device_type: str, dtype: str = "float64") -> None:
    """Refuse a backend that does not run on a device type (``cpu``, ``cuda``), or not in a state's type.

    Raises:
        ValueError: for a name that is not in ``BACKENDS``, or saying which device, backends or type would do.
    """
    registered = _registered(name)
    if not runs_on(name, device_type):
        others = [other for other in _REGISTRY if runs_on(other, device_type)]
        instead = f", or backend={' or '.join(others)}" if others else ""
        raise ValueError(
            f"backend={name} does not run on device={device_type}: "
            f"choose device={' or '.join(registered.device_types)}{instead}"
        )
    if dtype not in registered.dtypes:
        raise ValueError(f"backend={name} has no dtype={dtype}: add dtype={' or '.join(registered.dtypes)}")


def _registered(name: str) -> _Registered:
    if name not in _REGISTRY:
        raise ValueError(f"backend is {name!r}: choose one of {', '.join(BACKENDS)}")
    return _REGISTRY[name]
