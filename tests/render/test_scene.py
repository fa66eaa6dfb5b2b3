import dataclasses

import numpy as np
import pytest
from arms import POST_RADIUS, STEPS, bending_arm

from softgm_bench.render import style
from softgm_bench.render.scene import FAINT, SEEN_THROUGH, Stage
from softgm_bench.render.shading import ARM, CYLINDER, MARK, texture_at


def colour_on_post(stage, step, height):
    """Colour of the first post at a height above its lower end, m."""
    drawing = stage.draw(step)
    post = int(np.flatnonzero(drawing.owner == CYLINDER)[0])
    return np.array(texture_at(drawing, post, height / 1.2))


def test_a_bin_changes_its_colour_when_it_is_discovered_and_keeps_it():
    stage = Stage(bending_arm())
    plain, second = style.linear(style.COLUMN), 0.075
    np.testing.assert_allclose(colour_on_post(stage, 0.9, second)[:3], plain)
    np.testing.assert_allclose(colour_on_post(stage, 1.0, second)[:3], style.linear(style.NEW), atol=1e-9)
    assert np.abs(colour_on_post(stage, float(STEPS), second)[:3] - plain).max() > 0.1
    np.testing.assert_allclose(colour_on_post(stage, float(STEPS), 0.175)[:3], plain)  # never discovered


def test_posts_are_opaque_and_walls_are_seen_through():
    episode = bending_arm()
    assert colour_on_post(Stage(episode), 3.0, 0.5)[3] == 1.0
    many = {name: np.repeat(values, 6, axis=0) for name, values in episode.cylinders.items()}
    object.__setattr__(episode, "cylinders", many)
    assert colour_on_post(Stage(episode), 3.0, 0.5)[3] == pytest.approx(SEEN_THROUGH)


def test_posts_that_move_are_drawn_where_they_are_and_their_bins_stay_on_them():
    still = bending_arm()
    shift = np.linspace(0.0, 0.3, STEPS + 1)[:, None, None] * [0.0, 1.0, 0.0]
    seen = dict(still.observation)
    seen["slots/descriptor"] = seen["slots/descriptor"].copy()
    seen["slots/descriptor"][..., :3] += shift
    cylinders = still.cylinders | {"path": still.cylinders["start"] + shift}
    moving = dataclasses.replace(still, cylinders=cylinders, observation=seen)
    stage = Stage(moving)
    for step, away in ((0.0, 0.0), (2.5, 0.125), (float(STEPS), 0.3)):
        drawing = stage.draw(step)
        feet = drawing.cone[drawing.owner == CYLINDER, :3]
        np.testing.assert_allclose(feet, still.cylinders["start"] + [0.0, away, 0.0], atol=1e-12)
    for found, expected in zip(stage.first_seen, Stage(still).first_seen, strict=True):
        np.testing.assert_array_equal(found, expected)
    assert stage.extent()[:, 1].max() == pytest.approx(0.2 + 0.3 + POST_RADIUS)
    assert Stage(still).extent()[:, 1].max() == pytest.approx(0.2 + POST_RADIUS)


def test_the_arm_that_is_drawn_is_the_simulated_one():
    episode = bending_arm()
    drawing = Stage(episode).draw(4.0)
    arm = drawing.cone[drawing.owner == ARM]
    np.testing.assert_allclose(arm[::2, :3], episode.position[4, :, :-1].T)  # every second piece begins at a node
    np.testing.assert_allclose(arm[-1, 4:7], episode.position[4, :, -1])
    np.testing.assert_allclose(arm[1:, :4], arm[:-1, 4:])  # no gaps
    np.testing.assert_allclose(arm[:, 3], episode.radius()[4].mean(), rtol=1e-3)


def test_between_two_steps_the_arm_is_between_them():
    stage = Stage(bending_arm())
    for step in range(STEPS + 1):
        np.testing.assert_array_equal(stage.nodes(float(step)), stage.position[step])
    middle = stage.nodes(2.5)
    arc = 2.5 / STEPS * 0.5 * np.pi  # the bend grows evenly
    tip = [(1.0 - np.cos(arc)) / arc, 0.0, np.sin(arc) / arc]
    np.testing.assert_allclose(middle[:, -1], tip, atol=2e-4)


def test_reaching_the_target_shows_at_the_end_alone():
    def core(success, step):
        drawing = Stage(bending_arm(success)).draw(step)
        return texture_at(drawing, int(np.flatnonzero(drawing.owner == MARK)[-1]), 0.0)[:3]

    waiting, reached = style.linear(style.TARGET), style.linear(style.REACHED)
    np.testing.assert_allclose(core(True, STEPS - 0.5), waiting)
    np.testing.assert_allclose(core(True, float(STEPS)), reached)
    np.testing.assert_allclose(core(False, float(STEPS)), waiting)


def test_the_target_is_drawn_with_the_radius_of_success():
    episode = bending_arm()
    drawing = Stage(episode).draw(0.0)
    marks = drawing.cone[drawing.owner == MARK]
    np.testing.assert_allclose(marks[0], [*episode.target, 0.05] * 2)


def test_an_attention_edge_joins_bin_and_agent_and_stronger_ones_are_more_opaque():
    episode = bending_arm()
    stage = Stage(episode, attention=True)
    free = Stage(episode).draw(2.0)
    drawing = stage.draw(2.0)
    (edge,) = np.flatnonzero(drawing.owner == MARK)[2:]
    assert len(drawing.cone) == len(free.cone) + 1
    np.testing.assert_allclose(drawing.cone[edge, :3], episode.observation["slots/descriptor"][2, 0, :3])
    np.testing.assert_allclose(drawing.cone[edge, 4:7], episode.position[2, :, episode.agent_nodes[4]])
    strong = texture_at(drawing, int(edge), 0.5)[3]
    episode.attention["stage1"][2] *= 0.1
    weak = stage.draw(2.0)
    assert texture_at(weak, int(edge), 0.5)[3] < strong
    episode.attention["stage1"][2] *= 0.5 * FAINT
    assert len(stage.draw(2.0).cone) == len(free.cone)


def test_the_floor_is_below_everything_and_the_extent_holds_everything():
    episode = bending_arm()
    stage = Stage(episode)
    points = stage.extent()
    low, high = points.min(axis=0), points.max(axis=0)
    assert stage.floor <= -0.2
    everything = np.concatenate([episode.position.transpose(0, 2, 1).reshape(-1, 3), [episode.target]])
    assert (everything >= low).all()
    assert (everything <= high).all()
    assert low[1] <= -0.2 - POST_RADIUS
    assert high[2] >= 1.0 + POST_RADIUS


def test_an_episode_without_obstacles_has_no_cylinders():
    drawing = Stage(bending_arm(posts=False)).draw(1.0)
    assert not (drawing.owner == CYLINDER).any()
    assert (drawing.owner == ARM).any()
