"""The CUDA kernel's device functions do one substep's arithmetic for one element or node of a rod.

The formulae are those of ``torch_backend`` (Gazzola et al. 2018; PyElastica 1.0.0's arithmetic). Everything is scalar:
a thread holds one node and one element in registers. Transcendental functions are polynomials inside a stated range, as
in ``numba_kernel``, with fewer terms in float32; the functions themselves serve outside of it.

Constants are bound in the precision of the kernel: one Python float would promote float32 arithmetic to float64.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from math import asin, exp, sqrt
from typing import Any, NamedTuple

import numpy as np
import torch
from numba import config, cuda
from torch import Tensor

from softgm_bench.rod.bodies import Scales
from softgm_bench.rod.callees import with_callees
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.series import SMALL_BEND, SMALL_EXPONENT, SMALL_TURN, TINY, bend, cosc, exponential, sinc

SIMULATED = bool(config.ENABLE_CUDASIM)

_BEND_DEGREE: dict[type, int] = {np.float64: 11, np.float32: 4}
_TERMS: dict[type, int] = {np.float64: 7, np.float32: 4}  # of sine and cosine
_MOST_HALVINGS = 20  # of an angle: a turn of more than half a million radians a substep is lost anyway
_EXP_TERMS: dict[type, int] = {np.float64: 11, np.float32: 7}


class Coefficients(NamedTuple):
    """These are a uniform rod's constants in the kernel's precision, in SI units."""

    dt: Any
    half_dt: Any
    rest_length: Any
    inverse_rest_length: Any
    inverse_voronoi_length: Any
    shear: Any  # stiffness S of d1 and d2
    stretch: Any  # of d3
    bend: Any  # stiffness B about d1 and d2
    twist: Any  # about d3
    twist_minus_bend: Any  # times half the Voronoi length
    inertia: Any  # about d1 and d2
    axial_inertia: Any  # about d3
    dt_over_inertia: Any
    dt_over_axial_inertia: Any
    dt_over_mass: Any  # of an inner node
    translational_decay: Any
    bending_decay: Any  # factor on omega per substep at dilatation 1
    axial_decay: Any
    decay_rate: Any  # exponent of the axial factor per unit of (1 - dilatation)
    weight_x: Any  # of an inner node
    weight_y: Any
    weight_z: Any
    volume_over_pi: Any
    contact_stiffness: Any
    contact_damping: Any
    friction: Any
    slip_damping: Any


def coefficients(parameters: RodParameters, real: type) -> Coefficients:
    """Take a rod's constants from its middle; only the masses of the two end nodes differ, by half.

    Raises:
        ValueError: if the rod is not uniform.
    """
    c, p = rod_constants(parameters), parameters
    contact = p.contact_coefficients
    rate = c.rotational_decay_rate
    uniform = (c.rest_length, *c.inertia, *c.shear, *c.bend, *rate, c.volume, c.mass[1:-1], 2.0 * c.mass[[0, -1]])
    for values in uniform:
        if not np.allclose(values, values[0], rtol=1e-9, atol=0.0):
            raise ValueError("the cuda backend holds uniform rods only: this one's elements differ")
    mass, rest = c.mass[1], p.base_length / p.n_elements
    values = Coefficients(
        dt=p.dt,
        half_dt=0.5 * p.dt,
        rest_length=rest,
        inverse_rest_length=1.0 / rest,
        inverse_voronoi_length=1.0 / rest,
        shear=c.shear[0, 0],
        stretch=c.shear[2, 0],
        bend=c.bend[0, 0],
        twist=c.bend[2, 0],
        twist_minus_bend=0.5 * rest * (c.bend[2, 0] - c.bend[0, 0]),
        inertia=c.inertia[0, 0],
        axial_inertia=c.inertia[2, 0],
        dt_over_inertia=p.dt / c.inertia[0, 0],
        dt_over_axial_inertia=p.dt / c.inertia[2, 0],
        dt_over_mass=p.dt / mass,
        translational_decay=c.translational_decay,
        bending_decay=np.exp(-rate[0, 0]),
        axial_decay=np.exp(-rate[2, 0]),
        # a circular cross-section has twice the inertia about its axis, so bending decays at twice this rate
        decay_rate=rate[2, 0] if c.decay_follows_dilatation else 0.0,
        weight_x=p.gravity[0] * mass,
        weight_y=p.gravity[1] * mass,
        weight_z=p.gravity[2] * mass,
        volume_over_pi=c.volume[0] / np.pi,
        contact_stiffness=contact.stiffness,
        contact_damping=contact.damping,
        friction=contact.friction,
        slip_damping=contact.slip_damping,
    )
    return Coefficients(*(real(value) for value in values))


# The scale of every coefficient that depends on the body, or over which it stands; the decays have it as their power.
_TIMES = {
    "shear": "shear",
    "stretch": "shear",
    "bend": "bend",
    "twist": "bend",
    "twist_minus_bend": "bend",
    "inertia": "inertia",
    "axial_inertia": "inertia",
    "decay_rate": "rotational",
    "weight_x": "mass",
    "weight_y": "mass",
    "weight_z": "mass",
    "volume_over_pi": "volume",
    "friction": "friction",
}
_OVER = {"dt_over_inertia": "inertia", "dt_over_axial_inertia": "inertia", "dt_over_mass": "mass"}
_POWER = {
    "translational_decay": "translational",
    "bending_decay": "rotational",
    "axial_decay": "rotational",
}


def coefficients_of(nominal: Coefficients, scales: Scales) -> Tensor:
    """Give every environment's coefficients, ``(num_envs, 27)`` float64 on the scales' device; nothing waits for it.

    ``nominal`` is of float64, as are the scales ``(num_envs,)``.
    """
    values = scales._asdict()
    one = torch.ones_like(scales.mass)
    factors = [values.get(_TIMES.get(name, ""), one) for name in nominal._fields]
    divisors = [values.get(_OVER.get(name, ""), one) for name in nominal._fields]
    powers = [values.get(_POWER.get(name, ""), one) for name in nominal._fields]
    base = _as_tensor(nominal, one.device)
    factor, divisor, power = (torch.stack(columns, dim=-1) for columns in (factors, divisors, powers))
    decays = _as_tensor(tuple(name in _POWER for name in nominal._fields), one.device)
    return torch.where(decays > 0.0, base**power, base * factor / divisor)


@lru_cache
def _as_tensor(values: tuple[Any, ...], device: torch.device) -> Tensor:
    """Numbers as a float64 tensor that is copied to the device once."""
    return torch.tensor([float(value) for value in values], dtype=torch.float64, device=device)


def make_own(drawn: bool) -> Callable[..., Any]:
    """Make the device function that gives a block the ``Coefficients`` of its rod.

    They are the kernel's argument itself where all rods are one, and a row of it, ``(num_envs, 27)``, for ``drawn``
    bodies.
    """

    def own(given, b):
        return given

    def row(given, b):
        return Coefficients(
            given[b, 0], given[b, 1], given[b, 2], given[b, 3], given[b, 4], given[b, 5], given[b, 6], given[b, 7],
            given[b, 8], given[b, 9], given[b, 10], given[b, 11], given[b, 12], given[b, 13], given[b, 14],
            given[b, 15], given[b, 16], given[b, 17], given[b, 18], given[b, 19], given[b, 20], given[b, 21],
            given[b, 22], given[b, 23], given[b, 24], given[b, 25], given[b, 26],
        )  # fmt: skip

    return device(row if drawn else own)


class Physics(NamedTuple):
    """These are the device functions of one precision."""

    turn: Callable[..., Any]
    strain: Callable[..., Any]
    curvature: Callable[..., Any]
    bending: Callable[..., Any]
    decay: Callable[..., Any]
    straighten: Callable[..., Any]


def device(function: Callable[..., Any], inline: bool = False, **callees: Callable[..., Any]) -> Callable[..., Any]:
    """Compile for use inside a kernel; under Numba's simulator the plain function, which is much faster.

    ``callees`` are bound as ``callees`` says. ``inline`` makes no difference: the GPU's compiler inlines everything.
    """
    bound = with_callees(function, callees)
    return bound if SIMULATED else cuda.jit(device=True)(bound)


@lru_cache
def make_physics(real: type) -> Physics:
    """Make the device functions in float64 or float32."""
    return Physics(
        turn=_make_turn(real),
        strain=_make_strain(real),
        curvature=_make_curvature(real),
        bending=_make_bending(real),
        decay=_make_decay(real),
        straighten=_make_straighten(real),
    )


def _make_turn(real: type) -> Callable[..., Any]:
    one, half, quarter, four, limit = real(1.0), real(0.5), real(0.25), real(4.0), real(SMALL_TURN)
    sinc_series = horner(real, sinc(_TERMS[real]))
    cosc_series = horner(real, cosc(_TERMS[real]))

    def turn(dt, w0, w1, w2, q00, q01, q02, q10, q11, q12, q20, q21, q22):
        """Director turned by ``dt * omega`` (Rodrigues). PyElastica: ``_get_rotation_matrix``."""
        a0, a1, a2 = dt * w0, dt * w1, dt * w2
        t = a0 * a0 + a1 * a1 + a2 * a2
        halvings = 0
        while t > limit and halvings < _MOST_HALVINGS:
            t *= quarter
            halvings += 1
        sinc, cosc = sinc_series(t), cosc_series(t)
        while halvings > 0:  # the formulae of double angles; the functions' range reduction is float64 in part
            sinc, cosc = sinc * (one - cosc * t), half * sinc * sinc
            t *= four
            halvings -= 1
        u0, u1, u2 = sinc * a0, sinc * a1, sinc * a2
        v0, v1, v2 = cosc * a0, cosc * a1, cosc * a2
        r00, r01, r02 = one - (v1 * a1 + v2 * a2), u2 + v0 * a1, v0 * a2 - u1
        r10, r11, r12 = v0 * a1 - u2, one - (v0 * a0 + v2 * a2), u0 + v1 * a2
        r20, r21, r22 = u1 + v0 * a2, v1 * a2 - u0, one - (v0 * a0 + v1 * a1)
        return (
            r00 * q00 + r01 * q10 + r02 * q20,
            r00 * q01 + r01 * q11 + r02 * q21,
            r00 * q02 + r01 * q12 + r02 * q22,
            r10 * q00 + r11 * q10 + r12 * q20,
            r10 * q01 + r11 * q11 + r12 * q21,
            r10 * q02 + r11 * q12 + r12 * q22,
            r20 * q00 + r21 * q10 + r22 * q20,
            r20 * q01 + r21 * q11 + r22 * q21,
            r20 * q02 + r21 * q12 + r22 * q22,
        )

    return device(turn)


def _make_strain(real: type) -> Callable[..., Any]:
    one, tiny = real(1.0), real(TINY)

    def strain(c, ex, ey, ez, ux, uy, uz, q00, q01, q02, q10, q11, q12, q20, q21, q22, w0, w1, w2):
        """Length, internal force in the world frame, and the element's own torques in the material frame.

        ``e`` is the edge between the two nodes and ``u`` its rate. The torques are the shear couple,
        ``(J w / e) x w`` and ``(J w / e) (de/dt) / e``. PyElastica: ``_compute_internal_forces`` and the element terms
        of ``_compute_internal_torques``.
        """
        length = real(sqrt(ex * ex + ey * ey + ez * ez)) + tiny
        inverse = one / length
        dilatation = length * c.inverse_rest_length
        inverse_dilatation = c.rest_length * inverse
        tx, ty, tz = ex * inverse, ey * inverse, ez * inverse
        # tangent in the material frame
        a0 = q00 * tx + q01 * ty + q02 * tz
        a1 = q10 * tx + q11 * ty + q12 * tz
        a2 = q20 * tx + q21 * ty + q22 * tz
        n0 = c.shear * (dilatation * a0)
        n1 = c.shear * (dilatation * a1)
        n2 = c.stretch * (dilatation * a2 - one)
        sx = (q00 * n0 + q10 * n1 + q20 * n2) * inverse_dilatation
        sy = (q01 * n0 + q11 * n1 + q21 * n2) * inverse_dilatation
        sz = (q02 * n0 + q12 * n1 + q22 * n2) * inverse_dilatation
        rate = (tx * ux + ty * uy + tz * uz) * inverse  # of dilatation, over dilatation
        j0 = c.inertia * w0 * inverse_dilatation
        j1 = c.inertia * w1 * inverse_dilatation
        j2 = c.axial_inertia * w2 * inverse_dilatation
        m0 = (a1 * n2 - a2 * n1) * c.rest_length + (j1 * w2 - j2 * w1) + j0 * rate
        m1 = (a2 * n0 - a0 * n2) * c.rest_length + (j2 * w0 - j0 * w2) + j1 * rate
        m2 = (a0 * n1 - a1 * n0) * c.rest_length + (j0 * w1 - j1 * w0) + j2 * rate
        return length, sx, sy, sz, m0, m1, m2

    return device(strain)


def _make_curvature(real: type) -> Callable[..., Any]:
    one, half, quarter, three = real(1.0), real(0.5), real(0.25), real(3.0)
    limit, largest = real(SMALL_BEND), real(1.0) - np.finfo(real).eps
    ratio_series = horner(real, bend(_BEND_DEGREE[real]))

    def curvature(
        c,
        a00, a01, a02, a10, a11, a12, a20, a21, a22,
        d00, d01, d02, d10, d11, d12, d20, d21, d22,
    ):  # fmt: skip
        """Curvature between an element's director ``a`` and the next one's ``d``. PyElastica: ``_inv_rotate``."""
        x0 = (d20 * a10 + d21 * a11 + d22 * a12) - (d10 * a20 + d11 * a21 + d12 * a22)
        x1 = (d00 * a20 + d01 * a21 + d02 * a22) - (d20 * a00 + d21 * a01 + d22 * a02)
        x2 = (d10 * a00 + d11 * a01 + d12 * a02) - (d00 * a10 + d01 * a11 + d02 * a12)
        trace = (
            (d00 * a00 + d01 * a01 + d02 * a02)
            + (d10 * a10 + d11 * a11 + d12 * a12)
            + (d20 * a20 + d21 * a21 + d22 * a22)
        )
        y = quarter * (three - trace)  # sin^2(theta / 2)
        ratio = ratio_series(y)  # theta / sin(theta)
        if y > limit:
            y = largest if largest < y else y
            ratio = real(asin(real(sqrt(y)))) / real(sqrt(y * (one - y)))
        scale = -half * ratio * c.inverse_voronoi_length
        return x0 * scale, x1 * scale, x2 * scale

    return device(curvature)


def _make_bending(real: type) -> Callable[..., Any]:
    one, half = real(1.0), real(0.5)

    def bending(c, left0, left1, left2, right0, right1, right2, left_length, length, right_length):
        """Bend/twist couples on an element from the curvatures at its two ends.

        At a free end curvature is zero, and any positive length stands for the missing neighbour's. PyElastica: the
        Voronoi terms of ``_compute_internal_torques``; the stiffness being the same about d1 and d2, curvature x couple
        has no component along d3.
        """
        left = half * (left_length + length) * c.inverse_voronoi_length
        right = half * (length + right_length) * c.inverse_voronoi_length
        inverse = one / (left * right)
        over_left, over_right = right * inverse, left * inverse
        over_left = over_left * over_left * over_left
        over_right = over_right * over_right * over_right
        left_turn, right_turn = c.twist_minus_bend * left2, c.twist_minus_bend * right2
        m0 = over_right * (c.bend * right0 + right1 * right_turn) + over_left * (left1 * left_turn - c.bend * left0)
        m1 = over_right * (c.bend * right1 - right0 * right_turn) - over_left * (left0 * left_turn + c.bend * left1)
        m2 = c.twist * (over_right * right2 - over_left * left2)
        return m0, m1, m2

    return device(bending)


def _make_decay(real: type) -> Callable[..., Any]:
    one, limit = real(1.0), real(SMALL_EXPONENT)
    series = horner(real, exponential(_EXP_TERMS[real]))

    def decay(c, dilatation):
        """Factor of the damper on the axial angular velocity, relative to that at dilatation 1; bending's is squared.

        PyElastica: ``AnalyticalLinearDamper.dampen_rates``.
        """
        x = c.decay_rate * (one - dilatation)
        factor = series(x)
        if abs(x) > limit:
            factor = real(exp(x))
        return factor

    return device(decay)


def _make_straighten(real: type) -> Callable[..., Any]:
    half, three = real(0.5), real(3.0)

    def straighten(a0, a1, a2, b0, b1, b2, c0, c1, c2):
        """Director orthonormal to round-off again; see ``straightened`` in ``torch_backend``."""
        aa = half * (three - (a0 * a0 + a1 * a1 + a2 * a2))
        bb = half * (three - (b0 * b0 + b1 * b1 + b2 * b2))
        cc = half * (three - (c0 * c0 + c1 * c1 + c2 * c2))
        ab = -half * (a0 * b0 + a1 * b1 + a2 * b2)
        ac = -half * (a0 * c0 + a1 * c1 + a2 * c2)
        bc = -half * (b0 * c0 + b1 * c1 + b2 * c2)
        return (
            aa * a0 + ab * b0 + ac * c0,
            aa * a1 + ab * b1 + ac * c1,
            aa * a2 + ab * b2 + ac * c2,
            ab * a0 + bb * b0 + bc * c0,
            ab * a1 + bb * b1 + bc * c1,
            ab * a2 + bb * b2 + bc * c2,
            ac * a0 + bc * b0 + cc * c0,
            ac * a1 + bc * b1 + cc * c1,
            ac * a2 + bc * b2 + cc * c2,
        )

    return device(straighten)


def horner(real: type, series: Sequence[float]) -> Callable[..., Any]:
    """Make a device function that evaluates a polynomial, constant first, unrolled at compile time."""
    constant = real(series[0])
    if len(series) == 1:
        return device(lambda x: constant)
    rest = horner(real, series[1:])

    def value(x):
        return rest(x) * x + constant

    return device(value)
