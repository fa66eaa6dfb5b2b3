"""A curriculum inside the environment: who has one, what it leaves alone, what is saved."""

from contextlib import nullcontext

import pytest
import torch
from torchrl.envs.utils import check_env_specs

from dense import force_dense
from round_trips import RoundTrips
from softgm_bench.envs import entries, make_env
from softgm_bench.rod.parameters import RodParameters

TASKS = ("basic", "structured", "wall")
ENABLED = "task.curriculum.enabled=true"
ROUND = "task.curriculum.episodes=4"


@pytest.fixture
def build(settings):
    def environment(task, *overrides, num_envs=4, seed=0, curriculum=True, substeps=1, **options):
        config = settings(f"task={task}", *overrides)
        rod = RodParameters(substeps=substeps)
        return make_env(config.task, rod, num_envs=num_envs, seed=seed, curriculum=curriculum, **options)

    return environment


def actions(env, steps):
    generator = torch.Generator().manual_seed(1)
    return 2.0 * torch.rand((steps, *env.batch_size, env.sizes.n_agents, 2), generator=generator) - 1.0


def leaves(td):
    return dict(td.items(include_nested=True, leaves_only=True))


def edit(env, change):
    state = env.simulation_state()
    change(state)
    env.load_simulation_state(state)


def put_targets_at_the_tips(env, rows):
    def aim(state):
        state["episodes", "scene", "target"][rows] = state["episodes", "rod", "position"][rows, :, -1]

    edit(env, aim)


def advance(env, td, action=None):
    """The frames after a step and after the resets that follow it."""
    td = td.clone().set(
        entries.ACTION, torch.zeros(*env.batch_size, env.sizes.n_agents, 2) if action is None else action
    )
    out, following = env.step_and_maybe_reset(td)
    return out["next"], following


def play(env, steps):
    td, frames = env.reset(), []
    frames.append(leaves(td.clone()))
    for action in actions(env, steps):
        after, td = advance(env, td, action)
        frames += [leaves(after.clone()), leaves(td.clone())]
    return frames


def assert_same_bits(one, other, but=()):
    for step, (a, b) in enumerate(zip(one, other, strict=True)):
        assert a.keys() - set(but) == b.keys() - set(but)
        for key in a.keys() - set(but):
            assert torch.equal(a[key], b[key]), (step, key)


@pytest.mark.parametrize("task", TASKS)
def test_specs_are_kept(build, task):
    check_env_specs(build(task, ENABLED))


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(("overrides", "asked"), [((ENABLED,), False), ((), True)], ids=["not asked", "not enabled"])
def test_who_does_not_ask_for_it_or_has_none_enabled_gets_the_same_bits_as_without(build, task, overrides, asked):
    plain = build(task, curriculum=False, horizon=3, stagger=True)
    other = build(task, *overrides, curriculum=asked, horizon=3, stagger=True)
    assert other.task.max_cylinders == plain.task.max_cylinders
    found = play(other, 7)
    assert entries.DIFFICULTY not in found[0]
    assert_same_bits(play(plain, 7), found)


@pytest.mark.parametrize("task", TASKS)
def test_at_the_last_stage_whole_episodes_are_the_tasks_own_bit_for_bit(build, task):
    plain = build(task, curriculum=False, horizon=3, substeps=10)
    eased = build(task, ENABLED, "task.curriculum.demote=0.0", horizon=3, substeps=10)
    edit(eased, lambda state: state["progress", "stage"].fill_(10))
    eased.set_seed(0)
    plain.set_seed(0)
    expected, found = play(plain, 7), play(eased, 7)
    assert all((frame[entries.DIFFICULTY] == 1.0).all() for frame in found)
    assert_same_bits(expected, found, but=[entries.DIFFICULTY])


@pytest.mark.parametrize("task", ["basic", "structured"])
def test_the_same_state_gives_the_same_rewards_and_observations_with_and_without(build, task):
    eased, plain = build(task, ENABLED, substeps=20), build(task, curriculum=False, substeps=20)
    td = eased.reset()
    plain.reset()
    plain.load_simulation_state(eased.simulation_state())
    for action in actions(eased, 4):
        td = td.clone().set(entries.ACTION, action)
        found, expected = eased.step(td.clone())["next"], plain.step(td.clone())["next"]
        assert_same_bits([leaves(expected)], [leaves(found)], but=[entries.DIFFICULTY])
        td = found.exclude("reward")


def test_a_round_of_successes_is_a_stage_and_the_last_frames_keep_their_own_difficulty(build):
    env = build("wall", ENABLED, ROUND, "task.curriculum.stages=4", horizon=50)
    td = env.reset()
    sides = [0.6, 0.525, 0.45, 0.375, 0.3, 0.3]  # from 0.6 to 0.3 in four steps
    for stage, side in enumerate(sides):
        assert torch.allclose(td[entries.PRIVILEGED][:, 3], torch.tensor(side))
        assert torch.equal(td[entries.DIFFICULTY], torch.full((4, 1), min(stage, 4) / 4))
        put_targets_at_the_tips(env, [0, 1, 2, 3])
        after, td = advance(env, td)
        assert after["terminated"].all()
        assert torch.equal(after[entries.DIFFICULTY], torch.full((4, 1), min(stage, 4) / 4))


def test_a_round_of_failures_is_a_stage_back(build):
    env = build("basic", ENABLED, ROUND, "task.curriculum.stages=4", horizon=1)
    edit(env, lambda state: state["progress", "stage"].fill_(3))
    td, seen = env.reset(), []
    for _ in range(5):
        seen.append(td[entries.DIFFICULTY].unique().item())
        _, td = advance(env, td)
    assert seen == [0.75, 0.5, 0.25, 0.0, 0.0]


def test_broken_episodes_are_failures(build):
    env = build("basic", ENABLED, ROUND, "task.curriculum.stages=4")
    edit(env, lambda state: state["progress", "stage"].fill_(2))
    td = env.reset()
    put_targets_at_the_tips(env, [0, 1, 2, 3])
    edit(env, lambda state: state["episodes", "rod", "velocity"].fill_(float("nan")))
    after, td = advance(env, td)
    assert after[entries.DIVERGED].all()
    assert torch.equal(td[entries.DIFFICULTY], torch.full((4, 1), 0.25))


def test_an_episode_that_has_ended_and_is_not_reset_counts_once(build):
    env = build("basic", ENABLED, ROUND, horizon=1, num_envs=2)  # a round is two episodes of each
    td = env.reset().set(entries.ACTION, torch.zeros(2, 6, 2))
    for _ in range(3):
        td = env.step(td.clone().exclude("next"))["next"].exclude("reward").set(entries.ACTION, torch.zeros(2, 6, 2))
        assert env.simulation_state()["progress", "counted"].tolist() == [1, 1]


def test_first_episodes_that_are_cut_short_count_for_nothing(build):
    env = build("basic", ENABLED, ROUND, horizon=6, stagger=True, num_envs=16)
    td = env.reset()
    for _ in range(6):
        _, td = advance(env, td)
    state = env.simulation_state()["progress"]
    assert state["counting"].all()  # every first episode has ended
    assert not state["counted"].any()


@pytest.mark.parametrize("dense", [False, True], ids=["rows", "all rows"])
def test_environments_behind_the_leading_ones_draw_whole_scenes_of_lower_difficulties(build, dense):
    env = build("wall", ENABLED, "task.curriculum.easier_share=0.5", num_envs=5, horizon=1)
    with force_dense() if dense else nullcontext():
        edit(env, lambda state: state["progress", "stage"].fill_(8))
        drawn, td = [], env.reset()
        for _ in range(12):  # too few episodes to settle a round
            drawn.append((td[entries.DIFFICULTY].squeeze(-1), td[entries.PRIVILEGED][:, 3]))
            _, td = advance(env, td)
    difficulty, side = (torch.stack(values) for values in zip(*drawn, strict=True))
    assert torch.allclose(difficulty[:, :3], torch.tensor(0.8))
    behind = difficulty[:, 3:]
    assert torch.equal(behind[:, 0], behind[:, 1])  # these begin in the same step
    assert len(behind.unique()) == len(drawn)
    assert behind.min() < 0.2 < 0.6 < behind.max() < 0.8
    assert torch.allclose(side, 0.6 - 0.3 * difficulty)


def test_only_leading_environments_decide_on_the_stage(build):
    def stage_after(successes):
        env = build("wall", ENABLED, ROUND, "task.curriculum.easier_share=0.5", horizon=1)
        td = env.reset()
        for _ in range(2):  # a round is two episodes of each of two environments
            put_targets_at_the_tips(env, successes)
            _, td = advance(env, td)
        return env.simulation_state()["progress", "stage"].tolist()

    assert stage_after([0, 1]) == [1] * 4
    assert stage_after([0, 2, 3]) == [0] * 4


@pytest.mark.parametrize("task", ["basic", "wall"])
def test_a_partial_reset_at_another_difficulty_changes_no_bit_of_the_others(build, task):
    def episode(reset):
        env = build(task, ENABLED, substeps=10)
        td = env.reset()
        for step, action in enumerate(actions(env, 4)):
            td = env.step(td.clone().set(entries.ACTION, action))["next"].exclude("reward")
            if reset and step == 1:
                edit(env, lambda state: state["progress", "stage"].fill_(7))
                td = env.reset(td.set("_reset", torch.tensor([[False], [True], [False], [False]])))
        return td

    undisturbed, disturbed = leaves(episode(False)), leaves(episode(True))
    others = [0, 2, 3]
    for key, value in undisturbed.items():
        assert torch.equal(value[others], disturbed[key][others]), key
    assert undisturbed[entries.DIFFICULTY].squeeze(-1).tolist() == [0.0] * 4
    assert torch.allclose(disturbed[entries.DIFFICULTY].squeeze(-1), torch.tensor([0.0, 0.7, 0.0, 0.0]))


def test_a_curriculum_goes_on_bit_for_bit_from_its_saved_state(build):
    env = build("wall", ENABLED, ROUND, "task.curriculum.demote=0.0", horizon=3)
    td = env.reset()
    for step in range(5):
        if step == 2:
            put_targets_at_the_tips(env, [0, 1, 2])
        _, td = advance(env, td)
    assert td[entries.DIFFICULTY].max() > 0.0
    state, generator = env.simulation_state(), env.generator_state()

    def finish(env, td):
        frames = []
        for step in range(8):
            if step == 3:
                put_targets_at_the_tips(env, [1, 2, 3])
            after, td = advance(env, td)
            frames += [leaves(after.clone()), leaves(td.clone())]
        return frames

    expected = finish(env, td)
    other = build("wall", ENABLED, ROUND, "task.curriculum.demote=0.0", horizon=3, seed=9)
    other.reset()
    other.load_simulation_state(state)
    other.set_generator_state(generator)
    assert_same_bits(expected, finish(other, td))
    assert expected[-1][entries.DIFFICULTY].max() > expected[0][entries.DIFFICULTY].max()


@pytest.mark.parametrize("task", TASKS)
def test_nothing_waits_for_a_device(build, task):
    env = build(task, ENABLED, ROUND, "task.curriculum.demote=0.0", horizon=2, stagger=True)
    td = env.reset()
    with force_dense():
        advance(env, td)  # constants are copied once
        prepared = [td.clone().set(entries.ACTION, action) for action in actions(env, 6)]
        env.backend.control_step = lambda state, *_, **__: state.clone()  # the CPU's kernel looks at values
        with RoundTrips() as trips:
            for td in prepared:
                env.step_and_maybe_reset(td)
    assert trips.found == []
