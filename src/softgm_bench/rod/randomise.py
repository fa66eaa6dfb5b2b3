"""Domain randomisation: ranges from which an episode's body is drawn, as factors on the nominal arm's parameters."""

import re
from dataclasses import dataclass

import numpy as np

from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.stability import MARGIN, finer_step, longest_time_step

# What is drawn, in this order; all but the last are names of ``RodParameters``.
FACTORS = ("youngs_modulus", "density", "damping_constant", "friction_coefficient", "base_radius", "max_torque")
RADII = 9  # at which stability is looked at: it has a maximum somewhere in a range of radii

Range = tuple[float, float]
NOMINAL: Range = (1.0, 1.0)


@dataclass
class RandomiseConfig:
    """Ranges of factors; meanings in ``conf/randomise/none.yaml``. The defaults leave every arm the nominal one."""

    name: str = "none"
    youngs_modulus: Range = NOMINAL
    density: Range = NOMINAL
    damping_constant: Range = NOMINAL
    friction_coefficient: Range = NOMINAL
    base_radius: Range = NOMINAL
    max_torque: Range = NOMINAL

    def __post_init__(self) -> None:
        """Refuse values that describe no bodies.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        if not re.fullmatch(r"\w+", self.name):
            raise ValueError(f"randomise.name is {self.name!r}: use letters and _, it becomes a folder's name")
        for key in FACTORS:
            setattr(self, key, tuple(getattr(self, key)))
            if not all(factor > 0.0 for factor in getattr(self, key)):
                raise ValueError(f"randomise.{key} is {list(getattr(self, key))}: factors must be above 0")
        if self.name == "none" and self.drawn:
            raise ValueError(
                f"randomise.{self.drawn[0]} is {list(getattr(self, self.drawn[0]))} with randomise=none: "
                "add randomise=moderate or wide, or a randomise.name of your own"
            )

    @property
    def drawn(self) -> tuple[str, ...]:
        """Names of the factors that are ever another number than 1."""
        return tuple(key for key in FACTORS if getattr(self, key) != NOMINAL)

    @property
    def nothing(self) -> bool:
        """True if every arm is the nominal one."""
        return not self.drawn

    def check(self, parameters: RodParameters) -> None:
        """Refuse ranges in which a body could be torn apart by its first movement, or that could do nothing.

        The stiffest, lightest and least damped body is the worst one, of which radius depends on the others.

        Args:
            parameters: of the nominal arm, which is stable itself.

        Raises:
            ValueError: with one line naming the keys, their values and what would be right.
        """
        p = parameters
        if "friction_coefficient" in self.drawn and not p.friction_coefficient * p.velocity_damping_coefficient > 0.0:
            raise ValueError(
                f"randomise.friction_coefficient={_written(self.friction_coefficient)}: the nominal arm has no "
                "friction to multiply; give rod.friction_coefficient=0.3 rod.velocity_damping_coefficient=10"
            )
        if "damping_constant" in self.drawn and not p.damping_constant > 0.0:
            raise ValueError(
                f"randomise.damping_constant={_written(self.damping_constant)}: the nominal arm has no damping to "
                "multiply; give rod.damping_constant=0.3"
            )
        limit = self.stable_step(parameters)
        if p.dt <= limit or not self.drawn:
            return
        keys = (key for key in ("youngs_modulus", "density", "damping_constant", "base_radius") if key in self.drawn)
        ranges = " ".join(f"randomise.{key}={_written(getattr(self, key))}" for key in keys)
        raise ValueError(
            f"{ranges}: at the stiff, light end of these ranges the integrator is stable up to {limit:.3g} s and "
            f"rod.dt is {p.dt:g}; narrow them or give {finer_step(parameters, limit)}"
        )

    def stable_step(self, parameters: RodParameters) -> float:
        """Find the longest ``dt`` in s that all bodies of these ranges admit, to the resolution of ``RADII``."""
        worst = {
            "youngs_modulus": self.youngs_modulus[1],
            "density": self.density[0],
            "damping_constant": self.damping_constant[0],
        }
        radii = np.geomspace(*self.base_radius, RADII) if "base_radius" in self.drawn else [1.0]
        arms = (parameters.times(worst | {"base_radius": float(radius)}) for radius in radii)
        return MARGIN * min(map(longest_time_step, arms))


def _written(values: Range) -> str:
    return f"[{values[0]:g},{values[1]:g}]"
