"""The environment's CUDA kernels on a GPU against tensors on the CPU; skipped where there is none."""

import pytest
import torch

from softgm_bench.envs import entries, make_env
from softgm_bench.envs.sensing import cut_into_bins, empty_table, look, look_dense
from softgm_bench.envs.tasks import make_task
from softgm_bench.rod.contact_nodes import contact_nodes, contact_nodes_dense
from softgm_bench.rod.divergence import diverged, diverged_dense
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.state import straight_rods

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU here")]

ARM = RodParameters()
GPU = torch.device("cuda", 0)
DTYPES = [torch.float64, torch.float32]


@pytest.mark.parametrize("dtype", DTYPES)
def test_what_is_sensed_and_touched_and_broken_is_so_on_the_cpu_bit_by_bit(settings, dtype):
    task = make_task(settings("task=wall").task)
    scene = task.sample(64, torch.Generator().manual_seed(0))
    cylinders = scene.cylinders.apply(lambda value: value.to(dtype) if value.is_floating_point() else value)
    bins = cut_into_bins(cylinders, 0.05, task.max_cylinder_length)
    here = there = empty_table(64, 128, bins.mask.shape[1], torch.device("cpu"))
    there = there.to(GPU)
    volume, rest = (
        torch.as_tensor(getattr(rod_constants(ARM), name), dtype=dtype) for name in ("volume", "rest_length")
    )
    generator = torch.Generator().manual_seed(1)
    for _ in range(5):
        state = straight_rods(ARM, 64, dtype)
        state.position += (0.01 * torch.randn(state.position.shape, generator=generator)).cumsum(-1).to(dtype)
        agents = scene.target.to(dtype).unsqueeze(1) * torch.rand((64, 6, 1), generator=generator).to(dtype)
        expected = look_dense(agents, bins, here, 0.15)
        found = look(agents.to(GPU), cylinders.to(GPU), bins.to(GPU), there, 0.15, 0.05)
        here, there = expected.table, found.table
        for name in ("new", "descriptor", "active", "edge"):
            assert torch.equal(getattr(found, name).cpu(), getattr(expected, name)), name
        for name in ("bin_of_slot", "known", "count", "dropped"):
            assert torch.equal(getattr(there, name).cpu(), getattr(here, name)), name
        touching = contact_nodes(state.position.to(GPU), volume.to(GPU), cylinders.to(GPU)).cpu()
        assert torch.equal(touching, contact_nodes_dense(state.position, volume, cylinders))
        broken = diverged(state.to(GPU), rest.to(GPU), 0.5, 2.0).cpu()
        assert torch.equal(broken, diverged_dense(state, rest, 0.5, 2.0))
    assert here.count.sum() > 0


def test_steps_wait_for_nothing_and_give_finite_rewards(settings):
    env = make_env(settings("task=wall").task, ARM, 256, seed=0, horizon=5, device=GPU, dtype=torch.float32)
    td = env.reset()
    actions = torch.rand((256, env.sizes.n_agents, 2), device=GPU) - 0.5
    for step in range(8):
        torch.cuda.set_sync_debug_mode("error" if step > 1 else "default")
        try:
            last, td = env.step_and_maybe_reset(td.set(entries.ACTION, actions))
        finally:
            torch.cuda.set_sync_debug_mode("default")
        assert last["next", entries.REWARD].isfinite().all()
