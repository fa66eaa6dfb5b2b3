"""The PettingZoo adapter keeps PettingZoo's contract and repeats ``SoftArmEnv`` bit by bit."""

import copy
import sys

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box, MultiBinary
from gymnasium.utils.env_checker import data_equivalence
from pettingzoo.test import parallel_api_test, parallel_seed_test
from torchrl.envs import PettingZooWrapper, check_env_specs

from every_task import MOVING
from softgm_bench.adapters.pettingzoo import parallel_env
from softgm_bench.envs import entries, make_env
from softgm_bench.errors import UserError
from softgm_bench.models.graph import flat_features, flat_observation

QUICK = "rod.substeps=10"  # a tenth of a control step: these tests are about the adapter
LEAN = np.array([[1.0, 0.0]] * 6, dtype=np.float32)  # all sections towards the wall

CASES = {
    "truncation": ("basic", 7, [QUICK]),
    "success": ("basic", 7, [QUICK, "task.success_radius=0.8"]),
    "wall": ("wall", 12, []),
    "noise": ("structured", 7, [QUICK, "perturbation=noise"]),
    "float32, four sections": ("basic", 7, [QUICK, "dtype=float32", "task.n_agents=4"]),
}


@pytest.fixture
def reference(settings):
    """The environment that the adapter must repeat."""

    def build(task, seed, horizon, overrides):
        config = settings(f"task={task}", *overrides)
        return make_env(
            config.task,
            config.rod,
            1,
            seed,
            horizon,
            dtype=getattr(torch, config.dtype),
            perturbation=config.perturbation,
        )

    return build


def random_actions(env, steps, seed=0):
    generator = np.random.default_rng(seed)
    shape = (steps, len(env.possible_agents), 2)
    return (LEAN[: shape[1]] + generator.uniform(-1.0, 1.0, shape)).clip(-1.0, 1.0).astype(np.float32)


def by_agent(env, action):
    return dict(zip(env.possible_agents, action, strict=True))


def same(observation, td):
    """Whether flat observations are what an MLP of ours reads."""
    return np.array_equal(np.stack(list(observation.values())), flat_observation(td)[0].numpy())


@pytest.mark.parametrize("observation", ["flat", "dict"])
def test_pettingzoo_s_own_test_passes_over_hundreds_of_cycles(observation, recwarn):
    horizon = {"flat": None, "dict": 30}[observation]  # beyond the last cycle, or an end and a reset
    parallel_api_test(
        parallel_env("basic", horizon=horizon, overrides=[QUICK], observation=observation), num_cycles=300
    )
    assert not [str(warning.message) for warning in recwarn if "gent" in str(warning.message)]


def test_pettingzoo_s_own_test_passes_on_the_wall():
    parallel_api_test(parallel_env("wall", horizon=20), num_cycles=60)


@pytest.mark.parametrize("task", MOVING)
def test_pettingzoo_s_own_test_passes_where_obstacles_move(task):
    parallel_api_test(parallel_env(task, horizon=20, overrides=[QUICK]), num_cycles=60)


def test_pettingzoo_s_own_test_of_seeds_passes():
    # ends after one step (it asks whether any agent's *name* is true): the test of seeds below goes on
    parallel_seed_test(lambda: parallel_env("basic", overrides=[QUICK]), num_cycles=400)


@pytest.mark.parametrize("case", CASES.values(), ids=CASES)
def test_steps_are_those_of_soft_arm_env_over_ends_and_resets(reference, case):
    task, horizon, overrides = case
    env, peer = parallel_env(task, 3, None, horizon, overrides), reference(task, 3, horizon, overrides)
    (observation, infos), td = env.reset(), peer.reset()
    ends, sensed = 0, False
    for action in random_actions(env, 30):
        assert same(observation, td)
        sensed |= bool(td[entries.EDGE].any())
        td.set(entries.ACTION, torch.from_numpy(action).unsqueeze(0))
        td = peer.step(td)["next"]
        observation, rewards, terminated, truncated, infos = env.step(by_agent(env, action))
        assert set(rewards.values()) == {td[entries.REWARD].item()}
        assert set(terminated.values()) == {td[entries.TERMINATED].item()}
        assert set(truncated.values()) == {td[entries.TRUNCATED].item()}
        for info in infos.values():
            for name in ("success", "diverged", "distance", "contact_nodes"):
                assert info[name] == td["info", name].item()
            for name in entries.REWARD_TERM_NAMES:
                assert info[f"reward_{name}"] == td["reward_terms", name].item()
        if td[entries.DONE].item():
            ends += 1
            assert env.agents == []
            assert same(observation, td)  # of the last state
            (observation, infos), td = env.reset(), peer.reset()
        assert env.agents == env.possible_agents
    assert ends >= 2
    assert sensed == (task == "wall")


def test_the_success_case_ends_by_success_and_by_the_horizon():
    task, horizon, overrides = CASES["success"]
    env = parallel_env(task, 3, None, horizon, overrides)
    reasons = set()
    env.reset()
    for action in random_actions(env, 30):
        _, _, terminated, truncated, infos = env.step(by_agent(env, action))
        if not env.agents:
            reasons.add((terminated["section_0"], truncated["section_0"], infos["section_0"]["success"]))
            env.reset()
    assert reasons == {(True, False, True), (False, True, False)}


def test_a_seed_gives_the_same_episodes_whatever_came_before():
    overrides = [QUICK, "perturbation=noise"]
    env, other = (parallel_env("basic", horizon=20, overrides=overrides) for _ in range(2))
    env.reset(seed=1)
    for action in random_actions(env, 5):
        env.step(by_agent(env, action))
    assert data_equivalence(env.reset(seed=7), other.reset(seed=7))
    for action in random_actions(env, 120, seed=1):
        assert data_equivalence(*(one.step(by_agent(one, action)) for one in (env, other)))
        if not env.agents:
            assert data_equivalence(env.reset(), other.reset())
    again = env.reset(seed=7)
    assert data_equivalence(again, other.reset(seed=7))
    assert not data_equivalence(again, env.reset(seed=8))


def test_without_a_seed_scenes_differ():
    one, other = (parallel_env("basic").reset()[0]["section_0"] for _ in range(2))
    assert not np.array_equal(one, other)


@pytest.mark.parametrize("task", ["basic", "wall"])
@pytest.mark.parametrize("observation", ["flat", "dict"])
def test_what_is_observed_lies_in_the_spaces(task, observation):
    env = parallel_env(task, seed=0, overrides=[QUICK], observation=observation)
    seen, _ = env.reset()
    for action in random_actions(env, 5):
        for agent in env.possible_agents:
            assert env.observation_space(agent).contains(seen[agent])
        assert env.state_space.contains(env.state())
        seen = env.step(by_agent(env, action))[0]


def test_spaces_have_the_documented_sizes():
    env = parallel_env("wall", overrides=["task.slots=32"])
    for agent in env.possible_agents:
        assert env.action_space(agent) == Box(-1.0, 1.0, (2,), np.float32)
        assert env.observation_space(agent).shape == (flat_features(32),) == (15 + 16 * 32,)
    assert env.state_space.shape == (6 * (3 + 3 + 2 + 32) + 32 * (9 + 1) + 6,)
    named = parallel_env("wall", overrides=["task.slots=32"], observation="dict").observation_space("section_0")
    assert named["edge"] == named["slot_active"] == MultiBinary(32)
    assert named["slot_descriptor"].shape == (32, 9)
    assert not {"edge", "slot_active", "slot_descriptor"} & set(
        parallel_env("basic", observation="dict").observation_space("section_0")
    )


def test_the_dict_holds_each_agent_s_own_rows_and_the_state_everything(reference):
    overrides = ["task.slots=32"]
    env, peer = parallel_env("wall", 5, overrides=overrides, observation="dict"), reference("wall", 5, None, overrides)
    env.reset()
    td = peer.reset()
    for action in random_actions(env, 12):
        td = peer.step(td.set(entries.ACTION, torch.from_numpy(action).unsqueeze(0)))["next"]
        observation = env.step(by_agent(env, action))[0]
    assert td[entries.EDGE].any()
    assert not torch.equal(td[entries.EDGE][0, 0], td[entries.EDGE][0, -1])
    for row, agent in enumerate(env.possible_agents):
        for name, key in (
            ("position", entries.AGENT_POSITION),
            ("velocity", entries.AGENT_VELOCITY),
            ("edge", entries.EDGE),
        ):
            assert np.array_equal(observation[agent][name], td[key][0, row].numpy())
        assert np.array_equal(observation[agent]["previous_action"], action[row])
        for name, key in (
            ("slot_descriptor", entries.SLOT_DESCRIPTOR),
            ("tip", entries.TIP),
            ("target", entries.TARGET),
        ):
            assert np.array_equal(observation[agent][name], td[key][0].numpy())
    state = env.state()
    assert np.array_equal(state, np.concatenate([td[key].numpy().ravel() for key in entries.OBSERVATION]))


def test_changing_an_observation_changes_nothing_else():
    env, other = (parallel_env("wall", 5, overrides=[QUICK], observation="dict") for _ in range(2))
    env.reset()
    other.reset()
    for action in random_actions(env, 12):
        seen, expected = (one.step(by_agent(one, action))[0] for one in (env, other))
        assert data_equivalence(seen, expected)
        for value in seen["section_0"].values():
            value.fill(1)
        assert data_equivalence(seen["section_1"], expected["section_1"])


def test_actions_beyond_the_space_are_clipped():
    env, other = (parallel_env("basic", 0, overrides=[QUICK]) for _ in range(2))
    env.reset()
    other.reset()
    assert data_equivalence(env.step(by_agent(env, 3.0 * LEAN)), other.step(by_agent(other, LEAN)))


def test_torchrl_s_wrapper_takes_it():
    check_env_specs(PettingZooWrapper(parallel_env("basic", 0, overrides=[QUICK])))


def test_metadata_tell_real_time():
    assert parallel_env("basic").metadata["render_fps"] == pytest.approx(25.0)


def test_pictures_show_the_arm_as_it_stands():
    pytest.importorskip("PIL", reason="an optional extra: pip install 'softgm-bench[render]'")
    env, plain = (parallel_env("wall", 1, mode) for mode in ("rgb_array", None))
    assert data_equivalence(env.reset(), plain.reset())
    before = env.render()
    for _ in range(8):
        assert data_equivalence(env.step(by_agent(env, LEAN)), plain.step(by_agent(plain, LEAN)))
    after = env.render()
    assert before.shape == after.shape == (480, 640, 3)
    assert before.dtype == np.uint8
    changed = (before != after).any(axis=-1)
    assert 0.001 < changed.mean() < 0.2  # the arm and its shadow; the camera stands still
    assert np.array_equal(after, env.render())
    env.reset()
    assert not np.array_equal(before, env.render())  # another scene


def test_rendering_that_was_not_asked_for_or_is_not_installed_is_refused(monkeypatch):
    env = parallel_env("basic")
    env.reset()
    with pytest.warns(UserWarning, match="render_mode='rgb_array'"):
        assert env.render() is None
    env = parallel_env("basic", render_mode="rgb_array")
    with pytest.raises(ValueError, match=r"reset\(\)"):
        env.render()
    env.reset()
    monkeypatch.setitem(sys.modules, "softgm_bench.render.still", None)
    with pytest.raises(ImportError, match=r"pip install '\.\[render\]'"):
        env.render()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"task": "moon"}, "task is 'moon': choose one of basic"),
        ({"task": "vmas_balance"}, "task is 'vmas_balance'"),
        ({"observation": "pixels"}, "observation is 'pixels': choose one of flat, dict"),
        ({"render_mode": "human"}, "render_mode is 'human'"),
        ({"horizon": 0}, "horizon is 0"),
        ({"seed": -1}, "seed is -1"),
        ({"overrides": "dtype=float32"}, "overrides is 'dtype=float32': it must be a list"),
        ({"overrides": ["algo=mappo"]}, "overrides holds 'algo=mappo'"),
        ({"overrides": ["task=basic"]}, "overrides holds 'task=basic'"),
        ({"overrides": ["seed=3"]}, "overrides holds 'seed=3'"),
        ({"overrides": ["task.slot=3"]}, "task.slot"),
        ({"overrides": ["task.slots=many"]}, "task.slots"),
        ({"overrides": ["task.n_agents=0"]}, "task.n_agents is 0"),
        ({"overrides": ["perturbation=rain"]}, "rain"),
    ],
)
def test_bad_arguments_are_refused_in_one_line(arguments, message):
    with pytest.raises((ValueError, UserError)) as refused:
        parallel_env(**({"task": "wall"} | arguments))
    assert message in str(refused.value)
    assert "\n" not in str(refused.value)


def test_steps_that_cannot_be_are_refused():
    env = parallel_env("basic", horizon=1, overrides=[QUICK])
    actions = by_agent(env, LEAN)
    for early in (lambda: env.step(actions), env.state):
        with pytest.raises(ValueError, match=r"reset\(\)"):
            early()
    env.reset()
    with pytest.raises(ValueError, match="they must be of section_0"):
        env.step({"section_0": LEAN[0]})
    with pytest.raises(ValueError, match=r"action has shape \(3,\)"):
        env.step(actions | {"section_2": np.zeros(3)})
    with pytest.raises(ValueError, match="not finite"):
        env.step(actions | {"section_2": np.array([0.0, np.nan])})
    with pytest.raises(ValueError, match="seed is -1"):
        env.reset(seed=-1)
    env.step(actions)
    with pytest.raises(ValueError, match=r"reset\(\)"):
        env.step(actions)


def test_copies_of_an_unseeded_environment_play_scenes_of_their_own():
    env = parallel_env("basic", overrides=["rod.substeps=10"])
    other = copy.deepcopy(env)
    seeded = [parallel_env("basic", 3, overrides=["rod.substeps=10"]), copy.deepcopy(env)]
    targets = [one.reset() and one.arm.scene.target.numpy().copy() for one in (env, other)]
    assert not np.array_equal(*targets)
    assert np.array_equal(seeded[0].reset()[0]["section_0"], seeded[1].reset(seed=3)[0]["section_0"])


def test_wrappers_that_go_on_with_dead_agents_or_draw_numbers_find_what_they_need():
    """As SuperSuit's black death and frame skip do."""
    env = parallel_env("basic", overrides=[QUICK], horizon=2)
    with pytest.raises(ValueError, match="call reset"):
        env.step({})
    env.reset(seed=5)
    drawn = env.np_random.integers(1000)
    while env.agents:
        env.step({agent: np.zeros(2, dtype=np.float32) for agent in env.agents})
    assert env.step({}) == ({}, {}, {}, {}, {})
    env.reset(seed=5)
    assert env.np_random.integers(1000) == drawn


@pytest.mark.parametrize("name", ["frame_skip_v0", "black_death_v3"])
def test_supersuit_comes_to_an_end(name):
    supersuit = pytest.importorskip("supersuit")
    wrap = {"frame_skip_v0": lambda env: supersuit.frame_skip_v0(env, 3), "black_death_v3": supersuit.black_death_v3}
    env = wrap[name](parallel_env("basic", overrides=[QUICK], horizon=7))
    env.reset(seed=0)
    steps = 0
    while env.agents and steps < 20:
        env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        steps += 1
    assert steps == {"frame_skip_v0": 3, "black_death_v3": 8}[name]
