"""The bodies of a batch: arms that differ from one nominal arm by factors on its parameters.

Every discretised constant is a product of powers of the parameters, so a body's constants are the nominal ones times a
few numbers (``Scales``), which every backend applies in its own way.
"""

from functools import lru_cache
from typing import NamedTuple

import torch
from torch import Tensor

from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.randomise import FACTORS, RandomiseConfig


class Bodies(NamedTuple):
    """The factors of a batch's arms, one tensor ``(num_envs,)`` each; the fields are names of ``RodParameters``.

    The shear modulus goes with Young's, so that their ratio stays the material's.
    """

    youngs_modulus: Tensor
    density: Tensor
    damping_constant: Tensor
    friction_coefficient: Tensor
    base_radius: Tensor

    def of(self, rows: Tensor) -> "Bodies":
        """Select environments."""
        return Bodies(*(factor[rows] for factor in self))

    def arm(self, parameters: RodParameters, row: int) -> RodParameters:
        """Give one environment's arm by itself."""
        return parameters.times({name: float(factor[row]) for name, factor in self._asdict().items()})


class Scales(NamedTuple):
    """What a body's constants are, in units of the nominal arm's; one tensor each. In this order kernels read them.

    ``rotational`` is on the exponent of the angular velocity's decay, ``translational`` on that of the velocity's.
    """

    shear: Tensor  # stiffness of cross-sections: E r^2
    bend: Tensor  # E r^4
    mass: Tensor  # rho r^2
    inertia: Tensor  # rho r^4
    volume: Tensor  # r^2
    translational: Tensor
    rotational: Tensor
    friction: Tensor


def scales(bodies: Bodies, parameters: RodParameters) -> Scales:
    """Derive the scales ``(num_envs,)`` from the factors, differentiably."""
    area = bodies.base_radius * bodies.base_radius
    mass, shear = bodies.density * area, bodies.youngs_modulus * area
    damping = bodies.damping_constant
    return Scales(
        shear=shear,
        bend=shear * area,
        mass=mass,
        inertia=mass * area,
        volume=area,
        translational=damping,
        # the damper's rate is that of the mass over that of the inertia, in the protocol that knows them
        rotational=damping / area if parameters.damping_protocol == "damping_constant" else damping,
        friction=bodies.friction_coefficient,
    )


def draw(config: RandomiseConfig, count: int, generator: torch.Generator) -> Tensor:
    """Draw the factors of ``count`` bodies, ``(count, 6)`` float64 in the order of ``FACTORS``.

    Each is independent of the others and log-uniform in its range: f is as likely as 1 / f. They are float32 numbers,
    so that a record in float32 tells a body exactly. The same state of the generator gives the same ranks within
    whatever ranges.
    """
    low, high = _logarithms(tuple(getattr(config, name) for name in FACTORS), generator.device)
    rank = torch.rand((count, len(FACTORS)), generator=generator, device=generator.device, dtype=torch.float64)
    return (low + (high - low) * rank).exp().to(torch.float32).to(torch.float64)


@lru_cache
def _logarithms(ranges: tuple[tuple[float, float], ...], device: torch.device) -> tuple[Tensor, Tensor]:
    """Both ends of the ranges, ``(6,)`` each; copied to the device once."""
    low, high = torch.tensor(ranges, dtype=torch.float64).log().unbind(-1)
    return low.to(device), high.to(device)
