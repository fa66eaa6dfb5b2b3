# Compiled callees reach a function as globals (see jit), out of the linters' sight.
# ruff: noqa: F821
# mypy: disable-error-code="name-defined"
"""The fused CPU backend computes a control step of every environment in one compiled, parallel call."""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softgm_bench.rod import forks
from softgm_bench.rod.bodies import Bodies, scales
from softgm_bench.rod.numba_bodies import FRICTION, MASS, TRANSLATIONAL, VOLUME, make_shape
from softgm_bench.rod.numba_contact import (
    COLUMNS,
    MOVING_COLUMNS,
    NEXT_CHECK,
    ORIGIN,
    VELOCITY,
    make_contact,
    make_motion,
    make_touch,
    told_apart,
)
from softgm_bench.rod.numba_kernel import jit, larger, make_kernel, make_straighten
from softgm_bench.rod.numba_layout import CACHE_LINE, Layout, constant_rows, make_layout
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.scalar_contact import EDGE, RADIUS, START
from softgm_bench.rod.scalar_contact import FRICTION as COULOMB
from softgm_bench.rod.state import Cylinders, RodState, check_inputs, refuse_gradients


class NumbaBackend:
    """This backend moves rods in float64 or float32 on the CPU and equals ``TorchBackend`` to round-off."""

    def __init__(self, parameters: RodParameters) -> None:
        """Prepare for one arm; compilation happens at the first step of each precision and is cached on disk."""
        forks.check()
        self.parameters = parameters
        self._constants = rod_constants(parameters)
        gravity = np.asarray(parameters.gravity)[:, None] * self._constants.mass
        self._weight = torch.as_tensor(gravity)
        self._tables: dict[torch.dtype, tuple[NDArray, NDArray, NDArray]] = {}

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
            state: not changed; float64 or float32 on the CPU.
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
            ValueError: if the arguments' shapes do not fit together, or a gradient is asked for.
        """
        check_inputs(self.parameters, state, couple, force, cylinders, active, cylinder_velocity, bodies, touched)
        forks.check()
        refuse_gradients("numba", state, couple, force, bodies)
        dtype = state.position.dtype
        num_envs, n = couple.shape[0], self.parameters.n_elements
        rows, *shared = self._table(dtype)
        scaled = None if bodies is None else _scale_table(bodies, self.parameters)
        new = state.clone()
        arrays = [field.numpy() for field in (new.position, new.director, new.velocity, new.omega)]
        weight = self._weight if scaled is None else scaled[:, MASS, None, None] * self._weight
        weight = weight.to(dtype).expand(num_envs, 3, n + 1)
        total_force = (weight if force is None else force.to(dtype) + weight).contiguous()
        table = _cylinder_table(cylinders, cylinder_velocity, num_envs, dtype)
        if active is None:
            active = torch.ones(num_envs, dtype=torch.bool)
        if touched is None:
            touched = torch.empty(num_envs, dtype=torch.bool)
        moving = cylinder_velocity is not None
        step = _make_step(n, arrays[0].dtype.type, self.parameters.contact_model, moving, bodies is not None)
        step(
            *arrays,
            couple.detach().to(dtype).contiguous().numpy(),
            total_force.numpy(),
            table.numpy(),
            active.contiguous().numpy(),
            touched.numpy(),
            rows,
            *(shared if scaled is None else _each(scaled.to(dtype).numpy(), *shared)),
            self.parameters.substeps if substeps is None else substeps,
        )
        forks.note_threads()
        return new

    def _table(self, dtype: torch.dtype) -> tuple[NDArray, NDArray, NDArray]:
        if dtype not in self._tables:
            p = self.parameters
            real = torch.empty(0, dtype=dtype).numpy().dtype
            rows = constant_rows(p, make_layout(p.n_elements, real.type), real)
            scalars = np.array([p.dt, self._constants.translational_decay, self._constants.volume.max()], dtype=real)
            contact = np.array(p.contact_coefficients, dtype=real)
            self._tables[dtype] = rows, scalars, contact
        return self._tables[dtype]


def _cylinder_table(cylinders: Cylinders | None, velocity: Tensor | None, num_envs: int, dtype: torch.dtype) -> Tensor:
    """Rows of start, edge, radius and next check, ``(num_envs, n_cylinders, 8)``; a masked one is never checked.

    Where they have a velocity, it and the start at the beginning of the step stand behind, six more columns.
    """
    if cylinders is None:
        return torch.empty((num_envs, 0, COLUMNS), dtype=dtype)
    table = torch.empty((*cylinders.mask.shape, COLUMNS if velocity is None else MOVING_COLUMNS), dtype=dtype)
    if velocity is not None:
        table[..., VELOCITY : VELOCITY + 3] = torch.where(cylinders.mask.unsqueeze(-1), velocity, 0.0)
        table[..., ORIGIN : ORIGIN + 3] = cylinders.start
    table[..., START : START + 3] = cylinders.start
    table[..., EDGE : EDGE + 3] = cylinders.axis * cylinders.length.unsqueeze(-1)
    table[..., RADIUS] = cylinders.radius
    table[..., NEXT_CHECK] = torch.where(cylinders.mask, -torch.inf, torch.inf)
    return table


def _scale_table(bodies: Bodies, parameters: RodParameters) -> Tensor:
    """Columns in the order of ``Scales``, ``(num_envs, 8)`` float64."""
    return torch.stack(scales(Bodies(*(factor.detach().double() for factor in bodies)), parameters), dim=-1)


def _each(scaled: NDArray, scalars: NDArray, contact: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    """Every environment's scales, scalars and contact coefficients, ``(num_envs, ..)`` each, from the nominal arm's."""
    dt, decay, volume = scalars
    own = np.stack([np.full_like(scaled[:, 0], dt), decay ** scaled[:, TRANSLATIONAL], volume * scaled[:, VOLUME]], 1)
    touch = np.tile(contact, (len(scaled), 1))
    touch[:, COULOMB] *= scaled[:, FRICTION]
    return scaled, own, touch


@lru_cache
def _make_step(n_elements: int, dtype: type, contact_model: str, moving: bool, drawn: bool) -> Callable[..., Any]:
    """Compile the loop over environments and substeps for one element count, precision and contact model.

    Cylinders that stand still have a loop without a trace of motion, and rods that are all the nominal one another loop
    than ``drawn`` bodies.
    """
    layout = told_apart(make_layout(n_elements, dtype), contact_model, moving)
    itemsize = np.dtype(dtype).itemsize
    width = CACHE_LINE // itemsize
    single = dtype is np.float32

    def control_step(
        position, director, velocity, omega, couple, force, cylinders, active, touched, rows, scalars, contact, substeps
    ):
        for b in numba.prange(position.shape[0]):
            if active[b]:
                memory = np.empty(layout.size + width, rows.dtype)
                skip = (-memory.ctypes.data % CACHE_LINE) // itemsize
                s = memory[skip : skip + layout.size]
                fill(s, rows)
                load(s, position[b], director[b], velocity[b], omega[b], couple[b], force[b])
                touched[b] |= advance(s, cylinders[b], scalars, contact, substeps)
                if single:
                    straighten(s)
                store(s, position[b], director[b], velocity[b], omega[b])

    def control_step_of_bodies(
        position, director, velocity, omega, couple, force, cylinders, active, touched, rows, scales, scalars, contact,
        substeps,
    ):  # fmt: skip
        for b in numba.prange(position.shape[0]):
            if active[b]:
                memory = np.empty(layout.size + width, rows.dtype)
                skip = (-memory.ctypes.data % CACHE_LINE) // itemsize
                s = memory[skip : skip + layout.size]
                fill(s, rows)
                shape(s, scales[b])
                load(s, position[b], director[b], velocity[b], omega[b], couple[b], force[b])
                touched[b] |= advance(s, cylinders[b], scalars[b], contact[b], substeps)
                if single:
                    straighten(s)
                store(s, position[b], director[b], velocity[b], omega[b])

    callees: dict[str, Any] = {"shape": make_shape(layout, dtype)} if drawn else {}
    return jit(
        control_step_of_bodies if drawn else control_step,
        parallel=True,
        fill=_make_fill(layout),
        load=_make_load(layout),
        store=_make_store(layout),
        advance=_make_advance(layout, dtype, contact_model, moving),
        straighten=make_straighten(layout, dtype),
        **callees,
    )


def _make_advance(layout: Layout, real: type, contact_model: str, moving: bool) -> Callable[..., Any]:
    p, n = layout, layout.n
    touch, motion = make_touch(layout, real, contact_model, moving), make_motion(real, moving)
    zero, half, far = real(0.0), real(0.5), real(np.inf)

    def advance(s, cylinders, scalars, contact, substeps):
        dt, decay, volume = scalars[0], scalars[1], scalars[2]
        touched, copied, soonest = False, False, -far
        fastest = zero
        for k in range(n + 1):
            fastest = larger(fastest, s[p.vx + k] ** 2 + s[p.vy + k] ** 2 + s[p.vz + k] ** 2)
        drift = speed(cylinders)
        travelled = half * dt * (np.sqrt(fastest) + drift)
        rotate(s, half * dt)
        move(s, half * dt)
        for substep in range(substeps):
            stresses(s)
            couples(s)
            if cylinders.shape[0] > 0:
                copied_before, copied = copied, False
                extent = reach(s, volume)
                if travelled + extent > soonest:
                    carry(cylinders, substep, dt)
                    copied, pushed, soonest = add_contact(s, cylinders, travelled, extent, contact, volume)
                    touched |= pushed
                if copied_before and not copied:
                    for k in range(n + 1):
                        s[p.fx + k] = s[p.gx + k]
                        s[p.fy + k] = s[p.gy + k]
                        s[p.fz + k] = s[p.gz + k]
            spin(s)
            fastest = push(s, decay)
            # the half steps that end this substep and begin the next one are one
            step = half * dt if substep == substeps - 1 else dt
            travelled += step * (np.sqrt(fastest) + drift)
            rotate(s, step)
            move(s, step)
        return touched

    callees = make_contact(layout, real, touch)._asdict() | make_kernel(n, real)._asdict()
    return jit(advance, **callees, speed=motion.speed, carry=motion.carry)


# Arrays are copied element by element: a slice that is assigned to has Numba compile the message of the error that it
# raises where shapes differ, which takes seconds in every process that compiles.
def _make_fill(layout: Layout) -> Callable[..., Any]:
    size = layout.size

    def fill(s, rows):
        for k in range(size):
            s[k] = rows[k]

    return jit(fill)


def _make_load(layout: Layout) -> Callable[..., Any]:
    p, n = layout, layout.n

    def load(s, position, director, velocity, omega, couple, force):
        for i, (x, v, g, f) in enumerate(
            ((p.px, p.vx, p.gx, p.fx), (p.py, p.vy, p.gy, p.fy), (p.pz, p.vz, p.gz, p.fz))
        ):
            for k in range(n + 1):
                s[x + k] = position[i, k]
                s[v + k] = velocity[i, k]
                s[g + k] = force[i, k]
                s[f + k] = force[i, k]
        for i, (q0, q1, q2, w, t) in enumerate(
            (
                (p.q00, p.q01, p.q02, p.w0, p.t0),
                (p.q10, p.q11, p.q12, p.w1, p.t1),
                (p.q20, p.q21, p.q22, p.w2, p.t2),
            )
        ):
            for k in range(n):
                s[q0 + k] = director[i, 0, k]
                s[q1 + k] = director[i, 1, k]
                s[q2 + k] = director[i, 2, k]
                s[w + k] = omega[i, k]
                s[t + k] = couple[i, k]

    return jit(load)


def _make_store(layout: Layout) -> Callable[..., Any]:
    p, n = layout, layout.n

    def store(s, position, director, velocity, omega):
        for i, (x, v) in enumerate(((p.px, p.vx), (p.py, p.vy), (p.pz, p.vz))):
            for k in range(n + 1):
                position[i, k] = s[x + k]
                velocity[i, k] = s[v + k]
        for i, (q0, q1, q2, w) in enumerate(
            ((p.q00, p.q01, p.q02, p.w0), (p.q10, p.q11, p.q12, p.w1), (p.q20, p.q21, p.q22, p.w2))
        ):
            for k in range(n):
                director[i, 0, k] = s[q0 + k]
                director[i, 1, k] = s[q1 + k]
                director[i, 2, k] = s[q2 + k]
                omega[i, k] = s[w + k]

    return jit(store)
