"""Solutions that we did not simulate: closed forms, scipy's root of the discrete equilibrium, PyElastica's energies.

All of them are for an arm that is clamped at the origin along +z and bends in one plane, which contains z and the
horizontal direction at ``azimuth`` from +x. The discretisation (Gazzola et al. 2018, eqs 3.8 and 3.9) has couples at
the inner nodes only, and its clamp holds the whole first element.
"""

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import root
from scipy.spatial.transform import Rotation
from torch import Tensor

from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.pyelastica_oracle import straight_rod
from softgm_bench.rod.state import RodState, straight_rods

Array = NDArray[np.float64]


class Stiffness(NamedTuple):
    """Of the circular cross-section at rest: stretch EA and shear 27/28 GA in N, bend EI in N m^2."""

    stretch: float
    shear: float
    bend: float


class Plane(NamedTuple):
    """A planar configuration, by element.

    Attributes:
        tilt: angle of d3 from +z, rad, ``(n_elements,)``.
        tangent_tilt: angle of the tangent from +z, rad, ``(n_elements,)``.
        dilatation: ``(n_elements,)``.
    """

    tilt: Array
    tangent_tilt: Array
    dilatation: Array


def stiffness(parameters: RodParameters) -> Stiffness:
    area, r = np.pi * parameters.base_radius**2, parameters.base_radius
    return Stiffness(
        stretch=parameters.youngs_modulus * area,
        shear=27.0 / 28.0 * parameters.shear_modulus * area,
        bend=parameters.youngs_modulus * np.pi * r**4 / 4.0,
    )


def timoshenko_tip(parameters: RodParameters, force: float, stiff_length: float = 0.0) -> float:
    """Deflection of a Timoshenko cantilever under a small force across its tip, m: F L^3 / 3EI + F L / kGA.

    The first ``stiff_length`` metres shear but do not bend.
    """
    k, length = stiffness(parameters), parameters.base_length
    return force * (length - stiff_length) ** 3 / (3.0 * k.bend) + force * length / k.shear


def discrete_cantilever_tip(parameters: RodParameters, force: float) -> float:
    """The same for n elements: the bending term times (1 - 1/n)(1 - 1/2n).

    The couple at node j is F (L - s_j); d3 turns by it over EI and one element length at the nodes 1 to n - 1.
    """
    k, length, n = stiffness(parameters), parameters.base_length, parameters.n_elements
    bending = force * length**3 / (3.0 * k.bend)
    return bending * (1.0 - 1.0 / n) * (1.0 - 0.5 / n) + force * length / k.shear


def stretch(parameters: RodParameters, force: float) -> float:
    """Dilatation under an axial tip force.

    The stress EA (e - 1) acts on a cross-section that shrinks with 1 / e: F = EA (e - 1) / e.
    """
    return 1.0 / (1.0 - force / stiffness(parameters).stretch)


def arc(parameters: RodParameters, couple: float) -> Plane:
    """Under a couple about the last element: the same turn at every inner node, no force."""
    n = parameters.n_elements
    turn = couple * parameters.base_length / n / stiffness(parameters).bend
    tilt = turn * np.arange(n)
    return Plane(tilt, tilt, np.ones(n))


def tip_force_equilibrium(parameters: RodParameters, across: float, along: float) -> Plane:
    """The discrete equilibrium under a tip force of any size, found by scipy.

    In equilibrium every element carries the tip force, which fixes its shear angle and dilatation once the tilt of its
    d3 is known; the couple at each inner node is the moment of the tip force about it. Unknown are n - 1 tilts.
    """
    n, k = parameters.n_elements, stiffness(parameters)
    length = parameters.base_length / n

    def plane(free: Array) -> Plane:
        tilt = np.concatenate([[0.0], free])
        normal = across * np.cos(tilt) - along * np.sin(tilt)
        axial = across * np.sin(tilt) + along * np.cos(tilt)
        shear_angle = np.arcsin(normal / k.shear)
        return Plane(tilt, tilt + shear_angle, 1.0 / (np.cos(shear_angle) - axial / k.stretch))

    def residual(free: Array) -> Array:
        tilt, tangent_tilt, dilatation = plane(free)
        x, z = nodes(parameters, Plane(tilt, tangent_tilt, dilatation))
        moment = across * (z[-1] - z[1:-1]) - along * (x[-1] - x[1:-1])
        voronoi_dilatation = 0.5 * (dilatation[1:] + dilatation[:-1])
        return np.diff(tilt) - moment * length / k.bend * voronoi_dilatation**3

    found = root(residual, np.zeros(n - 1), tol=1e-14)
    assert np.abs(residual(found.x)).max() < 1e-13, found.message
    return plane(found.x)


def nodes(parameters: RodParameters, plane: Plane) -> tuple[Array, Array]:
    """Horizontal and vertical coordinates of the nodes, m, each ``(n_nodes,)``."""
    edge = plane.dilatation * parameters.base_length / parameters.n_elements
    x = np.cumsum(edge * np.sin(plane.tangent_tilt))
    z = np.cumsum(edge * np.cos(plane.tangent_tilt))
    return np.concatenate([[0.0], x]), np.concatenate([[0.0], z])


def state_of(parameters: RodParameters, plane: Plane, azimuth: float = 0.0) -> RodState:
    """One rod at rest in this configuration."""
    state = straight_rods(parameters, 1)
    x, z = nodes(parameters, plane)
    direction = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    state.position[0] = torch.as_tensor(direction[:, None] * x + np.array([[0.0], [0.0], [1.0]]) * z)
    turn = rotation(np.array([-direction[1], direction[0], 0.0]), plane.tilt)
    rest = state.director[0].numpy()
    state.director[0] = torch.as_tensor(np.einsum("iak,kba->ibk", rest, turn))
    return state


def rotation(axis: Array, angle: Array) -> Array:
    """Rotation matrices about a unit axis, ``(len(angle), 3, 3)``."""
    return Rotation.from_rotvec(angle[:, None] * axis).as_matrix()


def tip_load(parameters: RodParameters, force: tuple[float, float, float]) -> Tensor:
    """A force on the last node, ``(1, 3, n_nodes)``."""
    load = torch.zeros(1, 3, parameters.n_nodes, dtype=torch.float64)
    load[0, :, -1] = torch.tensor(force, dtype=torch.float64)
    return load


def end_couple(parameters: RodParameters, couple: float, azimuth: float = 0.0) -> Tensor:
    """A couple on the last element that bends the arm towards ``azimuth``, ``(1, 3, n_elements)``."""
    load = torch.zeros(1, 3, parameters.n_elements, dtype=torch.float64)
    # d1 = +y bends towards +x, d2 = -x towards +y
    load[0, :2, -1] = couple * torch.tensor([np.cos(azimuth), np.sin(azimuth)])
    return load


def relax(
    parameters: RodParameters,
    couple: Tensor | None = None,
    force: Tensor | None = None,
    seconds: float = 20.0,
    start: RodState | None = None,
) -> RodState:
    """Hold the loads until the arm, straight at first, has come to rest; the damping should be near critical."""
    if couple is None:
        couple = torch.zeros(1, 3, parameters.n_elements, dtype=torch.float64)
    start = straight_rods(parameters, 1) if start is None else start
    rod = make_backend("numba", parameters)
    return rod.control_step(start, couple, force, substeps=round(seconds / parameters.dt))


class Energy(NamedTuple):
    """As PyElastica's ``RodEnergy`` computes it, J."""

    translational: float
    rotational: float
    bend_twist: float
    shear_stretch: float


class Energies:
    """Evaluates PyElastica's energy functions on our states."""

    def __init__(self, parameters: RodParameters) -> None:
        self._rod = straight_rod(parameters)

    def __call__(self, state: RodState, index: int = 0) -> Energy:
        rod = self._rod
        rod.position_collection[...] = state.position[index].numpy()
        rod.director_collection[...] = state.director[index].numpy()
        rod.velocity_collection[...] = state.velocity[index].numpy()
        rod.omega_collection[...] = state.omega[index].numpy()
        rod.compute_internal_forces_and_torques(np.float64(0.0))  # refreshes strains and dilatations
        return Energy(
            float(rod.compute_translational_energy()),
            float(rod.compute_rotational_energy()),
            float(rod.compute_bending_energy()),
            float(rod.compute_shear_energy()),
        )
