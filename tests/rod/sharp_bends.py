"""A state beyond the range of every kernel's polynomials, for the fused kernels' tests."""

import torch

from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import RodState, straight_rods


def beyond_polynomials() -> tuple[RodParameters, RodState]:
    """Neighbouring directors 70 degrees apart, a turn of 1.8 rad a substep and a stretch of 3 at once."""
    parameters = RodParameters(n_elements=6, youngs_modulus=1e3, shear_modulus=4e2, damping_constant=3.0)
    state = straight_rods(parameters, 1)
    angle = torch.arange(6, dtype=torch.float64) * 1.2
    zero, one = torch.zeros_like(angle), torch.ones_like(angle)
    rotation = torch.stack(
        [
            torch.stack([one, zero, zero]),
            torch.stack([zero, angle.cos(), angle.sin()]),
            torch.stack([zero, -angle.sin(), angle.cos()]),
        ]
    )
    state.director = torch.einsum("ijn,bjkn->bikn", rotation, state.director)
    state.position *= torch.linspace(1.0, 3.5, 7)
    state.omega[:, 0] = torch.linspace(0.0, 4500.0, 6)
    return parameters, state
