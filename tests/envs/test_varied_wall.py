"""Walls that move, turn, have a dead end, and whose targets say nothing about the opening."""

import dataclasses
import math

import pytest
import torch

from every_task import FELT
from softgm_bench.envs.tasks import make_task
from softgm_bench.rod.contact_nodes import point_segment_distance

COUNT = 2000


@pytest.fixture
def draw(settings):
    def sample(name, count=COUNT, seed=0, **changes):
        task = make_task(dataclasses.replace(settings(f"task={name}").task, **changes))
        return task, task.sample(count, torch.Generator().manual_seed(seed))

    return sample


def in_wall(scene, points):
    """Places along the wall, behind its plane and heights of points ``(count, n, 3)``, seen from the opening."""
    opening = scene.privileged[:, None, :3]
    yaw = scene.privileged[:, 4:5] if scene.privileged.shape[1] > 4 else torch.zeros(len(opening), 1)
    x, y, z = (points - opening).unbind(-1)
    return y * yaw.cos() - x * yaw.sin(), x * yaw.cos() + y * yaw.sin(), z


@pytest.mark.parametrize("name", FELT)
def test_the_target_says_nothing_about_the_opening(draw, name):
    _, scene = draw(name)
    opening, target = scene.privileged[:, 1:3], scene.target
    powers = (torch.ones(COUNT, 1, dtype=target.dtype), target, target.square(), target[:, :2] * target[:, 1:])
    design = torch.cat(powers, dim=-1)
    rest = opening - design @ torch.linalg.lstsq(design, opening).solution
    explained = 1.0 - rest.var(dim=0) / opening.var(dim=0)
    assert (explained < 0.02).all()  # 9 numbers fitted to 2000 values of chance explain 0.005


@pytest.mark.parametrize("name", FELT)
def test_every_target_of_the_box_can_be_reached_through_every_opening(draw, name):
    task, scene = draw(name)
    opening, other = scene.privileged[:, :3], scene.target.roll(1, dims=0)
    way = opening.norm(dim=-1) + (other - opening).norm(dim=-1)
    assert (way <= task.config.max_path).all()
    assert way.max() > 0.9 * task.config.max_path


@pytest.mark.parametrize("name", FELT)
def test_the_opening_is_free_and_the_rest_of_the_wall_is_closed(draw, name):
    task, scene = draw(name, 300)
    c, side = task.config, task.config.opening_side
    grid = torch.linspace(-0.5, 0.5, 41, dtype=torch.float64)
    along, height = (values.flatten() for values in torch.meshgrid(grid, grid, indexing="ij"))
    yaw = scene.privileged[:, 4:5] if c.wall_yaw else torch.zeros(300, 1, dtype=torch.float64)
    offset = torch.stack([-along * yaw.sin(), along * yaw.cos(), height.expand(300, -1)], dim=-1)
    point = scene.privileged[:, None, :3] + offset  # in the plane
    cylinders = scene.cylinders
    distance = point_segment_distance(
        point.unsqueeze(1), cylinders.start.unsqueeze(2), cylinders.axis.unsqueeze(2), cylinders.length.unsqueeze(2)
    )
    blocked = ((distance < cylinders.radius.unsqueeze(2) + 1e-9) & cylinders.mask.unsqueeze(2)).any(dim=1)
    # the columns beside the cut ones reach half a spacing into the opening, ends a column's radius
    inner = (along.abs() < 0.5 * side - c.column_radius) & (height.abs() < 0.5 * side - c.column_radius)
    assert not blocked[:, inner].any()
    outer = (along.abs() > 0.5 * side + c.column_spacing) | (height.abs() > 0.5 * side + 1e-6)
    at = (scene.privileged[:, 1:2] + along).abs() < 0.5  # on the wall
    if c.dead_end is None:
        assert blocked[:, outer][at[:, outer]].all()
    elif c.dead_end < c.column_radius:  # columns stand in the other hole; between them is no room for an arm
        tight = ((distance < cylinders.radius.unsqueeze(2) + 0.05) & cylinders.mask.unsqueeze(2)).any(dim=1)
        assert tight[:, outer][at[:, outer]].all()
        assert not tight[:, (along.abs() < 0.25 * side) & (height.abs() < 0.25 * side)].any()
    else:  # there is one more hole, with columns behind it
        assert (~blocked & outer & at).any(dim=1).all()


def test_the_plane_moves_and_turns_within_its_ranges(draw):
    task, scene = draw("wall_search")
    c, wall = task.config, scene.cylinders
    n = len(task.column_y)
    first, last = wall.start[:, 0, :2], wall.start[:, n - 1, :2]
    yaw = torch.atan2(first[:, 0] - last[:, 0], last[:, 1] - first[:, 1])
    assert torch.allclose(yaw, scene.privileged[:, 4])
    assert math.radians(c.wall_yaw) * 0.95 < yaw.abs().max() <= math.radians(c.wall_yaw)
    middle = 0.5 * (first + last)  # wall_y is symmetric, but its last column may not be
    x = middle[:, 0] - (0.0 - middle[:, 1]) * torch.tan(yaw)
    assert (x - c.wall_x).abs().max() <= c.wall_x_spread + 1e-9
    assert (x - c.wall_x).abs().max() > 0.9 * c.wall_x_spread
    along, depth, _ = in_wall(scene, wall.start[:, :n])
    assert depth.abs().max() < 1e-9
    assert torch.allclose(along.diff(dim=1), torch.tensor(c.column_spacing, dtype=torch.float64))


def test_the_dead_end_is_on_either_side_and_closed_on_all_sides(draw):
    task, scene = draw("wall_decoy")
    c, n, wall = task.config, len(task.column_y), scene.cylinders
    closing = slice(n, n + task.closing)
    assert wall.mask[:, closing].all()
    start, length = wall.start[:, closing], wall.length[:, closing]
    assert torch.allclose(start[..., 0], torch.tensor(c.wall_x + c.dead_end, dtype=torch.float64))
    other_y, other_z = start[..., 1].mean(dim=1), (start[..., 2] + 0.5 * length).mean(dim=1)
    opening = scene.privileged[:, :3]
    apart = (other_y - opening[:, 1]).abs()
    assert apart.min() >= c.opening_side + c.column_spacing - 1e-9
    assert 0.4 < (other_y > 0.0).double().mean() < 0.6
    assert (other_y * opening[:, 1] < 0.0).all()
    # both openings come from one distribution
    for ours, theirs in ((opening[:, 1].abs(), other_y.abs()), (opening[:, 2], other_z)):
        assert (ours.mean() - theirs.mean()).abs() < 5.0 * ours.std() / COUNT**0.5
    # both holes are cut, and the closing columns reach beyond the hole on all sides by more than they leave open
    n_cut = (wall.length[:, :n] < wall.length[:, :n].amax(dim=1, keepdim=True) - 1e-9).sum(dim=1)
    assert n_cut.min() >= 6
    reach_y = start[..., 1].amax(dim=1) - other_y + c.column_radius
    assert (reach_y >= 0.5 * c.opening_side + c.column_spacing - 1e-9).all()
    assert torch.allclose(length, torch.tensor(c.opening_side + 2.0 * c.column_spacing, dtype=torch.float64))
    gap = c.dead_end - 2.0 * c.column_radius
    assert gap < 0.05  # half of the arm's diameter
    # no column that closes it stands in the other opening or on a target
    assert ((start[..., 1] - opening[:, None, 1]).abs() >= 0.5 * c.opening_side - 1e-9).all()
    assert c.target_x[0] - c.wall_x - c.dead_end - c.column_radius >= 0.05 - 1e-9


def test_scenes_get_easier_with_less_difficulty_and_are_the_tasks_own_at_one(settings):
    for name in FELT:
        task = make_task(settings(f"task={name}", "task.curriculum.enabled=true").task)

        def scenes(difficulty, task=task):
            value = None if difficulty is None else torch.tensor(difficulty, dtype=torch.float64)
            return task.sample(200, torch.Generator().manual_seed(1), value)

        own, last, first = scenes(None), scenes(1.0), scenes(0.0)
        assert torch.equal(own.target, last.target)
        assert torch.equal(own.privileged, last.privileged)
        assert (first.privileged[:, 3] == task.config.curriculum.easy_opening_side).all()
        assert torch.allclose(first.target[:, 1:], first.privileged[:, 1:3])  # straight behind


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"wall_x_spread": -0.1}, "task.wall_x_spread"),
        ({"wall_x_spread": 0.4}, "task.wall_x_spread"),
        ({"wall_yaw": 90.0}, "task.wall_yaw"),
        ({"dead_end": 0.0}, "task.dead_end"),
        ({"opening_y": (-0.1, 0.1)}, "task.opening_y"),
        ({"max_contact_steps": -1}, "task.max_contact_steps"),
        ({"friction_coefficient": -0.5}, "task.friction_coefficient"),
    ],
)
def test_values_that_describe_no_wall_are_refused(settings, changes, message):
    with pytest.raises(ValueError, match=message):
        dataclasses.replace(settings("task=wall_decoy").task, **changes)


def test_an_easy_opening_beside_whose_dead_end_an_arm_could_pass_is_refused(settings):
    config = settings("task=wall_decoy", "task.curriculum.enabled=true").task
    with pytest.raises(ValueError, match="pass beside the dead end"):
        dataclasses.replace(
            config,
            opening_y=(-0.5, 0.5),
            curriculum=dataclasses.replace(config.curriculum, easy_opening_side=0.4),
        )
