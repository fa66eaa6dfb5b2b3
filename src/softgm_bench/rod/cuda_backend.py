"""The GPU backend computes a control step of every environment in one kernel launch on torch's tensors and stream."""

import torch
from torch import Tensor

from softgm_bench.rod.bodies import Bodies, scales
from softgm_bench.rod.cuda_kernel import SIMULATED, Coefficients, coefficients, coefficients_of
from softgm_bench.rod.cuda_launch import REAL, launch
from softgm_bench.rod.cuda_step import MAX_ELEMENTS, ROWS, make_step, scratch_columns
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, RodState, check_inputs, refuse_gradients


class CudaBackend:
    """This backend moves rods in float64 or float32 on NVIDIA GPUs and equals ``TorchBackend`` to round-off.

    Nothing is copied to or from the host and nothing waits for the GPU: a step is one launch on torch's current stream.
    """

    def __init__(self, parameters: RodParameters) -> None:
        """Prepare for one arm; compilation happens at the first step of each precision, with and without cylinders.

        Raises:
            ValueError: if the kernel cannot hold such a rod.
        """
        if parameters.n_elements > MAX_ELEMENTS:
            raise ValueError(
                f"rod.n_elements is {parameters.n_elements}: the cuda backend holds at most {MAX_ELEMENTS}"
            )
        self.parameters = parameters
        self._coefficients: dict[type, Coefficients] = {real: coefficients(parameters, real) for real in REAL.values()}

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
        """Advance every rod by one control step.

        Args:
            state: not changed; float64 or float32 on a CUDA device, as all tensors.
            couple: external couple on elements in the material frame, N m, ``(num_envs, 3, n_elements)``.
            force: external force on nodes in the world frame, N, ``(num_envs, 3, n_nodes)``; gravity is added.
            cylinders: what the rods may touch.
            active: ``(num_envs,)`` bool; rods that are not come back as they were.
            substeps: of this step, the parameters' number by default.
            cylinder_velocity: with which the cylinders move on from where they are now, m/s, without turning,
                ``(num_envs, n_cylinders, 3)``; constant in the step. By default they stand still.
            bodies: factors on the parameters, an arm for each environment; by default all are the nominal one.
            touched: ``(num_envs,)`` bool, in which rods that a cylinder pushes in any substep are marked; entries of
                others stay as they are. By default nobody is told.

        Returns:
            A new state.

        Raises:
            ValueError: if the arguments' shapes do not fit together, a tensor is not where the state is, or a gradient
                is asked for.
        """
        check_inputs(self.parameters, state, couple, force, cylinders, active, cylinder_velocity, bodies, touched)
        refuse_gradients("cuda", state, couple, force, bodies)
        device, dtype = state.position.device, state.position.dtype
        _check_device(
            device,
            couple=couple,
            force=force,
            active=active,
            cylinders=cylinders,
            cylinder_velocity=cylinder_velocity,
            touched=touched,
            **({} if bodies is None else {f"bodies.{name}": factor for name, factor in bodies._asdict().items()}),
        )
        if dtype not in REAL:
            raise ValueError(f"the state is {dtype}: the cuda backend computes in float64 or float32")
        old = _inputs(dtype, state.position, state.director, state.velocity, state.omega)
        new = [torch.empty_like(field) for field in old]
        if len(couple) > 0:
            # what is absent is never read; something of its type stands for it
            none = cylinders is None or cylinders.mask.shape[1] == 0
            contact = None if none else self.parameters.contact_model
            moving = contact is not None and cylinder_velocity is not None
            nothing = torch.empty((1, 1, 1), dtype=dtype, device=device)
            never = torch.empty((1, 1), dtype=torch.bool, device=device)
            couple, force_or_nothing = _inputs(dtype, couple, nothing if force is None else force)
            obstacles = [nothing, nothing, nothing[0], nothing[0], never, nothing]
            if cylinders is not None and contact is not None:
                geometry = (cylinders.start, cylinders.axis, cylinders.length, cylinders.radius)
                velocity = nothing if cylinder_velocity is None else cylinder_velocity
                *shapes, velocity = _inputs(dtype, *geometry, velocity)
                obstacles = [*shapes, cylinders.mask.contiguous(), velocity]
            columns = scratch_columns(self.parameters.n_elements, REAL[dtype])
            scratch = torch.empty((len(couple), ROWS, columns), dtype=dtype, device=device) if columns else nothing
            flags = never[0] if active is None else active.bool().contiguous()
            marks = torch.empty(len(couple), dtype=torch.bool, device=device) if touched is None else touched
            launch(
                make_step(self.parameters.n_elements, REAL[dtype], contact, moving, bodies is not None),
                len(couple),
                self.parameters.n_nodes,
                [*old, *new, couple, force_or_nothing, flags, *obstacles, marks, scratch],
                int(force is not None),
                int(active is not None),
                self._coefficients[REAL[dtype]] if bodies is None else self._rows(bodies, dtype),
                self.parameters.substeps if substeps is None else substeps,
            )
        return RodState(*new, batch_size=state.batch_size)

    def _rows(self, bodies: Bodies, dtype: torch.dtype) -> Tensor:
        """The coefficients of every environment's body, ``(num_envs, 27)``."""
        factors = Bodies(*(factor.detach().double() for factor in bodies))
        return coefficients_of(self._coefficients[REAL[torch.float64]], scales(factors, self.parameters)).to(dtype)


def _inputs(dtype: torch.dtype, *tensors: Tensor) -> list[Tensor]:
    """Give what a kernel can read; no copies where dtype and layout are right already."""
    return [tensor.detach().to(dtype).contiguous() for tensor in tensors]


def _check_device(device: torch.device, **arguments: Tensor | Cylinders | None) -> None:
    """Refuse tensors that the kernel cannot reach.

    Raises:
        ValueError: naming the first of them.
    """
    if device.type != "cuda" and not SIMULATED:
        raise ValueError(f"the state is on {device}: the cuda backend needs it on a CUDA device")
    for name, argument in arguments.items():
        tensors = argument.values() if isinstance(argument, Cylinders) else (argument,)
        for tensor in tensors:
            if tensor is not None and tensor.device != device:
                raise ValueError(f"{name} is on {tensor.device}: it must be on {device} as the state is")
