import pytest
import torch
import yaml
from omegaconf import OmegaConf
from refused import refusal

from softgm_bench import plugins
from softgm_bench.algorithms import algorithm_configs
from softgm_bench.assembly import build_env
from softgm_bench.config import changed, compose, compose_untyped, config_directory, plain, typed
from softgm_bench.errors import UserError
from softgm_bench.rod.numba_backend import NumbaBackend
from softgm_bench.rod.parameters import RodParameters


def test_what_the_command_line_says_comes_after_the_recipe_and_the_recipe_after_the_experiment():
    overrides = ["algo=masac", "experiment=quick", "recipe=tuned"]
    assert (
        compose(overrides).experiment.steps_per_batch
        == compose(["algo=masac", "recipe=tuned"]).experiment.steps_per_batch
    )
    assert compose([*overrides, "experiment.steps_per_batch=7", "algo.gamma=0.9"]).experiment.steps_per_batch == 7
    assert compose([*overrides, "algo.gamma=0.9"]).algo.gamma == 0.9


def test_a_linear_schedule_lasts_as_long_as_the_run_unless_told_otherwise():
    assert compose(["experiment.total_frames=777"]).algo.lr_schedule_frames == 777
    assert compose(["algo.lr_schedule_frames=5"]).algo.lr_schedule_frames == 5
    refused = "algo.lr_schedule_frames is 0: it must be at least 1"
    assert refusal("algo.lr_schedule=linear", "algo.lr_schedule_frames=0") == refused


def test_the_arm_is_its_dataclass_unless_told_otherwise():
    assert compose([]).rod == RodParameters()
    assert compose(["rod.gravity=[0,0,-9.81]"]).rod == RodParameters(gravity=(0.0, 0.0, -9.81))
    hash(compose([]).rod)


def test_a_model_can_be_chosen_against_the_algorithms_own():
    assert type(compose([]).model).__name__ == "SoftGMConfig"
    assert type(compose(["model=mlp"]).model).__name__ == "MLPConfig"


@pytest.mark.parametrize("algo", algorithm_configs())
def test_plain_values_give_the_same_configuration_back(algo):
    config = compose(["task=wall_narrow", f"algo={algo}"])

    assert typed(OmegaConf.create(yaml.safe_load(yaml.safe_dump(plain_lists(plain(config)))))) == config


def plain_lists(value):
    if isinstance(value, dict):
        return {key: plain_lists(item) for key, item in value.items()}
    return [plain_lists(item) for item in value] if isinstance(value, tuple) else value


def test_the_backend_is_the_devices_fused_kernel_unless_one_is_named_and_the_precision_is_the_rods():
    config = compose(["dtype=float32"])
    assert config.backend is None
    env = build_env(config, 1, 0)
    assert isinstance(env.backend, NumbaBackend)
    assert env.simulation_state()["episodes", "rod", "position"].dtype == torch.float32
    assert env.reset()["tip"].dtype == torch.float32
    usual = build_env(compose([]), 1, 0).simulation_state()
    assert usual["episodes", "rod", "position"].dtype == torch.float64


def test_the_configuration_directory_is_the_repositorys():
    assert (config_directory() / "config.yaml").is_file()
    assert isinstance(compose_untyped([]).seed, int)


def recipe_file(folder, text):
    """A folder of plugins with the recipe ``mine``."""
    (folder / "conf/recipe").mkdir(parents=True)
    (folder / "conf/recipe/mine.yaml").write_text(f"# @package _global_\n{text}")
    return str(folder)


def test_a_recipe_of_ones_own_builds_on_another_and_comes_after_everything_but_the_command_line(tmp_path, monkeypatch):
    text = """
defaults: [paper, _self_]
algo: {gamma: 0.5, epochs: 2}
task: {horizon: 7}
model: {residual: true}
experiment: {num_envs: 3}
perturbation: {tip_force: 1.0, steps: 1, name: mine}
dtype: float32
"""
    monkeypatch.setenv(plugins.VARIABLE, recipe_file(tmp_path, text))

    config = compose(["recipe=mine", "experiment=quick", "algo.epochs=4"])

    assert (config.recipe, config.algo.gamma, config.algo.epochs, config.algo.actor_lr) == ("paper", 0.5, 4, 1e-4)
    assert (config.task.horizon, config.model.residual, config.experiment.num_envs) == (7, True, 3)
    assert (config.perturbation.tip_force, config.dtype) == (1.0, "float32")


def test_a_recipe_has_the_values_of_one_of_the_two_whatever_its_file_is_called(tmp_path, monkeypatch):
    monkeypatch.setenv(plugins.VARIABLE, recipe_file(tmp_path, "recipe: mine\n"))

    with pytest.raises(
        UserError, match=r"^recipe: mine: the key is tuned or paper, whatever the recipe's file is called$"
    ):
        compose(["recipe=mine"])


def test_a_part_of_a_policys_settings_is_replaced_by_what_the_runs_recipe_has():
    for recipe, enabled in (("tuned", True), ("paper", False)):
        run = plain(compose([f"recipe={recipe}"]))
        assert changed(run, ["task=wall"]).task.curriculum.enabled is enabled
    assert changed(run | {"recipe": ""}, ["task=wall", "task.slots=7"]).task.slots == 7


@pytest.mark.parametrize("limit", ["null", "3", "80"])
def test_a_policy_plays_by_any_limit_of_contact_whatever_its_curriculum_had(limit):
    eased = ("task.max_contact_steps=0", "task.curriculum.easy_contact_steps=50", "task.curriculum.contact_stages=2")
    run = plain(compose(["task=wall", *eased]))
    found = changed(run, [f"task.max_contact_steps={limit}"]).task.max_contact_steps
    assert found == (None if limit == "null" else int(limit))
    assert changed(run, ["task.slots=7"]).task.curriculum.easy_contact_steps == 50
