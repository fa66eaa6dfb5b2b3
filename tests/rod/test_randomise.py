"""What is drawn never breaks the integrator: a range that could is refused at the start, in one line."""

from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from softgm_bench.rod.actuation import Actuation
from softgm_bench.rod.bodies import Bodies, draw
from softgm_bench.rod.divergence import diverged
from softgm_bench.rod.parameters import DAMPING_PROTOCOLS, RodParameters, rod_constants
from softgm_bench.rod.randomise import FACTORS, RandomiseConfig
from softgm_bench.rod.stability import MARGIN, check_time_step, longest_time_step
from softgm_bench.rod.state import straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

pytestmark = pytest.mark.usefixtures("one_thread")

ARM = RodParameters()
FRICTION = replace(ARM, friction_coefficient=0.3, velocity_damping_coefficient=10.0)

factor = st.floats(0.3, 3.0)
radius = st.floats(0.5, 2.0)
interval = st.tuples(factor, factor).map(lambda ends: tuple(sorted(ends)))
radii = st.tuples(radius, radius).map(lambda ends: tuple(sorted(ends)))


@settings(max_examples=15, deadline=None)
@given(
    stiff=interval,
    dense=interval,
    damped=interval,
    thick=radii,
    protocol=st.sampled_from(DAMPING_PROTOCOLS),
    seed=st.integers(0, 2**32),
)
def test_every_body_of_an_admitted_range_may_have_the_time_step(stiff, dense, damped, thick, protocol, seed):
    config = RandomiseConfig("x", youngs_modulus=stiff, density=dense, damping_constant=damped, base_radius=thick)
    arm = replace(ARM, n_elements=20, damping_protocol=protocol)
    arm = replace(arm, dt=config.stable_step(arm))
    config.check(arm)
    drawn = draw(config, 4, torch.Generator().manual_seed(seed))
    for row in range(4):
        body = Bodies(*drawn[:, : len(Bodies._fields)].unbind(-1)).arm(arm, row)
        check_time_step(replace(body, dt=0.99 * arm.dt))  # radii between those looked at, and the limit's resolution


def torn(config: RandomiseConfig, arm: RodParameters) -> bool:
    """Whether torques of random signs tear any of 16 of the range's stiff, light bodies apart."""
    drawn = draw(config, 16, torch.Generator().manual_seed(0))
    drawn[:, 0], drawn[:, 1] = config.youngs_modulus[1], config.density[0]
    rod, state = TorchBackend(arm), straight_rods(arm, 16)
    actuation, generator = Actuation(arm, 6, 25.0), torch.Generator().manual_seed(0)
    for _ in range(3):
        couple = actuation.couple(2.0 * torch.rand(16, 6, 2, generator=generator) - 1.0) * config.youngs_modulus[1]
        state = rod.control_step(state, couple, bodies=Bodies(*drawn[:, : len(Bodies._fields)].unbind(-1)))
    return bool(diverged(state, torch.as_tensor(rod_constants(arm).rest_length), 0.2, 5.0).any())


@pytest.mark.parametrize("stiffest", [2.0, 5.0])
def test_what_is_admitted_holds_and_what_tears_apart_is_refused(stiffest):
    arm = replace(ARM, n_elements=20, dt=1.2e-3, substeps=33)
    config = RandomiseConfig("x", youngs_modulus=(0.5, stiffest), density=(0.9, 1.1))
    if stiffest == 2.0:
        config.check(arm)
        assert not torn(config, arm)
    else:
        assert torn(config, arm)
        with pytest.raises(ValueError, match="at the stiff, light end"):
            config.check(arm)


def test_the_refusal_names_what_would_do():
    config = RandomiseConfig("x", youngs_modulus=(0.5, 4.0), density=(0.5, 1.0), max_torque=(0.5, 2.0))
    with pytest.raises(ValueError, match="stable") as refused:
        config.check(ARM)
    says = str(refused.value)
    assert says.startswith(
        "randomise.youngs_modulus=[0.5,4] randomise.density=[0.5,1]: at the stiff, light end of these"
    )
    assert "max_torque" not in says
    assert "\n" not in says
    given = dict(setting.removeprefix("rod.").split("=") for setting in says.split("give ")[1].split())
    finer = replace(ARM, dt=float(given["dt"]), substeps=int(given["substeps"]))
    assert finer.control_dt == pytest.approx(ARM.control_dt, rel=1e-5)
    config.check(finer)


def test_the_limit_is_that_of_the_stiffest_and_lightest_body():
    config = RandomiseConfig("x", youngs_modulus=(0.5, 2.0), density=(0.8, 1.25))
    limit = MARGIN * longest_time_step(ARM.times({"youngs_modulus": 2.0, "density": 0.8}))
    config.check(replace(ARM, dt=0.999 * limit))
    with pytest.raises(ValueError, match="stable"):
        config.check(replace(ARM, dt=1.001 * limit))


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"name": "x", "density": (0.0, 1.0)}, r"density is \[0.0, 1.0\]: factors must be above 0"),
        ({"name": "x", "base_radius": (-1.0, 1.0)}, r"base_radius is \[-1.0, 1.0\]: factors must be above 0"),
        ({"max_torque": (0.5, 1.0)}, r"max_torque is \[0.5, 1.0\] with randomise=none: add randomise=moderate or wide"),
        ({"name": "../x"}, "name is '../x': use letters and _, it becomes a folder's name"),
    ],
)
def test_values_that_make_no_sense_are_refused_in_one_line(values, says):
    with pytest.raises(ValueError, match=rf"^randomise\.{says}[^\n]*$"):
        RandomiseConfig(**values)


@pytest.mark.parametrize(
    ("key", "arm", "nothing"),
    [
        ("friction_coefficient", ARM, "friction"),
        ("friction_coefficient", replace(ARM, friction_coefficient=0.3), "friction"),
        ("damping_constant", replace(ARM, damping_constant=0.0), "damping"),
    ],
)
def test_factors_on_nothing_are_refused(key, arm, nothing):
    with pytest.raises(ValueError, match=rf"^randomise.{key}=\[0.5,2\]: the nominal arm has no {nothing} to multiply"):
        RandomiseConfig("x", **{key: (0.5, 2.0)}).check(arm)


def test_what_there_is_can_be_multiplied():
    RandomiseConfig("x", friction_coefficient=(0.5, 2.0), damping_constant=(0.5, 2.0)).check(FRICTION)


def test_names_of_the_drawn_factors_and_nothing_by_default():
    assert RandomiseConfig().nothing
    assert RandomiseConfig("x", density=(0.9, 1.1), max_torque=(1.2, 1.2)).drawn == ("density", "max_torque")
    assert tuple(key for key in vars(RandomiseConfig()) if key != "name") == FACTORS
    assert (*Bodies._fields, "max_torque") == FACTORS
