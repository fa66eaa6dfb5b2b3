"""Choice of the rod's implementation by name."""

from typing import Protocol

from torch import Tensor

from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, RodState

BACKENDS = ("numba", "torch", "cuda")


class Backend(Protocol):
    """What every implementation of the rod offers; see ``NumbaBackend.control_step`` for shapes and units."""

    parameters: RodParameters

    def control_step(
        self,
        state: RodState,
        couple: Tensor,
        force: Tensor | None = None,
        cylinders: Cylinders | None = None,
        active: Tensor | None = None,
        substeps: int | None = None,
    ) -> RodState:
        """Advance every active rod by one control step and return a new state."""
        ...


def make_backend(name: str, parameters: RodParameters) -> Backend:
    """Build ``numba`` (fused, CPU), ``cuda`` (fused, GPU) or ``torch`` (reference, any device, differentiable).

    Raises:
        ValueError: for another name.
    """
    if name == "numba":
        from softgm_bench.rod.numba_backend import NumbaBackend

        return NumbaBackend(parameters)
    if name == "torch":
        from softgm_bench.rod.torch_backend import TorchBackend

        return TorchBackend(parameters)
    if name == "cuda":
        from softgm_bench.rod.cuda_backend import CudaBackend

        return CudaBackend(parameters)
    raise ValueError(f"backend is {name!r}: choose one of {', '.join(BACKENDS)}")
