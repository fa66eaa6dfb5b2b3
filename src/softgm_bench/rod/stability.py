"""The longest time step at which the explicit integrator still follows a rod."""

import math

import numpy as np

from softgm_bench.rod.parameters import RodParameters

# Share of the limit that settings may use. Under random torques on eight arms (moduli, density, length, radius and
# damping over a factor of ten), all at 1.05 were torn apart within three control steps; at 0.95 none was within seven.
MARGIN = 0.95
POINTS = 512  # among which the limit is looked for: a quarter of a per cent


def longest_time_step(parameters: RodParameters) -> float:
    """Find the longest stable ``dt`` of a straight rod, s.

    The fastest of the linearised rod's modes are those in which neighbours move against each other: stretching, stable
    up to ``dl sqrt(rho / E)``, twisting, and bending with shearing, which are one mode of two coordinates. A step is
    ``v' = d (v - H x dt)``, ``x' = x + v' dt`` with a factor ``d`` of damping in each coordinate; it is unstable where
    an eigenvalue is below -1, that is where ``H dt^2`` exceeds ``2 (1 + 1 / d)``. Rotations of a thin rod are damped so
    strongly that they never are.
    """
    dl, rho = parameters.base_length / parameters.n_elements, parameters.density
    e, g = parameters.youngs_modulus / rho, parameters.shear_modulus / rho  # squares of speeds of sound
    sheared = 27.0 / 28.0 * g
    thin = 4.0 / parameters.base_radius**2  # cross-section over its second moment
    coupling = 2.0 * sheared * math.sqrt(thin) / dl
    bending = np.array([[4.0 * sheared / dl**2, coupling], [coupling, sheared * thin + 4.0 * e / dl**2]])
    slow = parameters.damping_constant  # rates of damping, 1/s
    fast = slow * thin if parameters.damping_protocol == "damping_constant" else slow

    def excess(dt: float) -> float:
        """Largest eigenvalue of ``H dt^2`` over what is stable."""
        moved, turned, twisted = (2.0 * (1.0 + math.exp(min(rate * dt, 700.0))) for rate in (slow, fast, 0.5 * fast))
        scale = dt / np.sqrt([moved, turned])
        largest = np.linalg.eigvalsh(bending * np.outer(scale, scale))[-1]
        return max(4.0 * e / dl**2 * dt**2 / moved, 4.0 * g / dl**2 * dt**2 / twisted, largest)

    # stretching is hardly damped, so the limit is about its own at most
    candidates = 1.1 * dl / math.sqrt(e) * np.arange(1, POINTS + 1) / POINTS
    return float(next((dt for dt in candidates if excess(dt) > 1.0), candidates[-1]))


def check_time_step(parameters: RodParameters) -> None:
    """Refuse a time step at which the rod would be torn apart by its first movement.

    Raises:
        ValueError: with one line naming the limit, and a step and number of substeps that would do.
    """
    limit = MARGIN * longest_time_step(parameters)
    if parameters.dt <= limit:
        return
    raise ValueError(
        f"rod.dt={parameters.dt:g}: with n_elements, base_length, base_radius, density and moduli as they are, the "
        f"integrator is stable up to {limit:.3g} s; give {finer_step(parameters, limit)}"
    )


def finer_step(parameters: RodParameters, limit: float) -> str:
    """Write the settings of a time step well below ``limit`` s that divides the control step."""
    substeps = math.ceil(parameters.control_dt / (0.9 * limit))
    return f"rod.dt={parameters.control_dt / substeps:.6g} rod.substeps={substeps}"
