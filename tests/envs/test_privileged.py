"""What critics may know of a scene and actors may not."""

import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type

from softgm_bench.envs import entries, make_env
from softgm_bench.models.heads import build_actor
from softgm_bench.rod.parameters import RodParameters

WALLS = ("wall", "wall_narrow", "wall_fixed")


@pytest.fixture
def build(settings):
    def environment(task, num_envs=4, **options):
        rod = RodParameters(substeps=5)
        return make_env(settings(f"task={task}").task, rod, num_envs=num_envs, seed=0, **options)

    return environment


@pytest.mark.parametrize("task", WALLS)
def test_a_wall_tells_its_openings_centre_and_side(build, settings, task):
    env, side = build(task, num_envs=64), settings(f"task={task}").task.opening_side
    privileged = env.reset()[entries.PRIVILEGED]
    assert privileged.shape == (64, env.sizes.n_privileged) == (64, 4)
    assert privileged.dtype == torch.float32
    assert torch.allclose(privileged[:, 0], torch.tensor(0.4))
    assert torch.allclose(privileged[:, 3], torch.tensor(side))
    cylinders = env.simulation_state()["episodes", "scene", "cylinders"]
    for row in range(64):
        start = cylinders["start"][row][cylinders["mask"][row]]
        length = cylinders["length"][row][cylinders["mask"][row]]
        cut = (length < 1.4 - 1e-9) & (start[:, 2] < -0.2 + 1e-9)
        # the lower parts end half a side below the centre; their axes lie within half a side of it
        assert torch.allclose((start[cut, 2] + length[cut]).float(), privileged[row, 2] - side / 2, atol=1e-6)
        assert ((start[cut, 1] - privileged[row, 1]).abs() <= side / 2 + 1e-6).all()


def test_it_stays_through_an_episode_and_changes_with_the_next(build):
    env = build("wall", horizon=2)
    td = env.reset()
    first = td[entries.PRIVILEGED].clone()
    for last in (False, True):
        out, td = env.step_and_maybe_reset(td.set(entries.ACTION, torch.zeros(4, 6, 2)))
        assert torch.equal(out["next", entries.PRIVILEGED], first)
        assert torch.equal(td[entries.PRIVILEGED], first) != last


@pytest.mark.parametrize("task", ["basic", "structured"])
def test_where_there_is_nothing_to_tell_the_entry_is_absent(build, task):
    env = build(task)
    assert env.sizes.n_privileged == 0
    assert entries.PRIVILEGED not in set(env.reset().keys())
    assert entries.PRIVILEGED not in set(env.observation_spec.keys())
    check_env_specs(env)


def test_the_collector_hands_it_on_for_now_and_next(build):
    env = build("wall", horizon=3)
    collector = Collector(env, None, frames_per_batch=32, total_frames=32, track_traj_ids=False)
    try:
        (batch,) = list(collector)
    finally:
        collector.shutdown()
    assert batch[entries.PRIVILEGED].shape == batch["next", entries.PRIVILEGED].shape == (4, 8, 4)
    same_episode = ~batch["next", "done"].squeeze(-1)[:, :-1]
    assert torch.equal(
        batch[entries.PRIVILEGED][:, 1:][same_episode], batch["next", entries.PRIVILEGED][:, :-1][same_episode]
    )


@pytest.mark.parametrize("model", ["softgm", "mlp"])
def test_it_reaches_no_actor(build, settings, model):
    env, config = build("wall"), settings("task=wall", "algo=softgm", f"model={model}")
    policy = build_actor(config.model, env.sizes, config.algo.actor)
    td = env.reset()
    assert entries.PRIVILEGED not in entries.OBSERVATION
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        expected = policy(td.clone())[entries.ACTION]
        td[entries.PRIVILEGED].fill_(float("nan"))
        assert torch.equal(policy(td.clone())[entries.ACTION], expected)
