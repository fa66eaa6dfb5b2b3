"""Steps with CUDA kernels under Numba's simulator against tensors; run by ``test_cuda_kernels.py``."""

import dataclasses
from unittest import mock

import pytest
import torch

from dense import force_dense
from round_trips import RoundTrips
from softgm_bench.envs import entries, make_env
from softgm_bench.envs.verdict import Step, judge, judge_dense
from softgm_bench.rod import sync
from softgm_bench.rod.parameters import RodParameters

DTYPES = [torch.float64, torch.float32]


def random_step(dtype: torch.dtype, num_envs: int) -> Step:
    """Steps of all kinds: near the target or not, touching or not, broken, ended before, at the horizon."""
    generator = torch.Generator().manual_seed(0)

    def draw(*shape):
        return 2.0 * torch.rand((num_envs, *shape), generator=generator) - 1.0

    before = draw(3, 5).to(dtype)
    target = draw(3).to(dtype)
    after = before + torch.where(draw(1, 1) > 0.0, 0.05, 1e-5).to(dtype) * draw(3, 5).to(dtype)
    after[..., -1] = torch.where(draw(1) > 0.5, target + 0.01, after[..., -1])
    return Step(
        before=before,
        after=after,
        target=target,
        action=draw(4, 2),
        previous_action=draw(4, 2),
        touching=draw(5) > draw(1) + 0.7,
        pushed=draw() > 0.8,
        new_bins=(5.0 * draw()).clamp(min=0.0).long(),
        broken=draw() > 0.8,
        terminated=draw() > 0.8,
        truncated=draw() > 0.8,
        steps=(10.0 * draw()).abs().long(),
        contact_steps=(6.0 * draw()).long(),  # below 0 where an easier scene allows more
    )


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("num_envs", [1, 200])  # with and without a last block that is not full
@pytest.mark.parametrize("task", ["wall", "wall_touch"])  # without and with a limit of contact
def test_the_kernel_judges_as_tensors_do(settings, dtype, num_envs, task):
    step, config = random_step(dtype, num_envs), settings(f"task={task}").task
    config = dataclasses.replace(config, max_contact_steps=3) if task == "wall_touch" else config
    with force_dense():
        found = judge(step, config, 8)
    expected = judge_dense(step, config, 8)
    for name in ("success", "ended", "terminated", "truncated", "steps", "contact_steps"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
    if task == "wall":
        assert found.contact_failure is expected.contact_failure is None
    else:
        assert torch.equal(found.contact_failure, expected.contact_failure)
        assert num_envs == 1 or 0 < found.contact_failure.sum() < num_envs
    rounding = 1e-5 if dtype == torch.float32 else 1e-6  # progress is a difference of distances, times a coefficient
    for key, value in expected.numbers.items():
        assert found.numbers[key].shape == (num_envs, 1)
        assert torch.allclose(found.numbers[key].squeeze(-1), value.float(), rtol=1e-5, atol=rounding), key
    if num_envs > 1:
        assert all(0 < getattr(found, name).sum() < num_envs for name in ("success", "ended", "terminated"))


@pytest.mark.parametrize("task", ["basic", "structured", "wall", "wall_touch", "wall_search", "wall_decoy"])
def test_an_environment_with_kernels_plays_the_episodes_of_one_without_and_waits_for_nothing(settings, task):
    def play(kernels: bool):
        parameters = RodParameters(n_elements=8, substeps=4)
        task_config = settings(f"task={task}").task
        env = make_env(task_config, parameters, 3, seed=0, horizon=3, stagger=True, backend="torch")
        generator = torch.Generator().manual_seed(1)
        td, frames, found = env.reset(), [], []
        with force_dense(), mock.patch.object(sync, "runs_kernels", return_value=kernels):
            for step in range(5):
                action = 2.0 * torch.rand((3, env.sizes.n_agents, 2), generator=generator) - 1.0
                with RoundTrips() as trips:
                    last, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
                found += trips.found if step else []  # constants are copied once
                frames += [last["next"].clone(), td.clone()]
        return frames, [trip for trip in found if "torch_backend" not in trip]

    frames, trips = play(kernels=True)
    expected, _ = play(kernels=False)
    assert trips == []
    for one, other in zip(frames, expected, strict=True):
        for key in other.keys(include_nested=True, leaves_only=True):
            assert one[key].dtype == other[key].dtype, key
            if one[key].is_floating_point():
                assert torch.allclose(one[key], other[key], rtol=1e-6, atol=1e-6), key
            else:
                assert torch.equal(one[key], other[key]), key
