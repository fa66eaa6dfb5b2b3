"""The mirror image of an observation, against a simulation in the mirror."""

import pytest
import torch

from every_task import TASKS
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
