# Compiled callees reach a function as globals (see jit), out of the linters' sight.
# ruff: noqa: F821
# mypy: disable-error-code="name-defined"
"""Vectorisable loops over elements make one substep of one rod (Gazzola et al. 2018; PyElastica's arithmetic).

Loops work in place on the flat buffer described in ``numba_layout``. Transcendental functions are replaced by
polynomials that are exact to round-off inside a stated range; outside of it a scalar loop calls the functions.
"""

from collections.abc import Callable
from functools import lru_cache
from math import acos, cos, exp, sin, sqrt
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir
from numba.extending import intrinsic

from softgm_bench.rod.callees import with_callees
from softgm_bench.rod.compiling import njit
from softgm_bench.rod.numba_layout import Layout, make_layout
from softgm_bench.rod.series import SMALL_BEND, SMALL_EXPONENT, SMALL_TURN, TINY, bend, cosc, exponential, sinc

# No NaN test happens inside the kernel, so "nnan" is safe; infinities keep their IEEE meaning.
FASTMATH = {"contract", "reassoc", "nsz", "nnan", "arcp"}

SINC, COSC, BEND, EXP = sinc(7), cosc(7), bend(11), exponential(11)


def jit(
    function: Callable[..., Any], parallel: bool = False, inline: bool = False, **callees: Callable[..., Any]
) -> Callable[..., Any]:
    """Compile with the kernel's flags, keeping the machine code on disk between runs.

    ``callees`` are bound as ``callees`` says; ``Layout.source`` in the closure stands for their content. A function
    with ``inline`` becomes part of each caller before LLVM sees it, as if it had been written there.
    """
    compiler = njit(
        fastmath=FASTMATH,
        error_model="numpy",
        parallel=parallel,
        inline="always" if inline else "never",
    )
    return compiler(with_callees(function, callees))


@intrinsic
def larger(typing_context, a, b):
    """Return the larger of two numbers of one type in a form that LLVM vectorises as a reduction, unlike ``max``."""

    def generate(context, builder, signature, arguments):
        real = arguments[0].type
        maxnum = builder.module.declare_intrinsic("llvm.maxnum", (real,), ir.FunctionType(real, [real, real]))
        return builder.call(maxnum, arguments)

    return a(a, a), generate


def rounded(coefficients: tuple[float, ...], largest: float, real: type) -> tuple[Any, ...]:
    """Return a polynomial's coefficients in one precision, zero where their term is below round-off.

    Multiplying by a constant zero costs nothing: the compiler drops it.
    """
    floor = 0.1 * float(np.finfo(real).eps) * abs(coefficients[0])
    return tuple(real(c if abs(c) * largest**k > floor else 0.0) for k, c in enumerate(coefficients))


class Kernel(NamedTuple):
    """These are compiled functions on one rod's buffer."""

    stresses: Callable[..., Any]
    couples: Callable[..., Any]
    spin: Callable[..., Any]
    rotate: Callable[..., Any]
    push: Callable[..., Any]
    move: Callable[..., Any]


@lru_cache
def make_kernel(n_elements: int, dtype: type) -> Kernel:
    """Compile the loops for one element count and one precision."""
    layout = make_layout(n_elements, dtype)
    return Kernel(
        stresses=_make_stresses(layout, dtype),
        couples=_make_couples(layout, dtype),
        spin=_make_spin(layout, dtype),
        rotate=_make_rotate(layout, dtype),
        push=_make_push(layout, dtype),
        move=_make_move(layout, dtype),
    )


def _make_stresses(layout: Layout, real: type) -> Callable[..., Any]:
    p, n = layout, layout.elements
    one, tiny = real(1.0), real(TINY)

    def stresses(s):
        """Shear/stretch stress, cross-section force and the element's own torque terms.

        PyElastica: ``_compute_internal_forces`` and the element terms of ``_compute_internal_torques``.
        """
        for k in range(n):
            ex = s[p.px + k + 1] - s[p.px + k]
            ey = s[p.py + k + 1] - s[p.py + k]
            ez = s[p.pz + k + 1] - s[p.pz + k]
            length = np.sqrt(ex * ex + ey * ey + ez * ez) + tiny
            inverse = one / length
            dilatation = length * s[p.inverse_rest + k]
            inverse_dilatation = s[p.rest + k] * inverse
            tx, ty, tz = ex * inverse, ey * inverse, ez * inverse
            # tangent in the material frame
            a0 = s[p.q00 + k] * tx + s[p.q01 + k] * ty + s[p.q02 + k] * tz
            a1 = s[p.q10 + k] * tx + s[p.q11 + k] * ty + s[p.q12 + k] * tz
            a2 = s[p.q20 + k] * tx + s[p.q21 + k] * ty + s[p.q22 + k] * tz
            n0 = s[p.shear0 + k] * (dilatation * a0)
            n1 = s[p.shear0 + k] * (dilatation * a1)
            n2 = s[p.shear2 + k] * (dilatation * a2 - one)
            s[p.sx + k] = (s[p.q00 + k] * n0 + s[p.q10 + k] * n1 + s[p.q20 + k] * n2) * inverse_dilatation
            s[p.sy + k] = (s[p.q01 + k] * n0 + s[p.q11 + k] * n1 + s[p.q21 + k] * n2) * inverse_dilatation
            s[p.sz + k] = (s[p.q02 + k] * n0 + s[p.q12 + k] * n1 + s[p.q22 + k] * n2) * inverse_dilatation
            # rate of dilatation over dilatation
            rate = (
                ex * (s[p.vx + k + 1] - s[p.vx + k])
                + ey * (s[p.vy + k + 1] - s[p.vy + k])
                + ez * (s[p.vz + k + 1] - s[p.vz + k])
            ) * (inverse * inverse)
            w0, w1, w2 = s[p.w0 + k], s[p.w1 + k], s[p.w2 + k]
            j0 = s[p.inertia0 + k] * w0 * inverse_dilatation
            j1 = s[p.inertia0 + k] * w1 * inverse_dilatation
            j2 = s[p.inertia2 + k] * w2 * inverse_dilatation
            rest = s[p.rest + k]
            # shear couple + (J w / e) x w + (J w / e) (de/dt) / e + external couple
            s[p.m0 + k] = (a1 * n2 - a2 * n1) * rest + (j1 * w2 - j2 * w1) + j0 * rate + s[p.t0 + k]
            s[p.m1 + k] = (a2 * n0 - a0 * n2) * rest + (j2 * w0 - j0 * w2) + j1 * rate + s[p.t1 + k]
            s[p.m2 + k] = (a0 * n1 - a1 * n0) * rest + (j0 * w1 - j1 * w0) + j2 * rate + s[p.t2 + k]
            s[p.length + k] = length
            s[p.dilatation + k] = dilatation

    return jit(stresses)


def _make_couples(layout: Layout, real: type) -> Callable[..., Any]:
    p, n = layout, layout.elements
    one, half, quarter, zero = real(1.0), real(0.5), real(0.25), real(0.0)
    limit, tiny = real(SMALL_BEND), real(TINY)
    b0, b1, b2, b3, b4, b5, b6, b7, b8, b9, b10, b11, b12 = rounded(BEND, SMALL_BEND, real)

    def couples(s):
        """Curvature and bend/twist couple at interior nodes.

        PyElastica: ``_inv_rotate``, ``_compute_internal_bending_twist_stresses_from_model`` and the Voronoi terms of
        ``_compute_internal_torques``.
        """
        sharpest = zero
        for k in range(n):
            a00, a01, a02 = s[p.q00 + k], s[p.q01 + k], s[p.q02 + k]
            a10, a11, a12 = s[p.q10 + k], s[p.q11 + k], s[p.q12 + k]
            a20, a21, a22 = s[p.q20 + k], s[p.q21 + k], s[p.q22 + k]
            d00, d01, d02 = s[p.q00 + k + 1], s[p.q01 + k + 1], s[p.q02 + k + 1]
            d10, d11, d12 = s[p.q10 + k + 1], s[p.q11 + k + 1], s[p.q12 + k + 1]
            d20, d21, d22 = s[p.q20 + k + 1], s[p.q21 + k + 1], s[p.q22 + k + 1]
            x0 = (d20 * a10 + d21 * a11 + d22 * a12) - (d10 * a20 + d11 * a21 + d12 * a22)
            x1 = (d00 * a20 + d01 * a21 + d02 * a22) - (d20 * a00 + d21 * a01 + d22 * a02)
            x2 = (d10 * a00 + d11 * a01 + d12 * a02) - (d00 * a10 + d01 * a11 + d02 * a12)
            trace = (
                (d00 * a00 + d01 * a01 + d02 * a02)
                + (d10 * a10 + d11 * a11 + d12 * a12)
                + (d20 * a20 + d21 * a21 + d22 * a22)
            )
            y = quarter * (s[p.three + k] - trace)
            sharpest = larger(sharpest, y)
            # theta / sin(theta) as a polynomial of sin^2(theta / 2)
            ratio = b12
            ratio = ratio * y + b11
            ratio = ratio * y + b10
            ratio = ratio * y + b9
            ratio = ratio * y + b8
            ratio = ratio * y + b7
            ratio = ratio * y + b6
            ratio = ratio * y + b5
            ratio = ratio * y + b4
            ratio = ratio * y + b3
            ratio = ratio * y + b2
            ratio = ratio * y + b1
            ratio = ratio * y + b0
            scale = -half * ratio * s[p.inverse_voronoi + k]
            s[p.c0 + k] = x0 * scale
            s[p.c1 + k] = x1 * scale
            s[p.c2 + k] = x2 * scale
            s[p.k0 + k] = y
        if sharpest > limit:
            sharp_bends(s)
        for k in range(n):
            kappa0, kappa1, kappa2 = s[p.c0 + k], s[p.c1 + k], s[p.c2 + k]
            inverse_dilatation = (s[p.voronoi + k] + s[p.voronoi + k]) / (s[p.length + k] + s[p.length + k + 1])
            inverse_cube = inverse_dilatation * inverse_dilatation * inverse_dilatation
            tau0 = s[p.bend0 + k] * kappa0 * inverse_cube
            tau1 = s[p.bend0 + k] * kappa1 * inverse_cube
            tau2 = s[p.bend2 + k] * kappa2 * inverse_cube
            s[p.c0 + k] = tau0
            s[p.c1 + k] = tau1
            s[p.c2 + k] = tau2
            weight = half * s[p.voronoi + k]
            s[p.k0 + k] = (kappa1 * tau2 - kappa2 * tau1) * weight
            s[p.k1 + k] = (kappa2 * tau0 - kappa0 * tau2) * weight
            s[p.k2 + k] = (kappa0 * tau1 - kappa1 * tau0) * weight

    def sharp(s):
        # Replace the polynomial where neighbouring directors differ by more than it covers.
        for k in range(n):
            y = s[p.k0 + k]
            if y > limit:
                ratio = b12
                for b in (b11, b10, b9, b8, b7, b6, b5, b4, b3, b2, b1, b0):
                    ratio = ratio * y + b
                theta = real(acos(max(one - (y + y), -one))) + tiny
                correction = theta / real(sin(theta)) / ratio
                s[p.c0 + k] *= correction
                s[p.c1 + k] *= correction
                s[p.c2 + k] *= correction

    return jit(couples, sharp_bends=jit(sharp))


def _make_spin(layout: Layout, real: type) -> Callable[..., Any]:
    p, n = layout, layout.elements
    zero, one, limit = real(0.0), real(1.0), real(SMALL_EXPONENT)
    e0, e1, e2, e3, e4, e5, e6, e7, e8, e9, e10 = rounded(EXP, SMALL_EXPONENT, real)

    def spin(s):
        """Angular velocity of elements: dynamic step, clamped base, damper.

        PyElastica: ``_update_accelerations``, ``OneEndFixedBC``, ``AnalyticalLinearDamper``.
        """
        largest = zero
        for k in range(n):
            x = s[p.decay_rate + k] * (one - s[p.dilatation + k])
            largest = larger(largest, abs(x))
            factor = e10
            factor = factor * x + e9
            factor = factor * x + e8
            factor = factor * x + e7
            factor = factor * x + e6
            factor = factor * x + e5
            factor = factor * x + e4
            factor = factor * x + e3
            factor = factor * x + e2
            factor = factor * x + e1
            factor = factor * x + e0
            s[p.length + k] = factor
        if largest > limit:
            for k in range(n):
                s[p.length + k] = real(exp(s[p.decay_rate + k] * (one - s[p.dilatation + k])))
        for k in range(n):
            factor = s[p.length + k]
            bending = s[p.decay0 + k] * factor * factor
            step0 = s[p.step0 + k] * s[p.dilatation + k]
            step2 = s[p.step2 + k] * s[p.dilatation + k]
            m0 = s[p.m0 + k] + (s[p.c0 + k] - s[p.c0 + k - 1]) + (s[p.k0 + k] + s[p.k0 + k - 1])
            m1 = s[p.m1 + k] + (s[p.c1 + k] - s[p.c1 + k - 1]) + (s[p.k1 + k] + s[p.k1 + k - 1])
            m2 = s[p.m2 + k] + (s[p.c2 + k] - s[p.c2 + k - 1]) + (s[p.k2 + k] + s[p.k2 + k - 1])
            s[p.w0 + k] = (s[p.w0 + k] + step0 * m0) * bending
            s[p.w1 + k] = (s[p.w1 + k] + step0 * m1) * bending
            s[p.w2 + k] = (s[p.w2 + k] + step2 * m2) * (s[p.decay2 + k] * factor)
        s[p.w0] = s[p.w1] = s[p.w2] = real(0.0)

    return jit(spin)


def _make_rotate(layout: Layout, real: type) -> Callable[..., Any]:
    p, n = layout, layout.elements
    zero, one, limit = real(0.0), real(1.0), real(SMALL_TURN)
    s0, s1, s2, s3, s4, s5, s6 = rounded(SINC, SMALL_TURN, real)
    c0, c1, c2, c3, c4, c5, c6 = rounded(COSC, SMALL_TURN, real)

    def rotate(s, dt):
        """Directors turn by ``dt * omega`` (Rodrigues). PyElastica: ``_get_rotation_matrix``."""
        fastest = zero
        for k in range(n):
            a0, a1, a2 = dt * s[p.w0 + k], dt * s[p.w1 + k], dt * s[p.w2 + k]
            t = a0 * a0 + a1 * a1 + a2 * a2
            fastest = larger(fastest, t)
            sinc = s6
            sinc = sinc * t + s5
            sinc = sinc * t + s4
            sinc = sinc * t + s3
            sinc = sinc * t + s2
            sinc = sinc * t + s1
            sinc = sinc * t + s0
            cosc = c6
            cosc = cosc * t + c5
            cosc = cosc * t + c4
            cosc = cosc * t + c3
            cosc = cosc * t + c2
            cosc = cosc * t + c1
            cosc = cosc * t + c0
            s[p.m0 + k] = sinc
            s[p.m1 + k] = cosc
        if fastest > limit:
            for k in range(n):
                a0, a1, a2 = dt * s[p.w0 + k], dt * s[p.w1 + k], dt * s[p.w2 + k]
                t = a0 * a0 + a1 * a1 + a2 * a2
                if t > limit:
                    theta = sqrt(t)
                    s[p.m0 + k] = real(sin(theta)) / real(theta)
                    s[p.m1 + k] = (one - real(cos(theta))) / t
        for k in range(n):
            sinc, cosc = s[p.m0 + k], s[p.m1 + k]
            a0, a1, a2 = dt * s[p.w0 + k], dt * s[p.w1 + k], dt * s[p.w2 + k]
            u0, u1, u2 = sinc * a0, sinc * a1, sinc * a2
            v0, v1, v2 = cosc * a0, cosc * a1, cosc * a2
            r00, r01, r02 = one - (v1 * a1 + v2 * a2), u2 + v0 * a1, v0 * a2 - u1
            r10, r11, r12 = v0 * a1 - u2, one - (v0 * a0 + v2 * a2), u0 + v1 * a2
            r20, r21, r22 = u1 + v0 * a2, v1 * a2 - u0, one - (v0 * a0 + v1 * a1)
            x, y, z = s[p.q00 + k], s[p.q10 + k], s[p.q20 + k]
            s[p.q00 + k] = r00 * x + r01 * y + r02 * z
            s[p.q10 + k] = r10 * x + r11 * y + r12 * z
            s[p.q20 + k] = r20 * x + r21 * y + r22 * z
            x, y, z = s[p.q01 + k], s[p.q11 + k], s[p.q21 + k]
            s[p.q01 + k] = r00 * x + r01 * y + r02 * z
            s[p.q11 + k] = r10 * x + r11 * y + r12 * z
            s[p.q21 + k] = r20 * x + r21 * y + r22 * z
            x, y, z = s[p.q02 + k], s[p.q12 + k], s[p.q22 + k]
            s[p.q02 + k] = r00 * x + r01 * y + r02 * z
            s[p.q12 + k] = r10 * x + r11 * y + r12 * z
            s[p.q22 + k] = r20 * x + r21 * y + r22 * z

    return jit(rotate)


def _make_push(layout: Layout, real: type) -> Callable[..., Any]:
    p, nodes = layout, layout.nodes
    zero = real(0.0)

    def push(s, decay):
        """Velocity of nodes: dynamic step, clamped base, damper. Returns the largest squared speed."""
        fastest = zero
        for k in range(nodes):
            step = s[p.node_step + k]
            vx = (s[p.vx + k] + step * (s[p.sx + k] - s[p.sx + k - 1] + s[p.fx + k])) * decay
            vy = (s[p.vy + k] + step * (s[p.sy + k] - s[p.sy + k - 1] + s[p.fy + k])) * decay
            vz = (s[p.vz + k] + step * (s[p.sz + k] - s[p.sz + k - 1] + s[p.fz + k])) * decay
            s[p.vx + k] = vx
            s[p.vy + k] = vy
            s[p.vz + k] = vz
            fastest = larger(fastest, vx * vx + vy * vy + vz * vz)
        s[p.vx] = s[p.vy] = s[p.vz] = zero
        return fastest

    return jit(push)


def _make_move(layout: Layout, real: type) -> Callable[..., Any]:
    p, nodes = layout, layout.nodes

    def move(s, dt):
        """Position of nodes: kinematic step."""
        for k in range(nodes):
            s[p.px + k] += dt * s[p.vx + k]
            s[p.py + k] += dt * s[p.vy + k]
            s[p.pz + k] += dt * s[p.vz + k]

    return jit(move)


def make_straighten(layout: Layout, real: type) -> Callable[..., Any]:
    """Compile ``straighten`` for one layout and one precision."""
    p, n = layout, layout.elements
    half, three = real(0.5), real(3.0)

    def straighten(s):
        """Make directors orthonormal to round-off again: one Newton step towards the nearest rotation.

        Q becomes (3 - Q Q^T) Q / 2. PyElastica leaves directors to themselves. In float64 they stay within 1e-13; in
        float32 what they lose in each of thousands of steps adds up, and the arm drifts with it.
        """
        for k in range(n):
            a0, a1, a2 = s[p.q00 + k], s[p.q01 + k], s[p.q02 + k]
            b0, b1, b2 = s[p.q10 + k], s[p.q11 + k], s[p.q12 + k]
            c0, c1, c2 = s[p.q20 + k], s[p.q21 + k], s[p.q22 + k]
            aa = half * (three - (a0 * a0 + a1 * a1 + a2 * a2))
            bb = half * (three - (b0 * b0 + b1 * b1 + b2 * b2))
            cc = half * (three - (c0 * c0 + c1 * c1 + c2 * c2))
            ab = -half * (a0 * b0 + a1 * b1 + a2 * b2)
            ac = -half * (a0 * c0 + a1 * c1 + a2 * c2)
            bc = -half * (b0 * c0 + b1 * c1 + b2 * c2)
            s[p.q00 + k], s[p.q01 + k] = aa * a0 + ab * b0 + ac * c0, aa * a1 + ab * b1 + ac * c1
            s[p.q02 + k] = aa * a2 + ab * b2 + ac * c2
            s[p.q10 + k], s[p.q11 + k] = ab * a0 + bb * b0 + bc * c0, ab * a1 + bb * b1 + bc * c1
            s[p.q12 + k] = ab * a2 + bb * b2 + bc * c2
            s[p.q20 + k], s[p.q21 + k] = ac * a0 + bc * b0 + cc * c0, ac * a1 + bc * b1 + cc * c1
            s[p.q22 + k] = ac * a2 + bc * b2 + cc * c2

    return jit(straighten)
