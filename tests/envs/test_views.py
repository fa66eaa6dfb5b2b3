"""The mirror image of an observation, against a simulation in the mirror."""

import pytest
import torch

from every_task import MOVING, TASKS
from softgm_bench.envs import entries, make_env, views
from softgm_bench.envs.tasks import make_task
from softgm_bench.rod.parameters import RodParameters

BINORMAL = torch.tensor([1.0, -1.0])


def in_the_mirror(vectors):
    return vectors * torch.tensor([1.0, -1.0, 1.0], dtype=vectors.dtype)


def face_a_mirror(env):
    """Give environment 1 the mirror image of what environment 0 stands in."""
    state = env.simulation_state()
    for part in ("scene", "bins"):
        ours = state["episodes", part]
        for key in ours.keys(True, True):
            ours[key][1] = ours[key][0]
    vectors = [("scene", "target"), ("scene", "cylinders", "start"), ("scene", "cylinders", "axis")]
    for key in vectors:
        state["episodes", *key][1] = in_the_mirror(state["episodes", *key][1])
    descriptor = state["episodes", "bins", "descriptor"][1]
    descriptor[:, :3], descriptor[:, 3:6] = in_the_mirror(descriptor[:, :3]), in_the_mirror(descriptor[:, 3:6])
    env.load_simulation_state(state)


@pytest.mark.parametrize("task", ["basic", "structured", "wall"])
def test_mirrored_actions_among_mirrored_obstacles_are_observed_in_the_mirror_bit_by_bit(settings, task):
    env = make_env(settings(f"task={task}").task, RodParameters(), num_envs=2, seed=3)
    td = env.reset()
    face_a_mirror(env)
    generator = torch.Generator().manual_seed(1)
    sensed, reach = False, []
    for step in range(40):
        if step % 10 == 0:  # held, so that the arm goes somewhere; forward first
            action = 2.0 * torch.rand((env.sizes.n_agents, 2), generator=generator) - 1.0
            action[:, 0] = 1.0 if step < 30 else -1.0
        td = env.step(td.set(entries.ACTION, torch.stack([action, action * BINORMAL])))["next"].exclude("reward")
        seen, image = td[0], views.mirrored(td)[1]
        for key in entries.OBSERVATION:
            assert torch.equal(seen[key], image[key]), (step, key)
        reach.append(td[entries.TIP][0, 0].item())
        sensed |= bool(td[entries.EDGE][0].any())
    assert td[entries.AGENT_POSITION][0, :, 1].abs().max() > 0.05
    if task == "wall":
        assert sensed
        assert max(reach[20:30]) < 0.33 < 1.1 * min(reach[20:30])  # the wall holds it


@pytest.mark.parametrize("task", TASKS)
def test_a_scene_is_as_likely_as_its_mirror_image(settings, task):
    """First moments that the mirror changes: of targets, of openings and of all that stands in the way."""
    scenes = make_task(settings(f"task={task}").task).sample(4000, torch.Generator().manual_seed(0))
    mask = scenes.cylinders.mask
    odd = [scenes.target[:, 1], (scenes.cylinders.start[..., 1] * scenes.cylinders.length * mask).sum(-1)]
    if task.startswith("wall"):
        odd.append(scenes.privileged[:, 1])
    for values in odd:
        assert values.mean().abs() <= 4.0 * values.std() / len(values) ** 0.5 + 1e-9


def image_of(scenes, task):
    """The scenes in the mirror; of posts, which are numbered from right to left, the other way round."""
    known, (order, signs) = scenes.privileged, zip(*task.privileged_image, strict=True)
    turn = -1 if type(task).__name__ == "SwingingPosts" else 1
    cylinders = scenes.cylinders.clone()
    for name in ("start", "axis", "length", "radius", "mask"):
        value = getattr(cylinders, name)
        value = in_the_mirror(value) if name in ("start", "axis") else value
        setattr(cylinders, name, value.flip(1) if turn < 0 else value)
    privileged = known[:, list(order)] * torch.tensor(signs, dtype=known.dtype)
    return scenes.replace(target=in_the_mirror(scenes.target), cylinders=cylinders, privileged=privileged)


def clearance(scenes):
    """How far the told opening's centre is from the nearest upright column that passes it, horizontally."""
    centre, cylinders = scenes.privileged[:, None, :3], scenes.cylinders
    foot, top = cylinders.start[..., 2], cylinders.start[..., 2] + cylinders.length
    beside = cylinders.mask & (foot <= centre[..., 2]) & (centre[..., 2] <= top)
    away = (cylinders.start - centre)[..., :2].norm(dim=-1)
    return away.masked_fill(~beside, torch.inf).amin(dim=-1)


def off_plane(scenes):
    """How far the nearest column's foot is from the plane through the told centre at the told yaw, if one is told."""
    yaw = scenes.privileged[:, 4:] if scenes.privileged.shape[1] > 4 else torch.zeros_like(scenes.privileged[:, :1])
    normal = torch.stack([yaw.cos(), yaw.sin()], dim=-1)
    away = ((scenes.cylinders.start - scenes.privileged[:, None, :3])[..., :2] * normal).sum(-1).abs()
    return away.masked_fill(~scenes.cylinders.mask, torch.inf).amin(dim=-1)


@pytest.mark.parametrize("name", [task for task in TASKS if task.startswith("wall") and task != "wall_sliding"])
def test_what_is_told_of_an_opening_in_the_mirror_is_where_the_mirrored_columns_leave_room(settings, name):
    task = make_task(settings(f"task={name}").task)
    scenes = task.sample(200, torch.Generator().manual_seed(0))
    image = image_of(scenes, task)
    assert len(task.privileged_image) == task.n_privileged
    assert clearance(scenes).min() > 0.05
    torch.testing.assert_close(clearance(image), clearance(scenes))
    assert off_plane(scenes).max() < 1e-9
    assert off_plane(image).max() < 1e-9
    wrong = image.replace(privileged=scenes.privileged)
    assert name == "wall_fixed" or not torch.allclose(clearance(wrong), clearance(scenes))


@pytest.mark.parametrize("name", MOVING)
def test_obstacles_in_the_mirror_move_as_the_mirror_image_of_them_and_so_does_what_is_told(settings, name):
    task = make_task(settings(f"task={name}").task)
    here = task.sample(100, torch.Generator().manual_seed(0))
    there, step = image_of(here, task), torch.zeros(100, dtype=torch.int64)
    for _ in range(50):
        here, there = task.advance(here, step, 0.04), task.advance(there, step, 0.04)
    expected = image_of(here, task)
    torch.testing.assert_close(there.cylinders.start, expected.cylinders.start, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(there.privileged, expected.privileged, rtol=0.0, atol=1e-12)


def test_what_an_oracle_is_told_is_mirrored_with_the_rest(settings):
    env = make_env(settings("task=swinging_posts").task, RodParameters(), num_envs=3, seed=0)
    td, image = env.reset(), env.sizes.privileged_image
    told, mirrored = td[entries.PRIVILEGED], views.mirrored(td, image)[entries.PRIVILEGED]
    assert torch.equal(mirrored[:, :3], in_the_mirror(told[:, 3:6]))
    assert torch.equal(mirrored[:, 3:6], in_the_mirror(told[:, :3]))
    assert torch.equal(mirrored[:, 6:], -told[:, 6:].flip(1))
    assert entries.PRIVILEGED not in views.mirrored(td).keys()  # noqa: SIM118
