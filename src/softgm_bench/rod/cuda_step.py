"""One launch of the CUDA kernel advances every rod by a control step.

A rod has a block of threads, a node and the element behind it have a thread.

A rod stays in registers for all substeps. Neighbours meet in shared memory twice a substep: nodes and directors go to
the left neighbour, then internal forces, curvatures and lengths to both. Between two writes of the same entries lies a
barrier that all their readers have passed, so two barriers a substep are enough.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
from numba import cuda

from softgm_bench.rod.cuda_contact import make_no_press, make_press
from softgm_bench.rod.cuda_kernel import SIMULATED, device, make_own, make_physics
from softgm_bench.rod.parameters import RodParameters, rod_constants

MAX_ELEMENTS = 1023  # a block has a thread for each node, 1024 at most
ROWS = 22  # of an array in which neighbours meet
_REGISTERS = 65536  # of a multiprocessor
# Registers of a thread: more would leave room for fewer rods on a multiprocessor.
_ENOUGH: dict[type, int] = {np.float64: 168, np.float32: 96}
_SHARED_BYTES = 49152  # that a block can have without asking


@lru_cache
def make_step(
    n_elements: int, real: type, contact: str | None, moving: bool = False, drawn: bool = False
) -> Callable[..., Any]:
    """Build the kernel for one element count, precision and contact model; Numba compiles it at its first launch.

    Cylinders that stand still have a kernel without a trace of motion, ``moving`` ones have one of their own.

    Launch with a block for each rod and ``n_elements + 1`` threads. Arguments: the state's four arrays, the four that
    receive the new state, couple, force, active, the cylinders' five arrays (never read without a contact model) and
    their velocities (never read unless they are moving), where rods that they push are marked (never written without a
    contact model), scratch (see ``scratch_columns``), whether (1 or 0) force and
    active are given, ``Coefficients`` (of ``drawn`` bodies a row of them for each rod, ``(num_envs, 27)``), the
    substeps.
    """
    n, n_columns, zero = n_elements, n_elements + 2, real(0.0)
    on_chip = scratch_columns(n, real) == 0
    far = real(1e30)
    load, loads, store = _make_load(n, real), _make_loads(n, real), _make_store(n)
    drift, show, own = _make_drift(real), device(_show), make_own(drawn)
    act, accelerate = _make_act(n, real, contact, moving), _make_accelerate(n, real)
    single, straighten = real is np.float32, make_physics(real).straighten

    def step(
        position, director, velocity, omega, new_position, new_director, new_velocity, new_omega,
        couple, force, active, start, axis, length, radius, mask, velocities, touched, scratch, with_force,
        with_active, given, substeps,
    ):  # fmt: skip
        b, k = cuda.blockIdx.x, cuda.threadIdx.x
        c = own(given, b)
        if on_chip:
            node = cuda.shared.array((15, n_columns), real)
            joint = cuda.shared.array((7, n_columns), real)  # of element k in column k + 1, between what has no element
        else:
            node, joint = scratch[b, :15], scratch[b, 15:]
        moves = substeps > 0 and (with_active == 0 or active[b])
        x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2 = load(
            position, director, velocity, omega, b, k, moves
        )
        if moves:
            t0, t1, t2, gx, gy, gz = loads(c, couple, force, with_force, b, k)
            travelled, next_check, candidates = zero, -far, 0
            duration = c.half_dt
            for substep in range(substeps):
                x, y, z, q00, q01, q02, q10, q11, q12, q20, q21, q22 = drift(
                    duration, k, x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2
                )
                show(node, k, x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22)
                cuda.syncthreads()
                fx, fy, fz, m0, m1, m2, k0, k1, k2, current, travelled, next_check, candidates = act(
                    c, node, joint, k, x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2,
                    duration, travelled, next_check, candidates, b, start, axis, length, radius, mask, velocities,
                    touched, substep, substeps,
                )  # fmt: skip
                cuda.syncthreads()
                vx, vy, vz, w0, w1, w2 = accelerate(
                    c, joint, k, vx, vy, vz, w0, w1, w2,
                    fx + gx, fy + gy, fz + gz, m0 + t0, m1 + t1, m2 + t2, k0, k1, k2, current,
                )  # fmt: skip
                # the half steps that end this substep and begin the next one are one
                duration = c.dt
            x, y, z, q00, q01, q02, q10, q11, q12, q20, q21, q22 = drift(
                c.half_dt, k, x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2
            )
            if single:
                q00, q01, q02, q10, q11, q12, q20, q21, q22 = straighten(q00, q01, q02, q10, q11, q12, q20, q21, q22)
        store(
            new_position, new_director, new_velocity, new_omega, b, k,
            x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2,
        )  # fmt: skip

    # the simulator knows no options
    return cuda.jit(step) if SIMULATED else cuda.jit(step, max_registers=most_registers(n, real))


def scratch_columns(n_elements: int, real: type) -> int:
    """Return the number of columns of the scratch array ``(num_envs, 22, columns)`` in which neighbours meet.

    It is 0 if the rod fits into a block's shared memory.
    """
    fits = ROWS * (n_elements + 2) * np.dtype(real).itemsize <= _SHARED_BYTES
    return 0 if fits else n_elements + 2


def most_registers(n_elements: int, real: type) -> int:
    """Return the most registers of a thread with which several blocks can run beside each other.

    Registers are allotted to whole warps of 32 threads, in multiples of 8.
    """
    threads = -(-(n_elements + 1) // 32) * 32
    return min(_REGISTERS // threads // 8 * 8, _ENOUGH[real])


def _make_load(n: int, real: type) -> Callable[..., Any]:
    zero = real(0.0)
    frame = rod_constants(RodParameters(n_elements=2)).director[..., 0]
    f00, f01, f02, f10, f11, f12, f20, f21, f22 = (real(value) for value in frame.ravel())

    def load(position, director, velocity, omega, b, k, moves):
        """State of node k and element k; the clamped base where it belongs, nothing beyond the last element."""
        x, y, z = position[b, 0, k], position[b, 1, k], position[b, 2, k]
        vx, vy, vz = velocity[b, 0, k], velocity[b, 1, k], velocity[b, 2, k]
        q00, q01, q02, q10, q11, q12, q20, q21, q22 = zero, zero, zero, zero, zero, zero, zero, zero, zero
        w0, w1, w2 = zero, zero, zero
        if k < n:
            q00, q01, q02 = director[b, 0, 0, k], director[b, 0, 1, k], director[b, 0, 2, k]
            q10, q11, q12 = director[b, 1, 0, k], director[b, 1, 1, k], director[b, 1, 2, k]
            q20, q21, q22 = director[b, 2, 0, k], director[b, 2, 1, k], director[b, 2, 2, k]
            w0, w1, w2 = omega[b, 0, k], omega[b, 1, k], omega[b, 2, k]
        if k == 0 and moves:
            x, y, z = zero, zero, zero
            q00, q01, q02, q10, q11, q12, q20, q21, q22 = f00, f01, f02, f10, f11, f12, f20, f21, f22
        return x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2

    return device(load)


def _make_loads(n: int, real: type) -> Callable[..., Any]:
    zero, half, one = real(0.0), real(0.5), real(1.0)

    def loads(c, couple, force, with_force, b, k):
        """External couple on element k; external force on node k with its weight, half of it at the ends."""
        t0, t1, t2 = zero, zero, zero
        if k < n:
            t0, t1, t2 = couple[b, 0, k], couple[b, 1, k], couple[b, 2, k]
        share = half if k == 0 or k == n else one
        gx, gy, gz = share * c.weight_x, share * c.weight_y, share * c.weight_z
        if with_force != 0:
            gx, gy, gz = gx + force[b, 0, k], gy + force[b, 1, k], gz + force[b, 2, k]
        return t0, t1, t2, gx, gy, gz

    return device(loads)


def _make_store(n: int) -> Callable[..., Any]:
    def store(
        position, director, velocity, omega, b, k,
        x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2,
    ):  # fmt: skip
        position[b, 0, k], position[b, 1, k], position[b, 2, k] = x, y, z
        velocity[b, 0, k], velocity[b, 1, k], velocity[b, 2, k] = vx, vy, vz
        if k < n:
            director[b, 0, 0, k], director[b, 0, 1, k], director[b, 0, 2, k] = q00, q01, q02
            director[b, 1, 0, k], director[b, 1, 1, k], director[b, 1, 2, k] = q10, q11, q12
            director[b, 2, 0, k], director[b, 2, 1, k], director[b, 2, 2, k] = q20, q21, q22
            omega[b, 0, k], omega[b, 1, k], omega[b, 2, k] = w0, w1, w2

    return device(store)


def _make_drift(real: type) -> Callable[..., Any]:
    turn = make_physics(real).turn

    def drift(duration, k, x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2):
        """Position and director after ``duration`` at constant rates; the base is clamped."""
        if k > 0:
            x, y, z = x + duration * vx, y + duration * vy, z + duration * vz
            q00, q01, q02, q10, q11, q12, q20, q21, q22 = turn(
                duration, w0, w1, w2, q00, q01, q02, q10, q11, q12, q20, q21, q22
            )
        return x, y, z, q00, q01, q02, q10, q11, q12, q20, q21, q22

    return device(drift)


def _show(node, k, x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22):
    """Give what the left neighbour needs to know of node and element k."""
    node[0, k], node[1, k], node[2, k] = x, y, z
    node[3, k], node[4, k], node[5, k] = vx, vy, vz
    node[6, k], node[7, k], node[8, k] = q00, q01, q02
    node[9, k], node[10, k], node[11, k] = q10, q11, q12
    node[12, k], node[13, k], node[14, k] = q20, q21, q22


def _make_act(n: int, real: type, contact: str | None, moving: bool) -> Callable[..., Any]:
    zero = real(0.0)
    physics = make_physics(real)
    strain, curvature = physics.strain, physics.curvature
    press = make_press(n, real, contact, moving) if contact else make_no_press(real)

    def act(
        c, node, joint, k, x, y, z, vx, vy, vz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2,
        duration, travelled, next_check, candidates, b, start, axis, length, radius, mask, velocities, touched,
        substep, substeps,
    ):  # fmt: skip
        """Forces, torques and curvature of element k; ``joint`` receives what its neighbours need.

        Returns:
            The element's force on node k, its own torque, the curvature at its outer end, its length, and what contact
            keeps between substeps.
        """
        fx, fy, fz, m0, m1, m2, k0, k1, k2 = zero, zero, zero, zero, zero, zero, zero, zero, zero
        outer_x, outer_y, outer_z, current = zero, zero, zero, c.rest_length
        if k < n:
            i = k + 1
            nx, ny, nz, wx, wy, wz = node[0, i], node[1, i], node[2, i], node[3, i], node[4, i], node[5, i]
            current, fx, fy, fz, m0, m1, m2 = strain(
                c, nx - x, ny - y, nz - z, wx - vx, wy - vy, wz - vz,
                q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2,
            )  # fmt: skip
            if k < n - 1:
                k0, k1, k2 = curvature(
                    c, q00, q01, q02, q10, q11, q12, q20, q21, q22, node[6, i], node[7, i], node[8, i],
                    node[9, i], node[10, i], node[11, i], node[12, i], node[13, i], node[14, i],
                )  # fmt: skip
            px, py, pz, qx, qy, qz, travelled, next_check, candidates = press(
                c, k, x, y, z, nx, ny, nz, vx, vy, vz, wx, wy, wz, current, duration, travelled, next_check, candidates,
                b, start, axis, length, radius, mask, velocities, touched, substep, substeps,
            )  # fmt: skip
            outer_x, outer_y, outer_z = qx - fx, qy - fy, qz - fz
            fx, fy, fz = fx + px, fy + py, fz + pz
        joint[0, k + 1], joint[1, k + 1], joint[2, k + 1] = outer_x, outer_y, outer_z
        joint[3, k + 1], joint[4, k + 1], joint[5, k + 1], joint[6, k + 1] = k0, k1, k2, current
        if k == 0:
            for row in range(6):
                joint[row, 0] = zero
            joint[6, 0] = c.rest_length
        return fx, fy, fz, m0, m1, m2, k0, k1, k2, current, travelled, next_check, candidates

    return device(act)


def _make_accelerate(n: int, real: type) -> Callable[..., Any]:
    zero, one, two = real(0.0), real(1.0), real(2.0)
    physics = make_physics(real)
    bending, decay = physics.bending, physics.decay

    def accelerate(c, joint, k, vx, vy, vz, w0, w1, w2, fx, fy, fz, m0, m1, m2, k0, k1, k2, current):
        """Velocity of node k and angular velocity of element k: dynamic step, clamped base, damper.

        PyElastica: ``_update_accelerations``, ``OneEndFixedBC``, ``AnalyticalLinearDamper``.
        """
        right = k + 2 if k < n else k
        b0, b1, b2 = bending(
            c, joint[3, k], joint[4, k], joint[5, k], k0, k1, k2, joint[6, k], current, joint[6, right]
        )
        dilatation = current * c.inverse_rest_length
        axial = decay(c, dilatation)
        lateral = c.bending_decay * axial * axial
        axial = c.axial_decay * axial
        push = c.dt_over_mass * (two if k == n else one)
        fx, fy, fz = fx + joint[0, k], fy + joint[1, k], fz + joint[2, k]
        vx = (vx + push * fx) * c.translational_decay
        vy = (vy + push * fy) * c.translational_decay
        vz = (vz + push * fz) * c.translational_decay
        spin = c.dt_over_inertia * dilatation
        w0 = (w0 + spin * (m0 + b0)) * lateral
        w1 = (w1 + spin * (m1 + b1)) * lateral
        w2 = (w2 + c.dt_over_axial_inertia * dilatation * (m2 + b2)) * axial
        if k == 0:
            vx, vy, vz, w0, w1, w2 = zero, zero, zero, zero, zero, zero
        return vx, vy, vz, w0, w1, w2

    return device(accelerate)
