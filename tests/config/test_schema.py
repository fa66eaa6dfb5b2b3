import dataclasses

import pytest
from refused import refusal

from softgm_bench.config import compose
from softgm_bench.envs import PerturbationConfig
from softgm_bench.rod.randomise import RandomiseConfig


def test_another_model_than_an_algorithms_own_is_named_in_folder_and_label():
    for algo, model, name in (
        ("softgm", "softgm", "softgm"),
        ("softgm", "softgm_no_stage1", "softgm_no_stage1"),
        ("softgm", "softgm_remember", "softgm_remember"),
        ("masac", "softgm_no_stage2", "masac_softgm_no_stage2"),
        ("softgm", "mlp", "softgm_mlp"),
        ("softgm", "informarl", "softgm_informarl"),
        ("mappo", "section_transformer_all", "mappo_section_transformer_all"),
        ("masac", "mlp", "masac"),
        ("masac", "softgm", "masac_softgm"),
    ):
        config = compose([f"algo={algo}", f"model={model}"])
        assert config.label == name
        assert config.run_dir == f"outputs/basic/{name}/seed0"


def test_an_oracle_says_so_wherever_its_results_go():
    assert compose(["observation=oracle", "algo=ippo"]).run_dir == "outputs/basic/ippo_oracle/seed0"
    assert compose(["observation=oracle", "algo=ippo"]).label == "ippo_oracle"
    assert compose(["observation=oracle", "run_dir=here/oracle"]).oracle
    assert refusal("observation=oracle", "run_dir=here").startswith(
        "run_dir=here with observation=oracle: put the word"
    )
    assert not compose([]).oracle


def test_what_was_trained_under_a_perturbation_says_so_wherever_its_results_go():
    for name in ("noise", "section_failure", "disturbance"):
        config = compose([f"perturbation={name}", "algo=masac"])
        assert config.label == f"masac_{name}"
        assert config.run_dir == f"outputs/basic/masac_{name}/seed0"
        assert not config.perturbation.nothing
    assert compose(["perturbation=noise", "perturbation.name=fog"]).label == "softgm_fog"
    assert compose([]).perturbation == PerturbationConfig()


def test_what_was_trained_with_drawn_bodies_says_so_wherever_its_results_go():
    for name in ("moderate", "wide"):
        config = compose([f"randomise={name}", "algo=masac"])
        assert config.label == f"masac_randomised_{name}"
        assert config.run_dir == f"outputs/basic/masac_randomised_{name}/seed0"
    assert compose(["randomise=wide", "perturbation=noise"]).label == "softgm_noise_randomised_wide"
    assert compose([]).randomise == RandomiseConfig()


def test_what_began_with_a_trained_policy_says_so_and_lets_its_critic_learn_first():
    config = compose(["start.policy=some.pt", "algo=masac", "perturbation=noise"])
    assert config.label == "masac_noise_started"
    assert config.run_dir == "outputs/basic/masac_noise_started/seed0"
    assert config.start.critic_frames > 0
    assert config.algo.random_frames == 0
    fresh = compose(["algo=masac"])
    assert (fresh.label, fresh.start.critic_frames) == ("masac", 0)
    assert fresh.algo.random_frames > 0


@pytest.mark.parametrize("algo", ["softgm", "iddpg", "isac"])
def test_dataclasses_carry_no_values_of_their_own_but_the_arms(algo):
    config = compose([f"algo={algo}"])
    parts = (config, config.experiment, config.experiment.evaluation, config.task, config.algo, config.model)
    parts += (config.algo.actor, config.algo.critic)
    for part in parts:
        fields = dataclasses.fields(part)
        assert all(field.default is field.default_factory is dataclasses.MISSING for field in fields), type(part)
