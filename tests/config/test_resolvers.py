"""Values that depend on what was chosen elsewhere."""

import pytest
from omegaconf import OmegaConf

from softgm_bench.algorithms import algorithm_configs
from softgm_bench.config import compose_untyped, resolvers

resolvers.register()


def resolved(value, **settings):
    return OmegaConf.create({"value": value, **settings}).value


def test_a_value_depends_on_the_recipe():
    for recipe, expected in (("tuned", 0.95), ("paper", 0.99)):
        assert resolved("${tuned_or_paper:0.95, 0.99}", recipe=recipe) == expected


def test_lists_groups_and_null_can_be_chosen_as_well():
    value = "${tuned_or_paper:${first:null, [256, 256]}, {hidden:3}}"
    assert resolved(value, recipe="tuned") == [256, 256]
    assert resolved(value, recipe="paper") == {"hidden": 3}
    assert resolved("${tuned_or_paper:null, 1}", recipe="tuned") is None


def test_a_value_depends_on_whether_the_algorithm_has_a_replay():
    assert resolved("${on_or_off_policy:1, 2}", algo={"name": "mine"}) == 1
    assert resolved("${on_or_off_policy:1, 2}", algo={"name": "mine", "replay_capacity": 5}) == 2


def test_a_value_depends_on_whether_the_critic_is_centralised():
    assert resolved("${if_centralised:1, 2}", algo={"name": "mine", "centralised": True}) == 1
    assert resolved("${if_centralised:1, 2}", algo={"name": "mine", "centralised": False}) == 2


def test_a_value_depends_on_whether_the_task_hides_something():
    assert resolved("${if_hidden:1, 2}", task={"name": "mine", "hidden_scene": True}) == 1
    assert resolved("${if_hidden:1, 2}", task={"name": "mine", "hidden_scene": False}) == 2
    assert resolved("${if_hidden:1, 2}", task={"name": "mine"}) == 2


def test_a_value_depends_on_whether_training_begins_with_a_policy():
    assert resolved("${if_started:1, 2}", start={"policy": "some.pt"}) == 1
    assert resolved("${if_started:1, 2}", start={"policy": None}) == 2


@pytest.mark.parametrize(
    ("hidden", "model", "expected"), [(True, "softgm", 1), (True, "mlp", 2), (False, "softgm", 2), (False, "mlp", 2)]
)
def test_only_networks_other_than_mlps_learn_what_is_hidden_in_small_steps(hidden, model, expected):
    task = {"name": "mine", "hidden_scene": hidden}
    assert resolved("${in_small_steps:1, 2}", task=task, model={"name": model}) == expected


def test_a_value_depends_on_whether_numbers_of_sections_are_mixed():
    assert resolved("${if_mixture:1, 2}", task={"n_agents": [4]}) == 1
    assert resolved("${if_mixture:1, 2}", task={"n_agents": 4}) == 2
    assert resolved("${if_mixture:1, 2}", task={"scenario": {"n_agents": 4}}) == 2


def test_a_value_depends_on_whether_the_experiment_is_a_smoke_run():
    assert resolved("${in_smoke:1, 2}", experiment={"name": "smoke"}) == 1
    assert resolved("${in_smoke:1, 2}", experiment={"total_frames": 7}) == 2


def test_the_first_value_that_is_not_null():
    assert resolved("${first:${oc.select:task.train_horizon}, 7}", task={}) == 7
    assert resolved("${first:${oc.select:task.train_horizon}, 7}", task={"train_horizon": 3}) == 3
    assert resolved("${first:null, null}") is None


def test_the_command_line_replaces_the_choice():
    assert compose_untyped(["algo.gamma=0.5", "recipe=paper"]).algo.gamma == 0.5
    assert compose_untyped(["algo.critic.mlp=null"]).algo.critic.mlp is None


@pytest.mark.parametrize("algo", algorithm_configs())
def test_all_settings_can_be_printed_as_values(algo):
    """``--cfg job --resolve`` resolves in place, which OmegaConf does only with containers of its own."""
    composed = compose_untyped([f"algo={algo}", "task=wall"])
    values = OmegaConf.to_container(composed, resolve=True)
    OmegaConf.resolve(composed)
    assert OmegaConf.to_container(composed) == values
