"""Settings that are no numbers, or describe no physics, are one line before anything is written."""

import pytest
from refused import refusal

from softgm_bench import command
from softgm_bench.assembly import configure
from softgm_bench.config import compose
from softgm_bench.errors import UserError
from softgm_bench.evaluate import Options
from softgm_bench.rod.parameters import RodParameters


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("task.reward.lambda_p=nan", "task.reward.lambda_p=nan"),
        ("task.reward.epsilon=-inf", "task.reward.epsilon=-inf"),
        ("rod.gravity=[0,0,nan]", "rod.gravity=nan"),
        ("rod.dt=inf", "rod.dt=inf"),
        ("rod.youngs_modulus=inf", "rod.youngs_modulus=inf"),
        ("algo.actor_lr=nan", "algo.actor_lr=nan"),
        ("algo.target_kl=inf", "algo.target_kl=inf"),
        ("model.velocity_scale=inf", "model.velocity_scale=inf"),
        ("experiment.minutes=nan", "experiment.minutes=nan"),
        ("task.target_distance=[0.5,inf]", "task.target_distance=inf"),
        ("task.actuation.max_torque=1e400", "task.actuation.max_torque=inf"),
    ],
)
def test_numbers_are_finite_wherever_numbers_are(override, says):
    assert refusal(override) == f"{says}: it must be a finite number"


@pytest.mark.parametrize(
    ("overrides", "key"),
    [
        (("model.layers=5000",), "model.layers"),
        (("algo=mappo", "model.layers=5000"), "model.layers"),
        (("algo.critic.mlp={hidden:8,layers:5000,velocity_scale:1.0}",), "algo.critic.mlp.layers"),
        (("model=informarl", "model.embedding_layers=5000"), "model.embedding_layers"),
    ],
)
def test_networks_that_would_never_be_built_are_refused(overrides, key):
    assert refusal(*overrides) == f"{key}=5000: it must be at most 1000"


def test_what_has_no_limit_may_be_infinite_and_is_still_a_number():
    assert compose(["task=wall_fixed"]).task.max_path == float("inf")
    assert refusal("task=wall", "task.max_path=nan") == "task.max_path=nan: it must be a finite number"


@pytest.mark.parametrize("name", ["dt", "density", "gravity", "friction_coefficient"])
def test_a_rod_that_is_built_by_hand_has_finite_numbers_too(name):
    value = (0.0, float("nan"), 0.0) if name == "gravity" else float("inf")
    with pytest.raises(ValueError, match=rf"^rod\.{name} is .*: it must be finite$"):
        RodParameters(**{name: value})


def test_the_other_commands_refuse_them_too():
    with pytest.raises(UserError, match=r"^gamma=nan: it must be a finite number$"):
        command.parse(["policy.pt", "gamma=nan"], Options, "policy")


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (
            ("task.target_distance=[0.9,0.5]",),
            "task.target_distance=[0.9, 0.5]: the lower end of a range comes first",
        ),
        (("task.target_distance=[0.9]",), "task.target_distance=[0.9]: it must be a range, [low, high]"),
        (("task=wall", "task.opening_y=[0.2,-0.2]"), "task.opening_y=[0.2, -0.2]: the lower end"),
        (("task=structured", "task.curriculum.easy_target_x=[1,0]"), "task.curriculum.easy_target_x=[1.0, 0.0]: the l"),
    ],
)
def test_ranges_go_upwards(overrides, says):
    assert refusal(*overrides).startswith(says)


@pytest.mark.parametrize(
    "override",
    ["rod.dt=1e-3", "rod.n_elements=120", "rod.youngs_modulus=5e6", "rod.density=100"],
)
def test_a_time_step_beyond_the_integrators_limit_is_refused_with_one_that_would_do(override):
    line = refusal(override)
    assert "the integrator is stable up to" in line
    advised = line.partition("give ")[2].split()
    configure([override.replace("rod.dt=1e-3", "seed=0"), *advised])


def test_a_shorter_arm_has_shorter_elements():
    assert "the integrator is stable up to" in refusal("rod.base_length=0.5")


def test_what_the_arm_cannot_reach_is_refused_with_what_would_do():
    assert refusal("task.target_distance=[1.5,1.9]").startswith(
        "rod.base_length=1.0 with task.target_distance=[1.5, 1.9]: targets lie up to 1.90 m from the base, "
        "the arm reaches 1.05 m; bring them nearer or give rod.base_length=1.9"
    )
    fine = ("rod.dt=2e-4", "rod.substeps=200")
    assert "the arm reaches 0.65 m" in refusal("rod.base_length=0.6", *fine)
    assert "target_x" in refusal("task=wall", "rod.base_length=0.6", *fine)
    assert refusal("task=wall", "rod.base_length=0.85").startswith("task.max_path=0.92 with rod.base_length=0.85: ")
    assert "1.9" in refusal("task.curriculum.enabled=true", "task.curriculum.easy_target_distance=[1.5,1.9]")


def test_where_the_tip_rests_follows_the_arms_length():
    assert configure(["rod.base_length=1.2"]).task.resting_tip == (0.0, 0.0, 1.2)
    assert configure([]).task.resting_tip == (0.0, 0.0, 1.0)
    assert refusal("rod.base_length=1.2", "task.resting_tip=[0,0,1]").endswith("the arm's tip rests at [0.0, 0.0, 1.2]")
