"""Settings of earlier versions are still read."""

from pathlib import Path

import pytest
from omegaconf import OmegaConf

from softgm_bench.config import compose, plain, typed
from softgm_bench.config.upgrade import NEUTRAL, upgraded
from softgm_bench.episodes import policy
from softgm_bench.rod.randomise import RandomiseConfig

EXPERIMENTS = Path(__file__).parents[2] / "experiments"
RUNS = sorted(EXPERIMENTS.rglob("config.yaml"))
POLICIES = sorted((EXPERIMENTS / "policies").glob("*.pt"))


def relative(path):
    return str(path.relative_to(EXPERIMENTS))


def assert_holds(values, written):
    """Every value that was written down has stayed."""
    for key, value in written.items():
        if isinstance(value, dict):
            assert_holds(values[key], value)
        else:
            assert (list(values[key]) if isinstance(values[key], tuple) else values[key]) == value, key


@pytest.mark.parametrize("path", RUNS, ids=relative)
def test_the_settings_of_every_committed_run_are_read_and_none_is_changed(path):
    written = OmegaConf.load(path)
    config = typed(written)
    assert_holds(plain(config), upgraded(OmegaConf.to_container(written)))
    # A run from before these had names has none.
    assert (config.recipe, config.experiment.name) == (written.get("recipe", ""), written.experiment.get("name", ""))
    assert config.task.name in path.parts
    assert typed(OmegaConf.create(plain(config))) == config


@pytest.mark.parametrize("path", sorted((EXPERIMENTS / "trained").rglob("config.yaml")), ids=relative)
def test_the_label_of_every_published_run_is_the_name_of_its_folder(path):
    assert typed(OmegaConf.load(path)).label == path.parent.parent.name


@pytest.mark.parametrize("path", POLICIES, ids=relative)
def test_every_committed_policy_is_loaded(path):
    assert path.stem == f"{policy.load(path).config.task.name}_{policy.load(path).label}"


def before(*overrides):
    """Settings as they were written before recipes and experiments had names."""
    values = OmegaConf.create(plain(compose(list(overrides))))
    for key in NEUTRAL:
        group, _, name = key.rpartition(".")
        (OmegaConf.select(values, group) if group else values).pop(name, None)  # not every task has all of them
    return OmegaConf.to_container(values)


def test_keys_that_there_were_not_have_values_that_change_nothing():
    config = typed(OmegaConf.create(before("task=wall")))
    assert (config.recipe, config.experiment.name, config.resume) == ("", "", False)
    assert (config.task.train_horizon, config.task.hidden_scene) == (None, False)
    assert config.experiment.train_horizon == 60
    assert config.task.curriculum.enabled is config.algo.critic.asymmetric is True
    assert config.algo.actor.embedding_norm is config.algo.critic.embedding_norm is False


@pytest.mark.parametrize("name", ["softgm_no_stage1", "softgm_no_stage2"])
def test_an_ablation_that_was_an_algorithm_is_a_model_with_the_same_label(name):
    today = compose(["recipe=paper", "task=wall", f"model={name}"])
    values = before("recipe=paper", "task=wall", f"model={name}")
    values["algo"]["name"], values["model"]["name"] = name, "softgm"

    config = typed(OmegaConf.create(values))

    assert (config.algo, config.model, config.label) == (today.algo, today.model, name)
    assert config.run_dir == today.run_dir == f"outputs/wall/{name}/seed0"


def test_settings_of_today_are_left_as_they_are():
    values = plain(compose([]))
    assert upgraded(values) == values
    assert upgraded({}) == {}


def test_runs_from_before_bodies_were_drawn_had_the_nominal_one():
    values = before()
    del values["randomise"]
    assert typed(OmegaConf.create(values)).randomise == RandomiseConfig()


def test_runs_from_before_there_were_perturbations_had_none():
    values = plain(compose([]))
    del values["perturbation"]
    assert typed(OmegaConf.create(values)) == compose([])


@pytest.mark.parametrize(("written", "today"), [(False, None), (True, "average"), ("canonical", "canonical")])
def test_a_mirror_that_was_on_or_off_is_an_average_or_none(written, today):
    values = plain(compose(["algo=mappo", "task=wall"]))
    values["algo"]["actor"]["mirror"] = written
    assert typed(OmegaConf.create(values)).algo.actor.mirror == today
