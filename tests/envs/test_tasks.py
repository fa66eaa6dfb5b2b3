import dataclasses
import math

import pytest
import torch

from dense import force_dense
from every_task import TASKS
from softgm_bench.envs.tasks import make_task
from softgm_bench.envs.tasks.base import first_accepted

COUNT = 500


@pytest.fixture
def draw(settings):
    def sample(name: str, *overrides: str, seed: int = 0):
        config = settings(f"task={name}", *overrides).task
        task = make_task(config)
        return config, task, task.sample(COUNT, torch.Generator().manual_seed(seed))

    return sample


@pytest.mark.parametrize("name", TASKS)
def test_same_seed_draws_the_same_scenes_and_another_seed_others(draw, name):
    _, _, first = draw(name)
    _, _, again = draw(name)
    _, _, other = draw(name, seed=1)
    assert torch.equal(first.target, again.target)
    assert torch.equal(first.cylinders.start, again.cylinders.start)
    assert not torch.equal(first.target, other.target)


def test_basic_targets_fill_the_shell_of_the_specification(draw):
    _, task, scene = draw("basic")
    distance = scene.target.norm(dim=-1)
    polar = torch.rad2deg(torch.acos(scene.target[:, 2] / distance))
    azimuth = torch.atan2(scene.target[:, 1], scene.target[:, 0])
    assert ((distance >= 0.55) & (distance <= 0.9)).all()
    assert ((polar >= 20.0) & (polar <= 100.0)).all()
    assert ((scene.target - torch.tensor([0.0, 0.0, 1.0])).norm(dim=-1) >= 0.15).all()
    assert distance.min() < 0.57
    assert distance.max() > 0.88
    assert azimuth.min() < -0.95 * math.pi
    assert azimuth.max() > 0.95 * math.pi
    assert task.max_cylinders == scene.cylinders.mask.shape[1] == 0


def test_structured_posts_stand_where_the_specification_says(draw):
    _, _, scene = draw("structured")
    posts = scene.cylinders
    assert posts.mask.all()
    for index, y in enumerate((-0.16, 0.16)):
        assert torch.equal(posts.start[:, index], torch.tensor([0.35, y, -0.2], dtype=torch.float64).expand(COUNT, 3))
    assert torch.allclose(posts.length, torch.tensor(1.2, dtype=torch.float64))
    assert (posts.radius == 0.05).all()
    low, high = torch.tensor([0.5, -0.3, 0.2]), torch.tensor([0.75, 0.3, 0.6])
    assert ((scene.target >= low) & (scene.target <= high)).all()


@pytest.mark.parametrize("name", ["wall", "wall_narrow", "wall_fixed"])
def test_wall_columns_touch_each_other_and_are_cut_at_the_opening_only(draw, name):
    config, _, scene = draw(name)
    c = scene.cylinders
    column_y = torch.linspace(-0.6, 0.6, 16, dtype=torch.float64)
    for env in range(50):
        mask = c.mask[env]
        start, length = c.start[env, mask], c.length[env, mask]
        top = start[:, 2] + length
        assert torch.allclose(start[:, 0], torch.tensor(0.4, dtype=torch.float64))
        whole = torch.isclose(length, torch.tensor(1.4, dtype=torch.float64))
        lower = ~whole & torch.isclose(start[:, 2], torch.tensor(-0.2, dtype=torch.float64))
        upper = ~whole & torch.isclose(top, torch.tensor(1.2, dtype=torch.float64))
        assert (whole | lower | upper).all()
        # every column is there once: whole, or as a lower and an upper part
        assert torch.equal(start[lower, 1].sort().values, start[upper, 1].sort().values)
        standing = torch.cat([start[whole, 1], start[lower, 1]]).sort().values
        assert torch.allclose(standing, column_y)
        # the parts leave a gap of the opening's side around one centre
        gap_low, gap_high = top[lower], start[upper, 2]
        assert torch.allclose(gap_high - gap_low, torch.full_like(gap_low, config.opening_side))
        assert lower.sum() in (3, 4)
        assert start[lower, 1].max() - start[lower, 1].min() <= config.opening_side + 1e-9
    if name == "wall_fixed":
        assert torch.equal(c.start, c.start[:1].expand_as(c.start))
    else:
        assert not torch.equal(c.start, c.start[:1].expand_as(c.start))


def test_wall_targets_can_be_reached_through_the_opening(draw):
    config, task, _ = draw("wall")
    scene = task.sample(COUNT, torch.Generator().manual_seed(3))
    c = scene.cylinders
    cut = c.mask & (c.length < 1.4 - 1e-9)
    lower = cut & torch.isclose(c.start[..., 2], torch.tensor(-0.2, dtype=torch.float64))
    opening_z = (c.start[..., 2] + c.length)[lower.cumsum(1).eq(1) & lower] + 0.5 * config.opening_side
    # the opening's y is known to half a spacing from the columns it cuts
    opening_y = (c.start[..., 1] * lower).sum(1) / lower.sum(1)
    opening = torch.stack([torch.full_like(opening_z, 0.4), opening_y, opening_z], dim=-1)
    path = opening.norm(dim=-1) + (scene.target - opening).norm(dim=-1)
    assert (path <= config.max_path + 0.08).all()
    assert ((scene.target[:, 0] >= 0.5) & (scene.target[:, 0] <= 0.6)).all()
    assert opening_z.max() - opening_z.min() > 0.1


def test_ranges_that_leave_nothing_are_refused(settings):
    config = settings("task=wall").task
    with pytest.raises(ValueError, match="no admissible"):
        make_task(dataclasses.replace(config, max_path=0.1)).sample(3, torch.Generator())
    with pytest.raises(ValueError, match=r"task.opening_z"):
        make_task(dataclasses.replace(config, opening_side=2.0))


@pytest.mark.parametrize("name", ["basic", "wall"])
def test_scenes_drawn_without_a_look_at_values_are_admissible_and_as_varied(draw, name):
    config, task, scene = draw(name)
    with force_dense():
        blind = task.sample(COUNT, torch.Generator().manual_seed(0))
        again = task.sample(COUNT, torch.Generator().manual_seed(0))
    assert torch.equal(blind.target, again.target)
    assert len(blind.target.unique(dim=0)) == COUNT
    # two samples of one distribution: means differ by a few standard errors at most
    error = scene.target.std(dim=0) / COUNT**0.5
    assert ((blind.target.mean(dim=0) - scene.target.mean(dim=0)).abs() < 6.0 * error).all()
    if name == "basic":
        tip = torch.tensor(config.resting_tip, dtype=torch.float64)
        assert ((blind.target - tip).norm(dim=-1) >= config.min_distance_to_resting_tip).all()


def test_rejection_without_a_look_keeps_the_order_of_what_is_accepted():
    values = torch.arange(5000.0)
    found = first_accepted(lambda n: values[:n], lambda x: x % 7 == 3, 6)
    assert found.tolist() == [3.0, 10.0, 17.0, 24.0, 31.0, 38.0]
    # two accepted values for five rows are shared
    assert first_accepted(lambda n: values[:n], lambda x: (x == 5) | (x == 9), 5).tolist() == [5.0, 9.0, 5.0, 9.0, 5.0]
