from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies
from scipy.interpolate import CubicSpline

from softgm_bench.rod.actuation import Actuation, control_points, torque_basis
from softgm_bench.rod.parameters import RodParameters

ARM = RodParameters()
CENTRES = (np.arange(60) + 0.5) / 60


@settings(deadline=None, max_examples=30)
@given(n_agents=strategies.integers(1, 12), length=strategies.floats(0.1, 5.0))
def test_each_interpolating_function_is_one_at_its_own_control_point_and_zero_at_the_others_and_the_ends(
    n_agents, length
):
    at_points = torque_basis(n_agents, control_points(n_agents, length), length, "interpolating")
    at_ends = torque_basis(n_agents, np.array([0.0, length]), length, "interpolating")
    assert np.allclose(at_points, np.eye(n_agents), atol=1e-9)
    assert np.allclose(at_ends, 0.0, atol=1e-9)


@pytest.mark.parametrize("n_agents", [2, 4, 6, 9])
def test_the_interpolating_basis_is_scipys_not_a_knot_cubic_spline(n_agents):
    amplitude = np.random.default_rng(0).normal(size=n_agents)
    points = np.linspace(0.0, 1.0, n_agents + 2)
    spline = CubicSpline(points, np.concatenate([[0.0], amplitude, [0.0]]), bc_type="not-a-knot")
    assert np.allclose(amplitude @ torque_basis(n_agents, CENTRES, 1.0, "interpolating"), spline(CENTRES), atol=1e-12)


@pytest.mark.parametrize("n_agents", [1, 2, 6])
def test_bsplines_are_positive_local_and_at_most_a_partition_of_unity(n_agents):
    basis = torque_basis(n_agents, np.linspace(0.0, 1.0, 101), 1.0, "bspline")
    assert (basis >= -1e-12).all()
    assert (basis.sum(axis=0) <= 1.0 + 1e-12).all()
    assert np.allclose(basis[:, [0, -1]], 0.0)


def test_an_element_receives_the_couple_per_length_times_its_length():
    actuation = Actuation(ARM, 6, 25.0)
    action = torch.zeros(1, 6, 2, dtype=torch.float64)
    action[0, 2, 1] = 0.5
    couple = actuation.couple(action)
    expected = 25.0 * 0.5 * torque_basis(6, CENTRES, 1.0, "interpolating")[2] / 60
    assert np.allclose(couple[0, 1], expected)
    assert (couple[0, [0, 2]] == 0.0).all()
    per_element = Actuation(ARM, 6, 25.0, scaling="per_element").couple(action)
    assert np.allclose(per_element, couple * 60)


def largest(basis):
    """The largest torque along the arm for amplitudes in [-1, 1]: the maximum of the sum of absolute values."""
    return float(np.abs(torque_basis(6, np.linspace(0.0, 1.0, 100_001), 1.0, basis)).sum(axis=0).max())


def test_between_control_points_the_interpolating_basis_exceeds_the_limit_as_the_page_says():
    assert largest("interpolating") == pytest.approx(1.67, abs=0.005)
    assert largest("bspline") <= 1.0 + 1e-12
    page = (Path(__file__).parents[2] / "docs/environment.md").read_text()
    assert f"{largest('interpolating'):.2f}" in page


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"basis": "linear"}, r"task\.actuation\.basis is 'linear'"),
        ({"scaling": "total"}, r"task\.actuation\.scaling is 'total'"),
        ({"n_agents": 0}, r"task\.n_agents is 0"),
    ],
)
def test_settings_that_mean_nothing_are_refused_in_one_line(arguments, message):
    with pytest.raises(ValueError, match=message):
        Actuation(ARM, **{"n_agents": 6, "max_torque": 25.0} | arguments)


def test_couple_of_an_environment_has_the_same_bits_in_any_batch():
    actuation = Actuation(RodParameters(), 6, max_torque=25.0)
    action = torch.rand(300, 6, 2, generator=torch.Generator().manual_seed(0)) * 2.0 - 1.0
    together = actuation.couple(action)
    for size in (1, 7, 64):
        assert torch.equal(actuation.couple(action[:size]), together[:size])
