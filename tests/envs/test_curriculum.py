"""The rules by which a curriculum moves, and the scenes that it draws."""

import dataclasses
import math

import pytest
import torch
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from dense import force_dense
from every_task import TASKS
from softgm_bench.assembly import configure
from softgm_bench.envs.curriculum import (
    difficulty,
    first_progress,
    further_contact,
    note_ends,
    scene_difficulty,
    waived_cost,
)
from softgm_bench.envs.tasks import make_task
from softgm_bench.envs.tasks.base import CurriculumConfig, eased
from softgm_bench.errors import UserError

ENABLED = "task.curriculum.enabled=true"
FOUR = CurriculumConfig(
    enabled=True,
    stages=2,
    episodes=4,
    promote=0.6,
    demote=0.2,
    easier_share=0.0,
    easy_contact_steps=None,
    contact_stages=0,
    easy_lambda_c=None,
)


def level(value):
    return torch.tensor(value, dtype=torch.float64)


def flags(*values):
    return torch.tensor(values, dtype=torch.bool)


def play_round(progress, successes, config):
    """Every environment begins an episode and ends it, all in the same step."""
    progress.counting.fill_(True)
    return note_ends(progress, torch.ones_like(progress.counting), flags(*successes), config)


def stage_after(*rounds, config=FOUR):
    progress = first_progress(len(rounds[0]), torch.device("cpu"))
    for successes in rounds:
        progress = play_round(progress, successes, config)
    assert len(progress.stage.unique()) == 1
    return int(progress.stage[0])


# hand-computed decisions: four environments, promote above 0.6, demote below 0.2


def test_a_stage_rises_and_falls_by_one_between_the_easiest_and_the_tasks_own():
    won, split, lost = [True] * 3 + [False], [True] * 2 + [False] * 2, [False] * 4
    assert stage_after(won) == 1  # 0.75
    assert stage_after(split) == 0  # 0.5
    assert stage_after(won, split) == 1
    assert stage_after(won, lost) == 0
    assert stage_after(lost) == 0
    assert stage_after(won, won) == 2
    assert stage_after(won, won, won) == 2
    assert stage_after(won, won, won, lost) == 1


def test_a_share_equal_to_a_threshold_leaves_the_stage():
    exact = dataclasses.replace(FOUR, promote=0.75, demote=0.25)
    assert stage_after([True] * 3 + [False], config=exact) == 0
    assert stage_after([True] * 4, [True] + [False] * 3, config=exact) == 1


def test_difficulty_is_exactly_one_at_the_last_stage():
    config = dataclasses.replace(FOUR, stages=7)
    progress = first_progress(3, torch.device("cpu"))
    assert difficulty(progress, config).item() == 0.0
    progress.stage.fill_(7)
    assert difficulty(progress, config).item() == 1.0


def test_nothing_is_decided_while_episodes_under_way_can_change_it():
    progress = first_progress(4, torch.device("cpu"))
    progress.counting.fill_(True)
    always = flags(True, True, True, True)
    for _ in range(3):  # the quick ones end again and again, and count once
        progress = note_ends(progress, flags(True, True, False, False), always, FOUR)
        assert progress.counted.tolist() == [1, 1, 0, 0]
        assert progress.stage.tolist() == [0] * 4
    progress = note_ends(progress, flags(False, False, True, False), always, FOUR)  # 3 of 4 whatever the last one does
    assert progress.stage.tolist() == [1] * 4
    assert progress.counted.tolist() == progress.succeeded.tolist() == [0] * 4
    progress.counting.fill_(True)
    never = flags(False, False, False, False)
    progress = note_ends(progress, flags(True, True, True, False), never, FOUR)  # 1 of 4 is not below 0.2
    assert progress.stage.tolist() == [1] * 4
    progress = note_ends(progress, flags(False, False, False, True), never, FOUR)
    assert progress.stage.tolist() == [0] * 4


def test_an_episode_that_was_under_way_at_a_decision_counts_for_no_round():
    progress = play_round(first_progress(4, torch.device("cpu")), [True] * 4, FOUR)
    assert not progress.counting.any()
    progress = note_ends(progress, flags(True, True, False, False), flags(True, True, True, True), FOUR)
    assert progress.counted.tolist() == [0] * 4
    progress.counting[1] = True  # this one has begun anew
    progress = note_ends(progress, flags(True, True, False, False), flags(True, True, True, True), FOUR)
    assert progress.counted.tolist() == [0, 1, 0, 0]


def test_few_environments_count_several_episodes_each():
    config = dataclasses.replace(FOUR, episodes=5)  # of two environments: three each
    progress = first_progress(2, torch.device("cpu"))
    for successes, stage in (([True, False], 0), ([True, True], 0), ([True, False], 1)):  # 4 of 6 are 0.67
        progress = play_round(progress, successes, config)
        assert progress.stage.tolist() == [stage] * 2


def test_decisions_need_no_values_and_stay_on_their_device():
    """On the meta device a look at any value raises, and so does an operation between two devices."""
    meta = torch.device("meta")
    progress = first_progress(4, meta)
    progress = note_ends(progress, flags(*[True] * 4).to(meta), flags(*[True] * 4).to(meta), FOUR)
    assert {value.device.type for value in (progress.stage, progress.counting, progress.counted)} == {"meta"}
    assert {value.device.type for value in eased((0.0, 1.0), (2.0, 3.0), difficulty(progress, FOUR))} == {"meta"}


@given(
    num_envs=st.integers(1, 5),
    episodes=st.integers(1, 9),
    stages=st.integers(1, 3),
    easier=st.sampled_from([0.0, 0.25, 0.5, 0.9]),
    steps=st.lists(st.tuples(st.integers(0, 31), st.integers(0, 31)), max_size=60),
)
@hypothesis_settings(max_examples=60, deadline=None)
def test_any_course_of_events_is_decided_as_plain_counting_does(num_envs, episodes, stages, easier, steps):
    config = dataclasses.replace(FOUR, stages=stages, episodes=episodes, easier_share=easier)
    first = num_envs - int(easier * num_envs)  # the others count for nothing
    quota = math.ceil(episodes / first)
    progress = first_progress(num_envs, torch.device("cpu"))
    progress.counting.fill_(True)
    stage, counting, results = 0, [True] * num_envs, [[] for _ in range(num_envs)]
    for ends, wins in steps:
        ended = [bool(ends >> env & 1) for env in range(num_envs)]
        won = [bool(wins >> env & 1) for env in range(num_envs)]
        progress = note_ends(progress, flags(*ended), flags(*won), config)
        for env in range(first):
            if ended[env] and counting[env] and len(results[env]) < quota:
                results[env].append(won[env])
        every = [result for of_one in results for result in of_one]
        total = first * quota
        # whether the rest fails or succeeds
        worst, best = sum(every) / total, (total - len(every) + sum(every)) / total
        if worst > 0.6 or best < 0.2 or len(every) == total:
            stage = min(max(stage + (worst > 0.6) - (best < 0.2), 0), stages)
            counting, results = [False] * num_envs, [[] for _ in range(num_envs)]
        assert progress.stage.tolist() == [stage] * num_envs
        assert progress.counting.tolist() == counting
        assert progress.counted.tolist() == [len(of_one) for of_one in results]
        assert progress.succeeded.tolist() == [sum(of_one) for of_one in results]
        progress.counting.logical_or_(flags(*ended))  # they are reset
        counting = [a or b for a, b in zip(counting, ended, strict=True)]


# scenes

NUMBER = st.floats(-10.0, 10.0)


@given(easy=st.tuples(NUMBER, NUMBER), own=st.tuples(NUMBER, NUMBER), value=st.floats(0.0, 1.0))
@hypothesis_settings(max_examples=200, deadline=None)
def test_ranges_are_exact_at_both_ends_and_between_them_elsewhere(easy, own, value):
    def at(where):
        return [float(number) for number in eased(easy, own, where)]

    assert at(level(0.0)) == list(easy)
    assert at(level(1.0)) == at(None) == list(own)
    for found, first, last in zip(at(level(value)), easy, own, strict=True):
        assert min(first, last) <= found <= max(first, last)
        assert found == pytest.approx(first + value * (last - first), abs=1e-12)


@pytest.mark.parametrize("dense", [False, True], ids=["compiled", "dense"])
@pytest.mark.parametrize("name", TASKS)
def test_at_difficulty_one_scenes_are_the_tasks_own_bit_for_bit(settings, name, dense):
    own, eased = make_task(settings(f"task={name}").task), make_task(settings(f"task={name}", ENABLED).task)

    def draw():
        first, second = torch.Generator().manual_seed(5), torch.Generator().manual_seed(5)
        scenes = own.sample(300, first), eased.sample(300, second, level(1.0))
        assert torch.equal(first.get_state(), second.get_state())
        return scenes

    if dense:
        with force_dense():
            expected, found = draw()
    else:
        expected, found = draw()
    assert torch.equal(expected.target, found.target)
    assert torch.equal(expected.privileged, found.privileged)
    for field in ("start", "axis", "length", "radius", "mask"):
        value = getattr(found.cylinders, field)
        assert torch.equal(getattr(expected.cylinders, field), value[:, : own.max_cylinders]), field
    assert not found.cylinders.mask[:, own.max_cylinders :].any()


@pytest.mark.parametrize("name", TASKS)
def test_without_a_difficulty_an_enabled_curriculum_draws_the_tasks_own_scenes(settings, name):
    own, eased = make_task(settings(f"task={name}").task), make_task(settings(f"task={name}", ENABLED).task)
    expected, found = (task.sample(100, torch.Generator().manual_seed(2)) for task in (own, eased))
    assert torch.equal(expected.target, found.target)
    assert torch.equal(expected.cylinders.start, found.cylinders.start[:, : own.max_cylinders])
    assert torch.equal(expected.cylinders.length, found.cylinders.length[:, : own.max_cylinders])


@given(
    value=st.floats(0.0, 1.0),
    offset=st.sampled_from((0.0, 0.25, 1.0)),
    seed=st.integers(0, 2**32 - 1),
    name=st.sampled_from(("wall", "wall_narrow")),
)
@hypothesis_settings(max_examples=40, deadline=None)
def test_openings_lie_between_the_easiest_and_the_tasks_own_and_lead_to_targets_within_reach(
    settings, value, offset, seed, name
):
    config = settings(f"task={name}", ENABLED, f"task.curriculum.easy_target_offset={offset}").task
    easy = config.curriculum
    scene = make_task(config).sample(40, torch.Generator().manual_seed(seed), level(value))
    opening, side = scene.privileged[:, :3], scene.privileged[:, 3]
    expected = easy.easy_opening_side + value * (config.opening_side - easy.easy_opening_side)
    assert torch.allclose(side, torch.full_like(side, expected))
    assert ((side >= config.opening_side) & (side <= easy.easy_opening_side)).all()
    path = opening.norm(dim=-1) + (scene.target - opening).norm(dim=-1)
    assert (path <= config.max_path + 1e-12).all()
    for axis in (1, 2):
        low, high = (config.opening_y, config.opening_z)[axis - 1]
        assert ((opening[:, axis] >= low) & (opening[:, axis] <= high)).all()
        # no farther to the side of the opening than the difficulty's share of what the task allows
        spread = (scene.target - opening)[:, axis].abs()
        assert (spread <= (value + offset * (1.0 - value)) * (high - low) + 1e-12).all()
    low, high = ((1.0 - value) * a + value * b for a, b in zip(easy.easy_target_x, config.target_x, strict=True))
    assert ((scene.target[:, 0] >= low - 1e-12) & (scene.target[:, 0] <= high + 1e-12)).all()
    _check_columns(scene, config)


def _check_columns(scene, config):
    """Every column of the wall stands once: whole, or as two parts around the opening if it meets it."""
    standing = torch.linspace(-0.6, 0.6, 16, dtype=torch.float64)
    for env in range(5):
        y, z, side = scene.privileged[env, 1:].tolist()
        columns = scene.cylinders[env]
        exists = columns.mask
        start, length = columns.start[exists], columns.length[exists]
        top = start[:, 2] + length
        whole = torch.isclose(length, level(1.4))
        lower = ~whole & torch.isclose(start[:, 2], level(-0.2))
        upper = ~whole & ~lower
        assert torch.allclose(torch.cat([start[whole, 1], start[lower, 1]]).sort().values, standing)
        assert torch.equal(start[lower, 1].sort().values, start[upper, 1].sort().values)
        assert torch.allclose(top[lower], level(z - side / 2).expand(int(lower.sum())))
        assert torch.allclose(start[upper, 2], level(z + side / 2).expand(int(upper.sum())))
        assert torch.allclose(top[upper], level(config.wall_z[1]).expand(int(upper.sum())))
        cut = ((standing - y).abs() <= side / 2 + 1e-12).sum()
        assert lower.sum() == cut


@pytest.mark.parametrize("name", ["wall", "wall_sense"])
def test_the_easiest_targets_keep_the_share_of_their_offset_that_is_asked_for(settings, name):
    def easiest(offset):
        config = settings(f"task={name}", ENABLED, f"task.curriculum.easy_target_offset={offset}").task
        scene = make_task(config).sample(60, torch.Generator().manual_seed(3), level(0.0))
        return (scene.target - scene.privileged[:, :3])[:, 1:], config

    (none, config), (whole, _) = easiest(0.0), easiest(1.0)
    assert torch.equal(none, torch.zeros_like(none))
    for axis, (low, high) in enumerate((config.target_y, config.target_z)):
        assert whole[:, axis].std() > 0.2 * (high - low)


@pytest.mark.parametrize("name", ["wall", "wall_sense"])
def test_a_power_takes_targets_to_their_own_place_early_and_leaves_the_rest_of_the_scene_where_it_was(settings, name):
    def drawn(power, value):
        config = settings(f"task={name}", ENABLED, f"task.curriculum.target_power={power}").task
        return make_task(config).sample(40, torch.Generator().manual_seed(5), level(value))

    linear, cubic = (drawn(power, 0.5) for power in (1.0, 3.0))
    same = (cubic.privileged == linear.privileged).all(dim=-1)  # not drawn again for too long a way in either
    assert same.sum() > 20
    assert torch.equal(cubic.target[same, 0], linear.target[same, 0])
    offset, kept = ((scene.target - scene.privileged[:, :3])[same, 1:] for scene in (linear, cubic))
    assert torch.allclose(kept, (0.875 / 0.5) * offset)
    for value in (0.0, 1.0):
        assert torch.equal(drawn(3.0, value).target, drawn(1.0, value).target)


@given(value=st.floats(0.0, 1.0), seed=st.integers(0, 2**32 - 1))
@hypothesis_settings(max_examples=30, deadline=None)
def test_targets_of_the_other_tasks_fill_ranges_between_the_easiest_and_their_own(settings, value, seed):
    def between(easy, own):
        return ((1.0 - value) * a + value * b for a, b in zip(easy, own, strict=True))

    config = settings("task=basic", ENABLED).task
    target = make_task(config).sample(60, torch.Generator().manual_seed(seed), level(value)).target
    distance = target.norm(dim=-1)
    polar = torch.rad2deg(torch.acos(target[:, 2] / distance))
    for found, easy, own in (
        (distance, config.curriculum.easy_target_distance, config.target_distance),
        (polar, config.curriculum.easy_target_polar_angle, config.target_polar_angle),
    ):
        low, high = between(easy, own)
        assert ((found >= low - 1e-9) & (found <= high + 1e-9)).all()
        assert found.max() - found.min() > 0.3 * (high - low)
    assert ((target - torch.tensor(config.resting_tip)).norm(dim=-1) >= config.min_distance_to_resting_tip - 1e-9).all()

    config = settings("task=structured", ENABLED).task
    target = make_task(config).sample(60, torch.Generator().manual_seed(seed), level(value)).target
    for axis, name in enumerate(("target_x", "target_y", "target_z")):
        low, high = between(getattr(config.curriculum, f"easy_{name}"), getattr(config, name))
        found = target[:, axis]
        assert ((found >= low - 1e-12) & (found <= high + 1e-12)).all()
        assert found.max() - found.min() > 0.5 * (high - low)


@hypothesis_settings(max_examples=100, deadline=None)
@given(st.integers(1, 60), st.data())
def test_the_last_stages_lower_the_limit_of_contact_alone_where_the_settings_say_so(stages, data):
    last = data.draw(st.integers(0, stages - 1))
    task = configure(["task=wall_touch", ENABLED]).task  # 10 steps in contact
    curriculum = dataclasses.replace(task.curriculum, stages=stages, contact_stages=last, easy_contact_steps=40)
    task = dataclasses.replace(task, curriculum=curriculum)
    for stage in range(stages + 1):
        progress = first_progress(1, torch.device("cpu"))
        progress.stage.fill_(stage)
        now = difficulty(progress, curriculum)
        scenes, left = scene_difficulty(now, curriculum).item(), further_contact(now, task).item()
        assert scenes == pytest.approx(min(1.0, stage / (stages - last)), abs=1e-9)
        assert (scenes == 1.0) is (stage >= stages - last)
        assert left == pytest.approx(30 * min(1.0, (stages - stage) / (last or stages)), abs=0.5 + 1e-9)
        assert last == 0 or stage >= stages - last or left == 30
    assert left == 0


@pytest.mark.parametrize("last", [0, 2])
def test_what_contact_costs_rises_to_the_tasks_own_with_what_it_is_limited_to(last):
    task = configure(["task=wall_touch", ENABLED, "task.reward.lambda_c=-5"]).task
    curriculum = dataclasses.replace(task.curriculum, stages=4, contact_stages=last, easy_contact_steps=110)
    assert waived_cost(level(0.5), dataclasses.replace(task, curriculum=curriculum)) is None
    task = dataclasses.replace(task, curriculum=dataclasses.replace(curriculum, easy_lambda_c=-1.0))
    for stage in range(5):
        now = level(stage / 4)
        assert waived_cost(now, task).item() == pytest.approx(4.0 * further_contact(now, task).item() / 100, abs=0.021)
    assert waived_cost(level(1.0), task) == 0.0


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("task.curriculum.stages=0", r"task.curriculum.stages is 0"),
        ("task.curriculum.episodes=0", r"task.curriculum.episodes is 0"),
        ("task.curriculum.promote=0.1", r"task.curriculum.demote is 0.2, task.curriculum.promote 0.1"),
        ("task.curriculum.promote=1.0", r"task.curriculum.promote 1.0"),
        ("task.curriculum.demote=-0.1", r"task.curriculum.demote is -0.1"),
        ("task.curriculum.easier_share=1.0", r"task.curriculum.easier_share is 1.0: it must be at least 0 and below 1"),
        ("task.curriculum.easier_share=-0.1", r"task.curriculum.easier_share is -0.1"),
        (
            "task.curriculum.easy_contact_steps=3",
            r"task.curriculum.easy_contact_steps is 3, task.max_contact_steps None",
        ),
        (
            "task.curriculum.contact_stages=10",
            r"task.curriculum.contact_stages is 10: .* below task.curriculum.stages, 10",
        ),
        ("task.curriculum.contact_stages=-1", r"task.curriculum.contact_stages is -1"),
        ("task.curriculum.contact_stages=4", r"contact_stages is 4: without task.curriculum.easy_contact_steps"),
        (
            "task.curriculum.easy_lambda_c=-0.5",
            r"task.curriculum.easy_lambda_c is -0.5, task.reward.lambda_c -0.01: contact costs no more",
        ),
        ("task.curriculum.easy_opening_side=0.2", r"task.curriculum.easy_opening_side is 0.2"),
        ("task.curriculum.easy_target_offset=1.5", r"task.curriculum.easy_target_offset is 1.5: it must lie between"),
        ("task.curriculum.target_power=0.0", r"task.curriculum.target_power is 0.0: it must be above 0"),
        ("task.curriculum.easy_opening_side=1.2", r"with task.curriculum.easy_opening_side 1.2"),
    ],
)
def test_values_by_which_nothing_could_be_decided_or_drawn_are_refused(override, message):
    with pytest.raises(UserError, match=message):
        configure(["task=wall", ENABLED, override])


def test_columns_of_a_wide_opening_are_never_dropped_unnoticed(settings):
    with pytest.raises(ValueError, match="enabled is false"):
        make_task(settings("task=wall").task).sample(2, torch.Generator(), level(0.0))
