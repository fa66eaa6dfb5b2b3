"""Tasks whose obstacles move: how they do, and what agents learn of it."""

import math
from itertools import pairwise

import pytest
import torch
from hypothesis import given
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st

from every_task import MOVING
from softgm_bench.envs import entries, make_env
from softgm_bench.envs.tasks import make_task
from softgm_bench.rod.parameters import RodParameters

pytestmark = pytest.mark.usefixtures("one_thread")

DT = RodParameters().control_dt
SMALL = RodParameters(n_elements=12, substeps=4)
SEEDS = st.integers(0, 2**32 - 1)


def draw(config, count=8, seed=0):
    task = make_task(config)
    return task, task.sample(count, torch.Generator().manual_seed(seed))


@given(seed=SEEDS, speed=st.floats(0.0, 0.5))
@hypothesis_settings(max_examples=20, deadline=None)
def test_a_wall_slides_as_a_whole_at_one_speed_and_turns_back_where_its_openings_range_ends(settings, seed, speed):
    config = settings("task=wall_sliding", f"task.slide_speed={speed}").task
    task, scene = draw(config, seed=seed)
    first, step = scene, torch.zeros(8, dtype=torch.int64)
    low, high = config.opening_y
    for _ in range(60):
        then, scene = scene, task.advance(scene, step, DT)
        assert ((scene.privileged[:, 1] >= low) & (scene.privileged[:, 1] <= high)).all()
        assert torch.equal(scene.privileged[:, 4].abs(), torch.full((8,), speed, dtype=torch.float64))
        way = scene.privileged[:, 1] - then.privileged[:, 1]
        straight = torch.equal(scene.privileged[:, 4], then.privileged[:, 4])
        assert (way.abs() <= speed * DT + 1e-12).all()
        assert not straight or torch.allclose(way, scene.privileged[:, 4] * DT, atol=1e-12)
    away = scene.cylinders.start - first.cylinders.start
    moved = (scene.privileged[:, 1] - first.privileged[:, 1])[:, None]
    torch.testing.assert_close(away[..., 1], moved.expand_as(away[..., 1]), rtol=0.0, atol=1e-12)
    assert not away[..., [0, 2]].any()
    for unchanged in ("axis", "length", "radius", "mask"):
        assert torch.equal(getattr(scene.cylinders, unchanged), getattr(first.cylinders, unchanged))


def test_walls_begin_in_both_directions_and_stay_in_the_way(settings):
    config = settings("task=wall_sliding").task
    _, scene = draw(config, 200)
    assert 60 < (scene.privileged[:, 4] > 0).sum() < 140
    # wherever the opening goes, columns reach as far to both sides as those of the wall that stands still
    travel = config.opening_y[1] - config.opening_y[0]
    assert config.wall_y[0] + travel <= settings("task=wall").task.wall_y[0]
    assert config.wall_y[1] - travel >= settings("task=wall").task.wall_y[1]


@given(seed=SEEDS)
@hypothesis_settings(max_examples=10, deadline=None)
def test_posts_swing_as_sines_of_their_period_and_come_back(settings, seed):
    config = settings("task=swinging_posts").task
    task, scene = draw(config, seed=seed)
    frequency, first = 2.0 * math.pi / config.swing_period, scene
    rest = torch.tensor([-config.post_y, config.post_y], dtype=torch.float64)
    steps = 125
    for _ in range(steps):
        scene = task.advance(scene, torch.zeros(8, dtype=torch.int64), config.swing_period / steps)
        away, rate = scene.cylinders.start[..., 1] - rest, scene.privileged[:, 6:]
        amplitude = (away.square() + (rate / frequency).square()).sqrt()
        torch.testing.assert_close(amplitude, torch.full_like(amplitude, config.swing_amplitude), rtol=1e-11, atol=0.0)
        middle = scene.privileged[:, :6].unflatten(1, (2, 3))
        assert torch.equal(middle[..., 1], scene.cylinders.start[..., 1])
    torch.testing.assert_close(scene.cylinders.start, first.cylinders.start, rtol=0.0, atol=1e-12)
    assert draw(config, 200)[1].cylinders.start[..., 1].std(dim=0).min() > 0.5 * config.swing_amplitude


@pytest.mark.parametrize("task", MOVING)
def test_obstacles_move_while_an_episode_is_under_way_and_rest_when_it_has_ended(settings, task):
    env = make_env(settings(f"task={task}").task, SMALL, 3, seed=0, horizon=4, backend="torch")
    td, places = env.reset(), []
    for _ in range(6):
        places.append(env.scene.cylinders.start.clone())
        td = env.step(td.set(entries.ACTION, torch.zeros(3, 6, 2)))["next"]
        privileged = env.scene.privileged.to(torch.float32)
        assert torch.equal(td[entries.PRIVILEGED], privileged)
    for before, after in pairwise(places[:5]):
        assert ((after - before).abs().amax(dim=(1, 2)) > 0.0).all()
    assert torch.equal(places[4], places[5])


def test_a_wall_that_slides_at_speed_zero_is_one_that_stands_still_bit_for_bit(settings):
    """Near enough to be touched at once."""
    near = ("task.wall_x=0.08", "task.wall_y=[-1.0,1.0]")
    frames = {}
    for task, more in {"wall": (), "wall_sliding": ("task.slide_speed=0.0",)}.items():
        env = make_env(settings(f"task={task}", *near, *more).task, SMALL, 2, seed=0, backend="torch")
        td, told = env.reset(), []
        for k in range(8):
            action = torch.full((2, 6, 2), 0.5 - 0.1 * k)
            td = env.step(td.set(entries.ACTION, action))["next"]
            told.append(td.clone())  # the next step writes into it
        frames[task] = torch.stack(told).exclude(entries.PRIVILEGED)
        assert td[entries.CONTACT_NODES].any()
        assert td[entries.SLOT_ACTIVE].any()
    still, sliding = frames["wall"], frames["wall_sliding"]
    for key in still.keys(include_nested=True, leaves_only=True):
        assert torch.equal(sliding[key], still[key]), key


def test_bins_keep_their_slots_and_are_shown_as_they_were_last_sensed(settings):
    config = settings("task=wall_sliding", "task.sensing_radius=0.4").task
    env = make_env(config, SMALL, 2, seed=0, backend="torch")
    env.reset()
    simulator, active = env.simulator, torch.ones(2, dtype=torch.bool)
    episodes = simulator.state.episodes
    found, bins = episodes.table.bin_of_slot.clone(), episodes.bins.descriptor.clone()
    shown = episodes.shown.clone()
    assert (found >= 0).any()
    simulator._move_cylinders(episodes, active)
    moved = simulator.sense(episodes)
    assert torch.equal(moved.table.bin_of_slot[found >= 0], found[found >= 0])
    sensed = moved.edge.any(dim=1)
    assert sensed.any()
    index = found.clamp(min=0)[..., None].expand(-1, -1, 9)
    present = episodes.bins.descriptor.gather(1, index).float()
    assert torch.equal(moved.descriptor[sensed & (found >= 0)], present[sensed & (found >= 0)])
    assert not torch.equal(episodes.bins.descriptor, bins)
    episodes.rod.position = episodes.rod.position + 5.0  # where nobody senses anything
    simulator._move_cylinders(episodes, active)
    unseen = simulator.sense(episodes)
    assert not unseen.edge.any()
    assert torch.equal(unseen.descriptor, shown)
    assert torch.equal(unseen.active, found >= 0)


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (("task=wall_sliding", "task.slide_speed=-0.1"), "task.slide_speed is -0.1"),
        (("task=swinging_posts", "task.swing_amplitude=0.11"), "where the posts would meet"),
        (("task=swinging_posts", "task.swing_period=0.0"), "task.swing_period is 0.0"),
    ],
)
def test_motions_that_make_no_sense_are_refused_in_one_line(settings, overrides, message):
    with pytest.raises(Exception, match=message) as refusal:
        settings(*overrides)
    assert "\n" not in str(refusal.value)
