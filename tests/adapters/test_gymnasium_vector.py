"""The Gymnasium adapters keep Gymnasium's contract and repeat ``SoftArmEnv`` bit by bit."""

import copy

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env, data_equivalence
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import NormalizeObservation, RecordEpisodeStatistics

from softgm_bench.adapters.gymnasium_vector import SoftArmGymnasiumEnv, SoftArmVectorEnv, register
from softgm_bench.envs import entries, make_env
from softgm_bench.envs.tasks import TASKS
from softgm_bench.errors import UserError

ENVS = 5
QUICK = "rod.substeps=10"  # a tenth of a control step: these tests are about the adapter
EASY = ("basic", 9, [QUICK, "task.success_radius=0.55"])  # episodes end at different times


def actions_for(env, steps):
    generator = np.random.default_rng(0)
    return generator.uniform(-1.0, 1.0, (steps, *env.action_space.shape)).astype(np.float32)


def joint(td):
    return np.concatenate([td[key].numpy().reshape(td.batch_size[0], -1) for key in entries.OBSERVATION], axis=1)


def column(td, *key):
    return td[key].squeeze(-1).numpy()


@pytest.mark.parametrize(
    ("task", "horizon", "overrides"), [EASY, ("wall", 12, ["task.slots=32"])], ids=["basic", "wall"]
)
def test_a_rollout_is_soft_arm_env_s(settings, task, horizon, overrides):
    env = SoftArmVectorEnv(task, ENVS, 3, horizon, overrides)
    config = settings(f"task={task}", *overrides)
    peer = make_env(config.task, config.rod, ENVS, 3, horizon)
    observation, infos = env.reset()
    td = peer.reset()
    ends = []
    for action in actions_for(env, 30):
        assert np.array_equal(observation, joint(td))
        assert np.array_equal(infos["distance"], column(td, *entries.DISTANCE))
        last = peer.step(td.set(entries.ACTION, torch.from_numpy(action).reshape(ENVS, -1, 2)))["next"]
        observation, reward, terminated, truncated, infos = env.step(action)
        assert np.array_equal(reward, column(last, entries.REWARD))
        assert np.array_equal(terminated, column(last, entries.TERMINATED))
        assert np.array_equal(truncated, column(last, entries.TRUNCATED))
        done = terminated | truncated
        ends.append(done)
        td = last
        if done.any():
            assert np.array_equal(np.stack(infos["final_obs"][done]), joint(last)[done])
            assert all(row is None for row in infos["final_obs"][~done])
            assert np.array_equal(infos["_final_obs"], done)
            success = infos["final_info"]["success"]
            assert np.array_equal(success, column(last, *entries.SUCCESS) & done)
            td = peer.reset(last.clone().set("_reset", torch.from_numpy(done).unsqueeze(-1)))
        else:
            assert "final_obs" not in infos
    some = np.stack(ends)
    assert some.sum() >= 2 * ENVS
    assert (some.any(axis=1) & ~some.all(axis=1)).any() == (task == "basic")  # ends at different times


def test_one_environment_gives_what_gymnasium_s_own_vector_environment_makes_of_it():
    task, horizon, overrides = EASY
    env = SoftArmVectorEnv(task, 1, 0, horizon, overrides)
    own = SyncVectorEnv(
        [lambda: SoftArmGymnasiumEnv(task, 0, horizon, overrides)], autoreset_mode=AutoresetMode.SAME_STEP
    )
    assert env.observation_space == own.observation_space
    assert env.action_space == own.action_space
    assert env.metadata["autoreset_mode"] == own.metadata["autoreset_mode"]
    mine, theirs = env.reset(seed=4), own.reset(seed=4)
    assert data_equivalence(mine, theirs)
    ends = 0
    for action in actions_for(env, 30):
        (*mine, info), (*theirs, expected) = env.step(action), own.step(action)
        assert data_equivalence(mine, theirs)
        final, expected_final = (infos.pop("final_obs", None) for infos in (info, expected))
        assert (final is None) == (expected_final is None)
        if final is not None:
            ends += 1
            assert np.array_equal(final[0], expected_final[0])
        assert data_equivalence(info, expected)
    assert ends > 2


def test_gymnasium_s_own_check_passes():
    check_env(SoftArmGymnasiumEnv("basic", overrides=[QUICK]), skip_render_check=True)


def test_registered_names_make_environments():
    register()
    assert {f"SoftArm-{task}-v0" for task in TASKS} <= set(gymnasium.registry)
    with gymnasium.make("SoftArm-structured-v0", overrides=[QUICK]) as one:
        assert one.observation_space.contains(one.reset(seed=0)[0])
        assert one.unwrapped.spec.id == "SoftArm-structured-v0"
    many = gymnasium.make_vec("SoftArm-basic-v0", num_envs=3, horizon=4, overrides=[QUICK])
    assert isinstance(many, SoftArmVectorEnv)
    observation, _ = many.reset(seed=0)
    assert many.observation_space.contains(observation)
    assert observation.shape == (3, 6 * 8 + 6)


def test_episode_statistics_are_those_of_whole_episodes():
    task, horizon, overrides = EASY
    env = RecordEpisodeStatistics(SoftArmVectorEnv(task, ENVS, 3, horizon, overrides))
    env.reset()
    returns, lengths, episodes = np.zeros(ENVS), np.zeros(ENVS, dtype=int), 0
    for action in actions_for(env, 20):
        _, reward, terminated, truncated, infos = env.step(action)
        returns, lengths = returns + reward, lengths + 1
        done = terminated | truncated
        if done.any():
            assert np.array_equal(infos["episode"]["r"][done], returns[done])
            assert np.array_equal(infos["episode"]["l"][done], lengths[done])
            episodes += done.sum()
        returns[done], lengths[done] = 0.0, 0
    assert env.episode_count == episodes > ENVS


def test_a_seed_gives_the_same_episodes_whatever_came_before():
    env, other = (SoftArmVectorEnv("basic", 2, None, 4, [QUICK]) for _ in range(2))
    env.reset()
    env.step(actions_for(env, 1)[0])
    first, second = env.reset(seed=7), other.reset(seed=7)
    assert data_equivalence(first, second)
    assert not np.array_equal(*first[0])  # the environments have scenes of their own
    for action in actions_for(env, 10):
        (*mine, _), (*theirs, _) = env.step(action), other.step(action)
        assert data_equivalence(mine, theirs)
    assert not data_equivalence(env.reset(seed=8), first)


def test_what_cannot_be_is_refused_in_one_line():
    with pytest.raises(ValueError, match="num_envs is 0"):
        SoftArmVectorEnv("basic", 0)
    with pytest.raises(ValueError, match="task is 'moon'"):
        SoftArmVectorEnv("moon")
    with pytest.raises(ValueError, match="render_mode is 'human'"):
        SoftArmGymnasiumEnv("basic", render_mode="human")
    with pytest.raises(UserError, match=r"task\.slot"):
        SoftArmGymnasiumEnv("basic", overrides=["task.slot=1"])
    for env in (SoftArmVectorEnv("basic", 2, overrides=[QUICK]), SoftArmGymnasiumEnv("basic", overrides=[QUICK])):
        action = np.zeros(env.action_space.shape)
        with pytest.raises(ValueError, match=r"reset\(\)"):
            env.step(action)
        with pytest.raises(ValueError, match="seed is -1"):
            env.reset(seed=-1)
        env.reset()
        with pytest.raises(ValueError, match="action has shape"):
            env.step(action[..., 1:])
        with pytest.raises(ValueError, match="not finite"):
            env.step(action + np.inf)
    with pytest.raises(ValueError, match="reset_mask"):
        SoftArmVectorEnv("basic", 2).reset(options={"reset_mask": np.array([True, False])})


def scene(env):
    return env._arm.scene.target.numpy().copy()


@pytest.mark.parametrize("kind", [SoftArmGymnasiumEnv, SoftArmVectorEnv])
def test_copies_of_an_unseeded_environment_play_scenes_of_their_own(kind):
    env = kind("basic", overrides=[QUICK])
    others = [copy.deepcopy(env) for _ in range(2)]
    for one in (env, *others):
        one.reset()
    assert len({tuple(scene(one).ravel()) for one in (env, *others)}) == 3
    seeded = kind("basic", seed=3, overrides=[QUICK])
    again = copy.deepcopy(seeded)
    assert data_equivalence(seeded.reset(), again.reset())
    assert data_equivalence(env.reset(seed=3), kind("basic", seed=3, overrides=[QUICK]).reset())


def test_seeds_of_each_environment_give_the_scenes_of_environments_alone():
    env = SoftArmVectorEnv("basic", 3, overrides=[QUICK])
    observation, _ = env.reset(seed=[5, 1, 5])
    alone = [SoftArmGymnasiumEnv("basic", seed, overrides=[QUICK]).reset()[0] for seed in (5, 1, 5)]
    assert np.array_equal(observation, np.stack(alone))
    later = env.reset()[0]
    assert np.array_equal(env.reset(seed=[5, 1, 5])[0], observation)
    assert np.array_equal(env.reset()[0], later)
    env.reset(seed=[5, None, 2])
    with pytest.raises(ValueError, match=r"^seed has 2 numbers: it must be one, or one for each of 3$"):
        env.reset(seed=[1, 2])


def test_an_episode_begins_again_in_the_next_step_where_that_is_asked_for():
    task, horizon, overrides = EASY
    same = SoftArmVectorEnv(task, ENVS, 3, horizon, overrides)
    later = SoftArmVectorEnv(task, ENVS, 3, horizon, overrides, autoreset_mode=AutoresetMode.NEXT_STEP)
    assert np.array_equal(same.reset()[0], later.reset()[0])
    ended = np.zeros(ENVS, dtype=bool)
    begun = 0
    for action in actions_for(later, 20):
        observation, reward, terminated, truncated, infos = later.step(action)
        assert (reward[ended] == 0.0).all()
        assert not (terminated | truncated)[ended].any()
        begun += ended.sum()
        ended = terminated | truncated
        assert np.isfinite(observation).all()
        assert infos["distance"].shape == (ENVS,)
    assert begun > ENVS
    assert same.metadata["autoreset_mode"] == AutoresetMode.SAME_STEP
    with pytest.raises(ValueError, match="autoreset_mode is"):
        SoftArmVectorEnv(task, ENVS, autoreset_mode=AutoresetMode.DISABLED)


def test_gymnasium_s_normalising_wrapper_works():
    register()
    env = gymnasium.make_vec(
        "SoftArm-basic-v0",
        num_envs=3,
        vectorization_mode="vector_entry_point",
        autoreset_mode=AutoresetMode.NEXT_STEP,
        horizon=4,
        overrides=[QUICK],
    )
    normal = NormalizeObservation(env)
    normal.reset(seed=[1, 2, 3])
    for action in actions_for(normal, 9):
        observation, *_ = normal.step(action)
    assert np.abs(observation).max() < 10.0


def test_pictures_are_those_of_the_arm():
    """Stable-Baselines3's ``make_vec_env`` asks every environment for them."""
    register()
    env = gymnasium.make("SoftArm-basic-v0", render_mode="rgb_array", overrides=[QUICK], horizon=5)
    env.reset(seed=0)
    first = env.render()
    env.step(np.ones(env.action_space.shape, dtype=np.float32))
    assert first.shape == (480, 640, 3)
    assert not np.array_equal(env.render(), first)
    assert SoftArmGymnasiumEnv("basic").render() is None


def test_stable_baselines_makes_and_steps_it():
    env_util = pytest.importorskip("stable_baselines3.common.env_util")
    register()
    envs = env_util.make_vec_env("SoftArm-basic-v0", 2, seed=0, env_kwargs={"overrides": [QUICK], "horizon": 3})
    envs.reset()
    for action in actions_for(SoftArmGymnasiumEnv("basic"), 4):
        observation, *_ = envs.step(np.stack([action] * 2))
    assert observation.shape[0] == 2
