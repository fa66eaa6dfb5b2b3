"""Polynomials stand for transcendental functions in the fused kernels, within the ranges given here.

Their coefficients begin with the constant. With the number of terms that ``numba_kernel`` uses, each is exact to
float64's round-off in its range.
"""

from math import factorial

import numpy as np
from numpy.polynomial import Chebyshev, Polynomial

TINY = 1e-14  # PyElastica adds it to lengths and angles
SMALL_TURN = 0.25  # squared rotation angle per step up to which ``sinc`` and ``cosc`` hold
SMALL_BEND = 0.15  # sin^2(theta/2) between neighbouring directors up to which ``bend`` holds (theta < 45 degrees)
SMALL_EXPONENT = 0.2  # |exponent| up to which ``exponential`` holds


def sinc(terms: int) -> tuple[float, ...]:
    """Return the coefficients of ``sin(x) / x`` as a polynomial of ``x^2``."""
    return tuple((-1.0) ** k / factorial(2 * k + 1) for k in range(terms))


def cosc(terms: int) -> tuple[float, ...]:
    """Return the coefficients of ``(1 - cos(x)) / x^2`` as a polynomial of ``x^2``."""
    return tuple((-1.0) ** k / factorial(2 * k + 2) for k in range(terms))


def bend(degree: int) -> tuple[float, ...]:
    """Return ``theta / sin(theta)`` as a polynomial of ``sin^2(theta / 2)`` of ``degree + 1``, exactly 1 at 0."""
    tail = Chebyshev.interpolate(
        lambda x: (np.arcsin(np.sqrt(x)) / np.sqrt(x * (1.0 - x)) - 1.0) / x, degree, domain=[0.0, SMALL_BEND]
    )
    return (1.0, *(float(c) for c in tail.convert(kind=Polynomial).coef))


def exponential(terms: int) -> tuple[float, ...]:
    """Return the coefficients of ``exp(x)`` as a polynomial of ``x``."""
    return tuple(1.0 / factorial(k) for k in range(terms))
