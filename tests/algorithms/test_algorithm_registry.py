import dataclasses
from typing import get_type_hints

import pytest

from softgm_bench.algorithms import PPO, PPOConfig, algorithm_configs, build_algorithm, register_algorithm
from softgm_bench.config import config_directory
from softgm_bench.envs import make_env
from softgm_bench.rod.parameters import RodParameters


def test_every_algorithm_has_its_settings_and_every_settings_file_its_algorithm():
    files = {path.stem for path in (config_directory() / "algo").glob("*.yaml")}
    assert files == set(algorithm_configs())
    assert {"softgm", "ippo", "mappo", "iddpg", "maddpg", "isac", "masac"} <= files


def test_every_configuration_says_its_name_and_whether_its_critic_sees_all_agents():
    for config in algorithm_configs().values():
        hints = get_type_hints(config)
        assert hints["name"] is str
        assert hints["centralised"] is bool


def test_the_name_chooses_the_algorithm_and_its_critic(settings):
    env = make_env(settings().task, RodParameters(substeps=5), num_envs=2, seed=0)
    for name, centralised in (("softgm", True), ("ippo", False), ("mappo", True)):
        config = settings(f"algo={name}")
        algorithm = build_algorithm(config.algo, config.model, env)
        assert isinstance(algorithm, PPO)
        assert algorithm.config.centralised is centralised


def test_a_configuration_of_no_algorithm_or_of_another_is_refused(settings):
    config = settings()
    env = make_env(config.task, RodParameters(substeps=5), num_envs=2, seed=0)
    for name in ("nonsense", "iddpg"):
        with pytest.raises(ValueError, match=f"PPOConfig is not the configuration of an algorithm named '{name}'"):
            build_algorithm(dataclasses.replace(config.algo, name=name), config.model, env)


def test_a_name_is_registered_once():
    with pytest.raises(ValueError, match="'ippo' is registered already"):
        register_algorithm("ippo", config=PPOConfig)(PPO)
