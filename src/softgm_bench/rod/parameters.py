"""This module holds the arm's physical parameters and derives the constants of the discretised rod from them."""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

DAMPING_PROTOCOLS = ("damping_constant", "uniform_damping_constant")
CONTACT_MODELS = ("pyelastica", "exact")

Array = NDArray[np.float64]


class ContactCoefficients(NamedTuple):
    """The fused kernels multiply with these; in this order they are the Numba kernel's table."""

    stiffness: float
    damping: float
    friction: float
    slip_damping: float


@dataclass(frozen=True)
class RodParameters:
    """These parameters describe one uniform Cosserat rod with a clamped base in SI units, by default the paper's arm.

    ``damping_protocol`` names the form of PyElastica's ``AnalyticalLinearDamper`` that receives ``damping_constant``.
    One control step is ``substeps`` position-Verlet steps of ``dt`` seconds.

    ``contact_model`` is ``pyelastica`` (``contact.py``) or ``exact`` (``exact_contact.py``). ``contact_stiffness``
    (N/m), ``contact_damping`` and ``velocity_damping_coefficient`` (N s/m) act on each element in the first; in the
    second they act on each ``contact_length`` metres of rest arc length, by default an element of the paper's arm.
    """

    n_elements: int = 60
    base_length: float = 1.0
    base_radius: float = 0.05
    density: float = 1000.0
    youngs_modulus: float = 5e5
    shear_modulus: float = 2e5
    gravity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    damping_protocol: str = "damping_constant"
    damping_constant: float = 0.3
    contact_stiffness: float = 5e4
    contact_damping: float = 50.0
    friction_coefficient: float = 0.0
    velocity_damping_coefficient: float = 0.0
    contact_model: str = "pyelastica"
    contact_length: float = 1.0 / 60.0
    dt: float = 4e-4
    substeps: int = 100

    def __post_init__(self) -> None:
        """Refuse parameters that describe no rod.

        Raises:
            ValueError: with one line naming the field, its value and what would be right.
        """
        for item in fields(self):
            value = getattr(self, item.name)
            if not isinstance(value, str) and not np.isfinite(value).all():
                raise ValueError(f"rod.{item.name} is {value}: it must be finite")
        if self.n_elements < 2:
            raise ValueError(f"rod.n_elements is {self.n_elements}: a rod needs at least 2 elements")
        if self.substeps < 1:
            raise ValueError(f"rod.substeps is {self.substeps}: a control step needs at least 1 substep")
        positive = (
            "base_length",
            "base_radius",
            "density",
            "youngs_modulus",
            "shear_modulus",
            "contact_length",
            "dt",
        )
        for name in positive:
            if not getattr(self, name) > 0.0:
                raise ValueError(f"rod.{name} is {getattr(self, name)}: it must be above 0")
        not_negative = (
            "damping_constant",
            "contact_stiffness",
            "contact_damping",
            "friction_coefficient",
            "velocity_damping_coefficient",
        )
        for name in not_negative:
            if not getattr(self, name) >= 0.0:
                raise ValueError(f"rod.{name} is {getattr(self, name)}: it must not be negative")
        if len(self.gravity) != 3:
            raise ValueError(f"rod.gravity is {self.gravity}: it must have 3 components")
        if self.damping_protocol not in DAMPING_PROTOCOLS:
            raise ValueError(
                f"rod.damping_protocol is {self.damping_protocol!r}: choose one of {', '.join(DAMPING_PROTOCOLS)}"
            )
        if self.contact_model not in CONTACT_MODELS:
            raise ValueError(f"rod.contact_model is {self.contact_model!r}: choose one of {', '.join(CONTACT_MODELS)}")

    @property
    def n_nodes(self) -> int:
        """Return the number of nodes, one more than elements."""
        return self.n_elements + 1

    @property
    def contact_coefficients(self) -> ContactCoefficients:
        """Return the contact model's coefficients, SI units: per element in ``pyelastica``, per metre in ``exact``."""
        per = self.contact_length if self.contact_model == "exact" else 1.0
        return ContactCoefficients(
            stiffness=self.contact_stiffness / per,
            damping=self.contact_damping / per,
            friction=self.friction_coefficient,
            slip_damping=self.velocity_damping_coefficient / per,
        )

    @property
    def control_dt(self) -> float:
        """Return the duration of one control step in s."""
        return self.dt * self.substeps

    def times(self, factors: Mapping[str, float]) -> "RodParameters":
        """Return an arm with so many times these parameters, by name; the shear modulus goes with Young's.

        Raises:
            ValueError: if that is no rod.
        """
        values = {name: getattr(self, name) * factor for name, factor in factors.items()}
        if "youngs_modulus" in factors:
            values["shear_modulus"] = self.shear_modulus * factors["youngs_modulus"]
        return replace(self, **values)


class RodConstants(NamedTuple):
    """These are the constants of the discretised rod in float64; diagonal matrices are kept as their diagonals.

    Attributes:
        position: nodes at rest, ``(3, n_nodes)``.
        director: rows d1, d2, d3 of every element at rest, ``(3, 3, n_elements)``.
        rest_length: ``(n_elements,)``.
        rest_voronoi_length: ``(n_elements - 1,)``.
        volume: of each element, conserved, ``(n_elements,)``.
        mass: of each node, half at the ends, ``(n_nodes,)``.
        inertia: mass second moment of inertia, ``(3, n_elements)``.
        shear: shear/stretch stiffness, ``(3, n_elements)``.
        bend: bend/twist stiffness, Voronoi-averaged, ``(3, n_elements - 1)``.
        translational_decay: factor on every node's velocity per substep.
        rotational_decay_rate: the angular velocity's factor per substep is ``exp(-rate * e)`` with e the element's
            dilatation, or ``exp(-rate)`` where the protocol does not depend on it; ``(3, n_elements)``.
        decay_follows_dilatation: whether the factor above uses e.
    """

    position: Array
    director: Array
    rest_length: Array
    rest_voronoi_length: Array
    volume: Array
    mass: Array
    inertia: Array
    shear: Array
    bend: Array
    translational_decay: float
    rotational_decay_rate: Array
    decay_follows_dilatation: bool


def rod_constants(parameters: RodParameters) -> RodConstants:
    """Discretise the rod as PyElastica 1.0.0 does: along +z from the origin, d1 = +y, no rest strain."""
    n = parameters.n_elements
    position = np.zeros((3, n + 1))
    position[2] = np.linspace(0.0, parameters.base_length, n + 1)
    rest_length = np.diff(position[2])

    director = np.zeros((3, 3, n))
    director[0, 1] = 1.0  # d1 = +y
    director[1, 0] = -1.0  # d2 = d3 x d1 = -x
    director[2, 2] = 1.0  # d3 = +z

    area = np.pi * parameters.base_radius**2
    second_moment = area**2 / (4.0 * np.pi) * np.array([1.0, 1.0, 2.0])
    inertia = second_moment[:, None] * parameters.density * rest_length
    shear_correction = 27.0 / 28.0
    moduli = np.array(
        [
            shear_correction * parameters.shear_modulus,
            shear_correction * parameters.shear_modulus,
            parameters.youngs_modulus,
        ]
    )
    shear = np.repeat((moduli * area)[:, None], n, axis=1)
    bend_moduli = np.array([parameters.youngs_modulus, parameters.youngs_modulus, parameters.shear_modulus])
    bend = np.repeat((bend_moduli * second_moment)[:, None], n, axis=1)
    bend = (bend[:, 1:] * rest_length[1:] + bend[:, :-1] * rest_length[:-1]) / (rest_length[1:] + rest_length[:-1])

    volume = area * rest_length
    mass = np.zeros(n + 1)
    mass[:-1] += 0.5 * parameters.density * volume
    mass[1:] += 0.5 * parameters.density * volume

    decay = parameters.damping_constant * parameters.dt
    follows = parameters.damping_protocol == "damping_constant"
    if follows:
        element_mass = 0.5 * (mass[1:] + mass[:-1])
        element_mass[0] += 0.5 * mass[0]
        element_mass[-1] += 0.5 * mass[-1]
        rate = decay * element_mass / inertia
    else:
        rate = np.full((3, n), decay)

    return RodConstants(
        position=position,
        director=director,
        rest_length=rest_length,
        rest_voronoi_length=0.5 * (rest_length[1:] + rest_length[:-1]),
        volume=volume,
        mass=mass,
        inertia=inertia,
        shear=shear,
        bend=bend,
        translational_decay=float(np.exp(-decay)),
        rotational_decay_rate=rate,
        decay_follows_dilatation=follows,
    )
