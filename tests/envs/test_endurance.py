import pytest
import torch

from softgm_bench.envs import entries, make_env
from softgm_bench.rod.parameters import RodParameters


@pytest.mark.slow
def test_full_torque_that_keeps_changing_sign_against_the_wall_breaks_nothing(settings):
    """64 environments x 2000 control steps (80 s) of bang-bang torque; nobody is reset."""
    env = make_env(settings("task=wall").task, RodParameters(), num_envs=64, seed=0)
    generator = torch.Generator().manual_seed(0)
    td = env.reset()
    action = torch.ones(64, 6, 2)
    diverged = torch.zeros(64, 1, dtype=torch.bool)
    touched = 0.0
    for step in range(2000):
        if step % 5 == 0:
            leaning = torch.tensor([0.75, 0.5])  # about d1 mostly towards the wall
            action = torch.where(torch.rand(64, 6, 2, generator=generator) < leaning, 1.0, -1.0)
        # what has reached its target by chance goes on as well
        state = env.simulation_state()
        state["episodes", "terminated"].zero_()
        env.load_simulation_state(state)
        td = env.step(td.exclude("reward").clone().set(entries.ACTION, action))["next"]
        diverged |= td[entries.DIVERGED]
        touched += td[entries.CONTACT_NODES].mean().item()
    assert not diverged.any()
    assert touched > 100.0
    director = env.simulation_state()["episodes", "rod", "director"]
    gram = torch.einsum("bijn,bkjn->bnik", director, director)
    assert (gram - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-9
