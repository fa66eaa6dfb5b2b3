"""Environments whose arm PyElastica moves: the same episodes as by the fused kernel, training included."""

import pytest
import torch

from softgm_bench.config import compose
from softgm_bench.envs import entries, make_env
from softgm_bench.runs.loop import train

pytestmark = pytest.mark.usefixtures("one_thread")


def towards_the_wall(frame):
    """Actions that follow from the arm's own place, so that the loop is closed."""
    place = frame[entries.AGENT_POSITION]
    sideways = 0.1 * torch.sin(20.0 * place.sum(dim=-1))
    return torch.stack([0.9 + sideways, sideways], dim=-1)


@pytest.mark.parametrize(
    ("task", "overrides", "steps", "horizon"),
    [
        ("basic", (), 5, 3),
        (
            "wall",
            ("task.wall_x=0.2", "task.friction_coefficient=0.3", "task.velocity_damping_coefficient=10.0"),
            12,
            11,
        ),
        ("wall_sliding", ("task.wall_x=0.2", "task.slide_speed=0.2"), 12, 11),
    ],
    ids=["basic", "wall", "wall_sliding"],
)
def test_a_closed_loop_is_that_of_the_fused_kernel_resets_included(settings, task, overrides, steps, horizon):
    config = settings(f"task={task}", *overrides, "perturbation=disturbance", "perturbation.first_step=1")
    envs = [
        make_env(config.task, config.rod, 2, 0, horizon, backend=name, perturbation=config.perturbation)
        for name in ("numba", "pyelastica")
    ]
    frames, touched, begun = [env.reset() for env in envs], False, False
    for _ in range(steps):
        chosen = [frame.set(entries.ACTION, towards_the_wall(frame)) for frame in frames]
        both = [env.step_and_maybe_reset(frame) for env, frame in zip(envs, chosen, strict=True)]
        ours, theirs = (env.rod for env in envs)
        for name, bound in {"position": 1e-10, "director": 1e-10, "velocity": 1e-7, "omega": 1e-7}.items():
            assert (getattr(ours, name) - getattr(theirs, name)).abs().max() < bound, name
        for key in (entries.DONE, entries.SUCCESS, entries.CONTACT_NODES):
            assert torch.equal(*(done["next"][key] for done, _ in both)), key
        assert torch.equal(*(env.tip_force for env in envs))
        touched |= bool(both[1][0]["next"][entries.CONTACT_NODES].any())
        begun |= bool(both[1][0]["next"][entries.DONE].any())
        frames = [following for _, following in both]
    assert begun
    assert touched == (task != "basic")


@pytest.mark.slow
def test_a_training_runs_in_pyelastica(tmp_path):
    tiny = ("experiment=smoke", "threads=1", "rod.n_elements=20", "rod.substeps=10", f"run_dir={tmp_path}/run")
    sizes = ("experiment.total_frames=16", "experiment.num_envs=2", "experiment.steps_per_batch=4")
    summary = train(compose([*tiny, *sizes, "algo=mappo", "algo.minibatch_size=8", "task=wall", "backend=pyelastica"]))
    assert summary["frames"] == 16
