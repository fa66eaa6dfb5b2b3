"""Actuation turns N control-point amplitudes into a distributed couple along the rod (Naughton et al. 2021)."""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_interp_spline
from torch import Tensor

from softgm_bench.rod.parameters import RodParameters, rod_constants

BASES = ("interpolating", "bspline")
SCALINGS = ("per_length", "per_element")
DIRECTIONS = 2  # of a section's couple: normal (d1) and binormal (d2), d_a in the paper


def control_points(n_agents: int, base_length: float) -> NDArray[np.float64]:
    """Return the arc lengths ``i L / (N + 1)`` of the N control points in m, ``(n_agents,)``."""
    return base_length * np.arange(1, n_agents + 1) / (n_agents + 1)


def torque_basis(n_agents: int, arc_length: NDArray[np.float64], base_length: float, basis: str) -> NDArray[np.float64]:
    """Evaluate the basis function ``b_i(s)`` of every agent, ``(n_agents, len(arc_length))``, without a unit.

    ``interpolating``: the cardinal cubic spline (not-a-knot) that is 1 at control point i and 0 at the other ones and
    at both ends. ``bspline``: the interior functions of a clamped uniform cubic B-spline basis, 0 at both ends.
    With fewer than two agents the degree falls with the number of points.

    Raises:
        ValueError: for an unknown basis or fewer than one agent.
    """
    if n_agents < 1:
        raise ValueError(f"task.n_agents is {n_agents}: at least 1 agent is needed")
    degree = min(3, n_agents + 1)
    coefficients = np.eye(n_agents + 2)[:, 1:-1]  # both ends are held at zero
    if basis == "interpolating":
        points = np.concatenate([[0.0], control_points(n_agents, base_length), [base_length]])
        spline = make_interp_spline(points, coefficients, k=degree)
    elif basis == "bspline":
        interior = np.linspace(0.0, base_length, n_agents + 3 - degree)
        knots = np.concatenate([np.zeros(degree), interior, np.full(degree, base_length)])
        spline = BSpline(knots, coefficients, degree)
    else:
        raise ValueError(f"task.actuation.basis is {basis!r}: choose one of {', '.join(BASES)}")
    return np.ascontiguousarray(spline(arc_length).T)


class Actuation:
    """This linear map takes actions to the external couple on every element in the material frame."""

    def __init__(
        self,
        parameters: RodParameters,
        n_agents: int,
        max_torque: float,
        basis: str = "interpolating",
        scaling: str = "per_length",
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float64,
    ) -> None:
        """Evaluate the basis once, at the elements' rest centres; couples are of type ``dtype``.

        ``per_length`` reads the torque field as couple per unit length, so that an element receives ``tau(s_k) ds``;
        ``per_element`` gives each element ``tau(s_k)`` itself, which tears the paper's arm apart: comparison only.

        Raises:
            ValueError: for an unknown basis or scaling, or fewer than one agent.
        """
        if scaling not in SCALINGS:
            raise ValueError(f"task.actuation.scaling is {scaling!r}: choose one of {', '.join(SCALINGS)}")
        constants = rod_constants(parameters)
        ends = np.concatenate([[0.0], np.cumsum(constants.rest_length)])
        basis_values = torque_basis(n_agents, 0.5 * (ends[1:] + ends[:-1]), parameters.base_length, basis)
        weight = constants.rest_length if scaling == "per_length" else np.ones(parameters.n_elements)
        self.matrix = torch.as_tensor(max_torque * basis_values * weight, dtype=dtype, device=device)

    def couple(self, action: Tensor) -> Tensor:
        """Return the couple on each element in N m for actions ``(num_envs, n_agents, 2)`` (normal, binormal).

        Returns:
            ``(num_envs, 3, n_elements)`` in directors' components; the tangential row is zero.
        """
        # No matrix product: its rounding may depend on the batch, and an environment would see its neighbours.
        amplitude = action.to(self.matrix.dtype).transpose(-1, -2).unsqueeze(-1)
        bending = (amplitude * self.matrix).sum(dim=-2)
        return torch.cat([bending, torch.zeros_like(bending[..., :1, :])], dim=-2)
