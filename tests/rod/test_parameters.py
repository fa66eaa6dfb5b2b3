import elastica as ea
import numpy as np
import pytest
from numpy.testing import assert_allclose

from softgm_bench.rod.parameters import DAMPING_PROTOCOLS, RodParameters, rod_constants
from softgm_bench.rod.pyelastica_oracle import straight_rod

SOME_PARAMETERS = [
    RodParameters(),
    RodParameters(n_elements=2),
    RodParameters(n_elements=7, base_length=0.3, base_radius=0.01, density=900.0, youngs_modulus=1e6),
]


def diagonal(matrices):
    """(3, 3, n) matrices, which must be diagonal, to (3, n)."""
    values = np.diagonal(matrices).T
    assert_allclose(matrices, np.einsum("ij,jn->ijn", np.eye(3), values), atol=0.0)
    return values


@pytest.mark.parametrize("parameters", SOME_PARAMETERS)
def test_constants_equal_pyelastica(parameters: RodParameters):
    rod, constants = straight_rod(parameters), rod_constants(parameters)
    expected = {
        "position": rod.position_collection,
        "director": rod.director_collection,
        "rest_length": rod.rest_lengths,
        "rest_voronoi_length": rod.rest_voronoi_lengths,
        "volume": rod.volume,
        "mass": rod.mass,
        "inertia": diagonal(rod.mass_second_moment_of_inertia),
        "shear": diagonal(rod.shear_matrix),
        "bend": diagonal(rod.bend_matrix),
    }
    for name, value in expected.items():
        actual = getattr(constants, name)
        assert actual.shape == value.shape, name
        assert_allclose(actual, value, rtol=1e-13, atol=0.0, err_msg=name)


@pytest.mark.parametrize("protocol", DAMPING_PROTOCOLS)
def test_decay_equals_pyelasticas_damper(protocol: str):
    parameters = RodParameters(n_elements=5, damping_protocol=protocol, damping_constant=0.4)
    rod, constants = straight_rod(parameters), rod_constants(parameters)
    damper = ea.AnalyticalLinearDamper(_system=rod, time_step=parameters.dt, **{protocol: parameters.damping_constant})
    rod.velocity_collection[...] = 1.0
    rod.omega_collection[...] = 1.0
    rod.dilatation[...] = np.linspace(0.8, 1.4, 5)
    damper.dampen_rates(rod, 0.0)
    exponent = constants.rotational_decay_rate * (rod.dilatation if constants.decay_follows_dilatation else 1.0)
    assert_allclose(rod.velocity_collection, constants.translational_decay, rtol=1e-14)
    assert_allclose(rod.omega_collection, np.exp(-exponent), rtol=1e-13)


def test_default_damping_rates_are_those_of_the_specification():
    parameters = RodParameters()
    rate = rod_constants(parameters).rotational_decay_rate / parameters.dt
    assert_allclose(rate, np.repeat([[480.0], [480.0], [240.0]], 60, axis=1), rtol=1e-12)


def test_mass_is_that_of_the_cylinder_and_halved_at_the_ends():
    mass = rod_constants(RodParameters()).mass
    assert mass.sum() == pytest.approx(1000.0 * np.pi * 0.05**2 * 1.0, rel=1e-12)
    assert_allclose(mass[[0, -1]], 0.5 * mass[1], rtol=1e-12)


def test_control_step_of_the_default_lasts_40_milliseconds():
    assert RodParameters().control_dt == pytest.approx(0.04, rel=1e-15)


def test_nodes_outnumber_elements_by_one():
    assert RodParameters(n_elements=9).n_nodes == 10


def test_default_contact_is_pyelasticas_and_its_length_an_element_of_the_paper():
    parameters = RodParameters()
    assert parameters.contact_model == "pyelastica"
    assert_allclose(rod_constants(parameters).rest_length, parameters.contact_length, rtol=1e-12)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n_elements", 1),
        ("substeps", 0),
        ("base_length", 0.0),
        ("base_radius", -0.05),
        ("density", 0.0),
        ("youngs_modulus", float("nan")),
        ("shear_modulus", 0.0),
        ("dt", 0.0),
        ("damping_constant", -0.1),
        ("contact_stiffness", -1.0),
        ("contact_damping", float("nan")),
        ("friction_coefficient", -1.0),
        ("velocity_damping_coefficient", -1.0),
        ("contact_length", 0.0),
        ("contact_length", float("nan")),
        ("contact_model", "hertz"),
        ("gravity", (0.0, -9.81)),
        ("damping_protocol", "viscous"),
    ],
)
def test_impossible_parameter_is_refused_by_name(name: str, value: object):
    with pytest.raises(ValueError, match=rf"rod\.{name} is"):
        RodParameters(**{name: value})
