import pytest
import torch

from off_policy_cases import SHORT, SMALL, batches, copied
from softgm_bench.algorithms import build_algorithm
from softgm_bench.algorithms.ddpg import DDPGConfig
from softgm_bench.algorithms.registry import algorithm_configs
from softgm_bench.algorithms.sac import SACConfig
from softgm_bench.envs import make_env

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.mark.parametrize("name", ["iddpg", "maddpg", "isac", "masac"])
def test_an_algorithm_goes_on_bit_for_bit_from_its_saved_state(settings, name):
    def build():
        config = settings("task=basic", f"algo={name}", *SMALL, "algo.checkpoint_replay=true")
        torch.manual_seed(0)
        env = make_env(config.task, SHORT, num_envs=4, seed=0, horizon=7)
        return build_algorithm(config.algo, config.model, env), env

    algorithm, env = build()
    first, second = batches(algorithm, env, count=2)
    algorithm.update(first)
    saved = copied(algorithm.state_dict())
    other, _ = build()
    other.load_state_dict(saved)

    def proceed(one):
        torch.manual_seed(5)
        return one.update(second)

    assert proceed(algorithm) == proceed(other)
    assert vars(algorithm.policy).get("sigma") == vars(other.policy).get("sigma")


@pytest.mark.parametrize(("family", "config"), [("ddpg", DDPGConfig), ("sac", SACConfig)])
def test_names_mean_the_switch(settings, family, config):
    independent = "i" + family
    assert algorithm_configs()[independent] is algorithm_configs()["ma" + family] is config
    assert not settings(f"algo={independent}").algo.centralised
    assert settings(f"algo=ma{family}").algo.centralised
