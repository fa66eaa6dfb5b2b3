import re
from pathlib import Path

import numpy as np
import pytest
import torch
from analytical import relax, stiffness
from hypothesis import given, settings, strategies
from scipy.interpolate import CubicSpline

from softgm_bench.rod.actuation import BASES, Actuation, control_points, torque_basis
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


def largest(basis, n_agents=6):
    """The largest torque along the arm for amplitudes in [-1, 1]: the maximum of the sum of absolute values."""
    return float(np.abs(torque_basis(n_agents, np.linspace(0.0, 1.0, 100_001), 1.0, basis)).sum(axis=0).max())


def test_between_control_points_the_interpolating_basis_exceeds_the_limit_as_the_page_says():
    assert largest("interpolating") == pytest.approx(1.67, abs=0.005)
    assert largest("bspline") <= 1.0 + 1e-12
    assert f"{largest('interpolating'):.2f}" in page()


def page():
    return (Path(__file__).parents[2] / "docs/environment.md").read_text()


def end_weight(n_agents):
    """Of the integral of the not-a-knot spline through N + 2 points, one apart: what a value of 1 at an end adds."""
    value = np.zeros(n_agents + 2)
    value[0] = 1.0
    return float(CubicSpline(np.arange(n_agents + 2), value, bc_type="not-a-knot").integrate(0, n_agents + 1))


@pytest.mark.parametrize("length", [1.0, 0.7])
@pytest.mark.parametrize("n_agents", [2, 4, 5, 6, 7, 8, 9, 12])
def test_the_couple_of_the_whole_arm_at_one_action_is_the_pages_formula(n_agents, length):
    arm = RodParameters(base_length=length, n_elements=2000, dt=1e-5)
    action = torch.full((1, n_agents, 2), 0.4, dtype=torch.float64)
    total = {basis: Actuation(arm, n_agents, 25.0, basis).couple(action)[0].sum(dim=-1) for basis in BASES}
    share = 1.0 - 2.0 * end_weight(n_agents) / (n_agents + 1)
    assert total["interpolating"].tolist() == pytest.approx([0.4 * 25.0 * length * share] * 2 + [0.0], rel=1e-5)
    if n_agents > 2:
        share = 1.0 - 0.5 / (n_agents - 1)
        assert total["bspline"].tolist() == pytest.approx([0.4 * 25.0 * length * share] * 2 + [0.0], rel=1e-5)


def test_the_page_has_the_weights_couples_and_peaks_of_every_number_of_sections():
    rows = dict(re.findall(r"^\| `(w_N|C_N|peak)`[^|]* \| (.*) \|$", page(), re.MULTILINE))
    counts = [int(n) for n in re.findall(r"^\| N \| (.*) \|$", page(), re.MULTILINE)[0].split(" | ")]
    assert {4, 6, 9, 12} <= set(counts)
    expected = {
        "w_N": [f"{end_weight(n):.4f}" for n in counts],
        "C_N": [f"{1.0 - 2.0 * end_weight(n) / (n + 1):.3f}" for n in counts],
        "peak": [f"{largest('interpolating', n):.2f}" for n in counts],
    }
    assert {name: row.split(" | ") for name, row in rows.items()} == expected


@pytest.mark.parametrize("n_agents", [4, 6, 9])
def test_the_arm_at_rest_under_one_action_has_turned_by_the_pages_angle(n_agents):
    """Couples alone shear nothing, so this holds for any angle; of n elements the clamp holds the first one."""
    arm = RodParameters(damping_protocol="uniform_damping_constant", damping_constant=4.0)
    action = torch.tensor([0.0, 0.15], dtype=torch.float64).expand(1, n_agents, 2)
    state = relax(arm, Actuation(arm, n_agents, 25.0).couple(action))
    tangent = state.director[0, 2, :, -1]
    turned = float(torch.atan2(tangent[:2].norm(), tangent[2]))
    total = 0.15 * 25.0 * (1.0 - 2.0 * end_weight(n_agents) / (n_agents + 1))
    expected = total * arm.base_length / (2.0 * stiffness(arm).bend) * (1.0 - 1.0 / arm.n_elements)
    assert turned == pytest.approx(expected, rel=1e-3)
    assert turned > 0.6


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
