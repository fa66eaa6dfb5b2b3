"""The CUDA kernel of sensing under Numba's simulator against ``look_dense``; run by ``test_cuda_sensing.py``."""

import pytest
import torch
from test_sensing import random_scene

from dense import force_dense
from softgm_bench.envs import cuda_sensing
from softgm_bench.envs.sensing import Sight, cut_into_bins, empty_table, look, look_dense, sense
from softgm_bench.envs.tasks import make_task
from softgm_bench.rod.state import Cylinders

CPU = torch.device("cpu")
DTYPES = [torch.float64, torch.float32]


def assert_equal(found: Sight, expected: Sight) -> None:
    for name in ("new", "descriptor", "active", "edge"):
        assert torch.equal(getattr(found, name), getattr(expected, name)), name
        assert getattr(found, name).dtype == getattr(expected, name).dtype
    for name in ("bin_of_slot", "known", "count", "dropped"):
        assert torch.equal(getattr(found.table, name), getattr(expected.table, name)), name


def play(cylinders: Cylinders, places: list[torch.Tensor], n_slots: int, radius: float, max_length: float) -> Sight:
    """Look from all places in turn, with the kernel and without; what is seen at last."""
    bins = cut_into_bins(cylinders, 0.05, max_length)
    kernel = dense = empty_table(len(places[0]), n_slots, bins.mask.shape[1], CPU)
    for agents in places:
        with force_dense():
            found = look(agents, cylinders, bins, kernel, radius, 0.05)
        expected = look_dense(agents, bins, dense, radius)
        assert_equal(found, expected)
        kernel, dense = found.table, expected.table
    return found


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("n_slots", [5, 64])
def test_the_kernel_sees_what_the_dense_formula_sees_bit_by_bit(dtype, n_slots):
    generator = torch.Generator().manual_seed(2)
    places = [(torch.rand(4, 3, 3, generator=generator, dtype=torch.float64) - 0.5).to(dtype) for _ in range(5)]
    last = play(random_scene(1, 4, dtype), places, n_slots, 0.25, 1.0)
    assert last.table.known.sum() > 5
    assert (last.table.dropped.sum() > 0) == (n_slots < 64)


@pytest.fixture(autouse=True)
def _kernels(monkeypatch):
    """Every test must reach the kernel: where it launches none, it would compare tensors with themselves."""
    launches = []
    launch = cuda_sensing.launch
    monkeypatch.setattr(cuda_sensing, "launch", lambda *arguments: (launches.append(1), launch(*arguments)))
    yield
    assert launches


@pytest.mark.parametrize("name", ["wall", "structured", "wall_search", "wall_decoy"])
@pytest.mark.parametrize("dtype", DTYPES)
def test_discovery_adds_up_in_the_tasks_scenes(settings, name, dtype):
    task = make_task(settings(f"task={name}").task)
    scene = task.sample(2, torch.Generator().manual_seed(0))
    cylinders = scene.cylinders.apply(lambda value: value.to(dtype) if value.is_floating_point() else value)
    along = torch.linspace(0.0, 1.0, 6, dtype=dtype).view(1, 6, 1) * scene.target.to(dtype).unsqueeze(1)
    places = [share * along for share in (0.4, 0.7, 0.7, 1.0)]
    counts = [play(cylinders, places[:k], 128, 0.15, task.max_cylinder_length).table.count.sum() for k in (1, 4)]
    assert 0 <= counts[0] < counts[1]


def test_more_bins_than_threads_keep_the_order_of_their_index(monkeypatch):
    monkeypatch.setattr(cuda_sensing, "THREADS", 7)
    cuda_sensing.make_look.cache_clear()
    try:
        places = [torch.zeros(2, 1, 3, dtype=torch.float64)]
        last = play(random_scene(3, 2, torch.float64), places, 90, 5.0, 1.0)
        assert last.table.count.sum() > 40
        for row, count in zip(last.table.bin_of_slot, last.table.count, strict=True):
            assert (row[:count].diff() > 0).all()
    finally:
        cuda_sensing.make_look.cache_clear()


def test_a_look_leaves_the_table_that_it_was_given_alone():
    cylinders = random_scene(5, 3, torch.float64)
    bins = cut_into_bins(cylinders, 0.05, 1.0)
    table = empty_table(3, 8, bins.mask.shape[1], CPU)
    with force_dense():
        found = look(cylinders.start[:, :1], cylinders, bins, table, 0.15, 0.05)
    assert found.table.count.sum() > 0
    assert (table.bin_of_slot == -1).all()
    assert not table.known.any()
    assert table.count.sum() == table.dropped.sum() == 0


def test_masked_cylinders_and_scenes_without_any_are_not_seen():
    cylinders = random_scene(5, 3, torch.float64)
    cylinders.mask[:] = False
    assert not play(cylinders, [cylinders.start[:, :1]], 8, 5.0, 1.0).table.known.any()
    none = cylinders.apply(lambda value: value[:, :0])
    with force_dense():
        seen = look(cylinders.start[:, :2], none, cut_into_bins(none, 0.05, 0.0), empty_table(3, 4, 0, CPU), 0.15, 0.05)
    assert seen.edge.shape == (3, 2, 4)
    assert not seen.edge.any()
    assert not seen.active.any()


@pytest.mark.parametrize("dtype", DTYPES)
def test_the_sensing_radius_is_sharp(dtype):
    cylinders = random_scene(3, 5, dtype)
    bins = cut_into_bins(cylinders, 0.05, 1.0)
    generator = torch.Generator().manual_seed(4)
    direction = torch.randn(5, 8, 3, generator=generator, dtype=dtype)
    direction /= direction.norm(dim=-1, keepdim=True)
    hair = 1e-12 if dtype == torch.float64 else 1e-6
    reach = bins.descriptor[:, :1, 6:7] + 0.15
    places = [bins.descriptor[:, :1, :3] + (reach + sign * hair) * direction for sign in (-1, 0, 1)]
    play(cylinders, places, 8, 0.15, 1.0)
    seen = [sense(agents, bins, 0.15)[:, :, 0][bins.mask[:, 0]] for agents in places]
    assert seen[0].all()
    assert not seen[2].any()
