"""Trained policies play the adapters' environments as they play ``SoftArmEnv``, and remember."""

import numpy as np
import pytest

from softgm_bench import api
from softgm_bench.adapters.gymnasium_vector import SoftArmGymnasiumEnv, SoftArmVectorEnv
from softgm_bench.adapters.pettingzoo import parallel_env
from softgm_bench.adapters.player import Player
from softgm_bench.envs import entries
from softgm_bench.errors import UserError
from untrained_policy import untrained

pytestmark = pytest.mark.usefixtures("one_thread")
ARM = ("rod.n_elements=20", "task.sensing_radius=0.4")
GRU = "algo.actor.memory={cell:gru,size:8}"
HORIZON = 5


def fresh(task, *overrides):
    return untrained(f"task={task}", *ARM, "model.hidden=16", "recipe=paper", *overrides)


def expected(trained, num_envs, steps):
    """Of ``api.rollout``, ``(steps, num_envs, N A)``."""
    task = trained.config.task.name
    env = api.make_env(f"task={task}", *ARM, num_envs=num_envs, seed=4, horizon=HORIZON)
    return api.rollout(env, trained, steps)[entries.ACTION].transpose(0, 1).flatten(2).numpy()


@pytest.mark.parametrize(("task", "memory"), [("structured", GRU), ("basic", GRU), ("basic", "seed=0")])
def test_a_player_of_pettingzoo_acts_as_the_policy_does_in_every_episode(task, memory):
    trained = fresh(task, memory)
    player = Player(trained)
    env = parallel_env(task, seed=4, horizon=HORIZON, overrides=ARM, observation="dict")
    found = []
    for _ in range(2):
        player.begin()
        observations, _ = env.reset()
        while env.agents:
            actions = player.actions(observations)
            found.append(np.concatenate(list(actions.values())))
            observations, *_ = env.step(actions)
    np.testing.assert_array_equal(np.stack(found), expected(trained, 1, 2 * HORIZON)[:, 0])


def test_a_player_of_a_vector_of_environments_forgets_where_episodes_end():
    trained = fresh("structured", GRU)
    player, env = Player(trained), SoftArmVectorEnv("structured", 3, seed=4, horizon=HORIZON, overrides=ARM)
    observations, _ = env.reset()
    begins, found = None, []
    for _ in range(2 * HORIZON):
        found.append(player.joint_actions(observations, begins))
        observations, _, terminated, truncated, _ = env.step(found[-1])
        begins = terminated | truncated
    np.testing.assert_array_equal(np.stack(found), expected(trained, 3, 2 * HORIZON))


def test_a_player_of_one_gymnasium_environment_gives_one_action():
    trained = fresh("basic", GRU)
    player, env = Player(trained), SoftArmGymnasiumEnv("basic", seed=4, horizon=HORIZON, overrides=ARM)
    observation, _ = env.reset()
    for reference in expected(trained, 1, HORIZON):
        action = player.joint_actions(observation)
        np.testing.assert_array_equal(action, reference[0])
        observation, *_ = env.step(action)


def test_observations_of_another_environment_are_refused_in_one_line():
    player = Player(fresh("basic", GRU))
    with pytest.raises(ValueError, match=r"^observations have 7 numbers: the policy's have 54$"):
        player.joint_actions(np.zeros((2, 7), dtype=np.float32))
    env = parallel_env("basic", seed=4, overrides=[*ARM, "task.n_agents=4"], observation="dict")
    with pytest.raises(ValueError, match=r"position.* has shape \(1, 4, 3\): the policy's task has \(1, 6, 3\)$"):
        player.actions(env.reset()[0])


def test_an_oracle_is_no_player():
    with pytest.raises(UserError, match=r"^softgm_oracle on wall: it reads what no adapter shows$"):
        Player(fresh("wall", "observation=oracle", "run_dir=oracle"))
