"""Which settings of two runs differ in what numbers depend on."""

from omegaconf import OmegaConf

from softgm_bench.config import compose, plain, typed
from softgm_bench.config.comparison import ABSENT, FREE, differences
from softgm_bench.config.upgrade import NEUTRAL


def test_equal_settings_do_not_differ_also_as_yaml_has_them():
    values = plain(compose(["task=wall"]))
    assert differences(values, OmegaConf.to_container(OmegaConf.create(values))) == {}


def test_both_values_are_told_by_key_names_first():
    wanted, held = (plain(compose(overrides)) for overrides in (["seed=1", "perturbation=noise"], ["algo.gamma=0.5"]))
    found = differences(wanted, held)
    assert next(iter(found.items())) == ("perturbation.name", ("noise", "none"))
    assert list(found)[1:3] == ["algo.gamma", "perturbation.action_sigma"]
    assert found["seed"] == (1, 0)


def test_what_no_number_depends_on_is_free():
    free = ["seed=0", "run_dir=x", "overwrite=true", "resume=true", "threads=1", "logger=wandb", "compile=none"]
    one, other = (plain(compose(overrides)) for overrides in ([], [*free, "experiment.checkpoint.keep=9"]))
    assert differences(one, other) == {}
    assert differences({"seed": 1, "task": {"a": 1}}, {"seed": 2, "task": {"a": 2}}, ["seed", "task"]) == {}


def test_a_part_that_only_one_has_differs_in_each_of_its_keys():
    one, other = plain(compose(["recipe=paper"])), plain(compose(["recipe=paper"]))
    other["algo"]["critic"]["mlp"] = {"hidden": 3, "layers": 2}
    assert differences(one, other) == {"algo.critic.mlp.hidden": (None, 3), "algo.critic.mlp.layers": (None, 2)}
    assert differences({}, {"seed": 0, "task": {"name": "a"}}) == {"task.name": (ABSENT, "a"), "seed": (ABSENT, 0)}


def test_a_run_from_before_there_were_named_recipes_is_the_same_run():
    """What a recipe or an experiment stands for is compared, not what it is called."""
    plainly = ["algo.actor.embedding_norm=false", "algo.critic.embedding_norm=false"]  # an old run's never were
    for recipe in ("tuned", "paper"):
        today = plain(compose(["task=wall", f"recipe={recipe}", "experiment=quick", *plainly]))
        before = OmegaConf.create(today)
        for key in NEUTRAL:
            group, _, name = key.rpartition(".")
            del (OmegaConf.select(before, group) if group else before)[name]
        assert differences(today, plain(typed(before))) == {}


def test_what_came_later_is_free_unless_it_changes_numbers():
    networks = {f"algo.{part}.{norm}_norm" for part in ("actor", "critic") for norm in ("embedding", "hidden")}
    networks |= {"algo.actor.relative_points", "algo.actor.memory", "algo.actor.mirror", "model.remember", "matmul"}
    networks |= {"start.policy", "start.critic_frames"}
    surfaces = {f"task.{name}_coefficient" for name in ("friction", "velocity_damping")}
    tasks = surfaces | {"task.max_contact_steps", "task.contact_counts", "task.reward.lambda_fail"}
    eased = (
        "easier_share",
        "easy_contact_steps",
        "contact_stages",
        "easy_lambda_c",
        "easy_target_offset",
        "target_power",
    )
    tasks |= {f"task.curriculum.{name}" for name in eased}
    assert set(NEUTRAL) - set(FREE) == networks | tasks
