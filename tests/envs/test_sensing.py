import pytest
import torch
from hypothesis import given, settings, strategies

from softgm_bench.envs.sensing import cut_into_bins, discover, empty_table, look, look_dense, observe_slots, sense
from softgm_bench.rod.state import Cylinders


def one_cylinder(start, axis, length, radius=0.04) -> Cylinders:
    def tensor(value):
        return torch.tensor([[value]], dtype=torch.float64)

    return Cylinders(
        start=tensor(start),
        axis=tensor(axis),
        length=tensor(length),
        radius=tensor(radius),
        mask=torch.tensor([[True]]),
        batch_size=[1],
    )


def test_bins_follow_the_axis_and_the_last_one_is_cut_short():
    bins = cut_into_bins(one_cylinder([0.4, 0.1, -0.2], [0.0, 0.0, 1.0], 0.12), 0.05, 0.25)
    assert bins.mask[0].tolist() == [True, True, True, False, False]
    centre = bins.descriptor[0, :3, :3]
    expected = [[0.4, 0.1, -0.175], [0.4, 0.1, -0.125], [0.4, 0.1, -0.09]]
    assert torch.allclose(centre, torch.tensor(expected, dtype=torch.float64))
    assert torch.allclose(bins.descriptor[0, :3, 6:8], torch.tensor([0.04, 0.12], dtype=torch.float64))
    positions = torch.tensor([0.025, 0.075, 0.11], dtype=torch.float64) / 0.12
    assert torch.allclose(bins.descriptor[0, :3, 8], positions)
    assert (bins.descriptor[0, 3:] == 0).all()


def test_a_length_that_is_a_whole_number_of_bins_has_no_empty_last_bin():
    bins = cut_into_bins(one_cylinder([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 1.4), 0.05, 1.4)
    assert bins.mask.shape[1] == 28
    assert bins.mask.all()


def test_a_bin_is_sensed_when_its_centre_is_within_radius_plus_rho():
    bins = cut_into_bins(one_cylinder([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.05), 0.05, 0.05)
    just_in, just_out = 0.04 + 0.15 - 1e-9, 0.04 + 0.15 + 1e-9
    agents = torch.tensor([[[just_in, 0.0, 0.025], [just_out, 0.0, 0.025]]], dtype=torch.float64)
    assert sense(agents, bins, 0.15)[0, :, 0].tolist() == [True, False]


def test_masked_cylinders_are_never_sensed():
    cylinders = one_cylinder([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.05)
    cylinders.mask = torch.tensor([[False]])
    bins = cut_into_bins(cylinders, 0.05, 0.05)
    assert not sense(torch.zeros(1, 1, 3, dtype=torch.float64), bins, 0.15).any()


def by_hand(history: list[list[set[int]]], n_slots: int) -> tuple[list[list[int]], list[int], list[list[int]]]:
    """Slots, dropped counts and stored counts of every step, environment by environment in plain Python."""
    slots: list[list[int]] = [[] for _ in history[0]]
    dropped = [0 for _ in history[0]]
    met: list[set[int]] = [set() for _ in history[0]]
    stored = []
    for step in history:
        stored.append([0] * len(step))
        for env, found in enumerate(step):
            for index in sorted(found - met[env]):
                met[env].add(index)
                if len(slots[env]) < n_slots:
                    slots[env].append(index)
                    stored[-1][env] += 1
                else:
                    dropped[env] += 1
    return slots, dropped, stored


@settings(deadline=None, max_examples=60)
@given(
    history=strategies.lists(
        strategies.lists(strategies.sets(strategies.integers(0, 9)), min_size=3, max_size=3), min_size=1, max_size=6
    ),
    n_slots=strategies.integers(1, 8),
)
def test_discovery_fills_first_free_slots_keeps_them_and_counts_what_does_not_fit(history, n_slots):
    table = empty_table(3, n_slots, 10, torch.device("cpu"))
    slots, dropped, stored = by_hand(history, n_slots)
    for step, expected in zip(history, stored, strict=True):
        sensed = torch.zeros(3, 2, 10, dtype=torch.bool)
        for env, found in enumerate(step):
            for index in found:
                sensed[env, index % 2, index] = True  # any agent discovers
        table, new = discover(table, sensed)
        assert new.tolist() == expected
    for env in range(3):
        padded = slots[env] + [-1] * (n_slots - len(slots[env]))
        assert table.bin_of_slot[env].tolist() == padded
    assert table.count.tolist() == [len(s) for s in slots]
    assert table.dropped.tolist() == dropped


def test_slots_remember_a_bin_that_is_out_of_reach_but_its_edge_is_gone():
    bins = cut_into_bins(one_cylinder([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.1), 0.05, 0.1)
    table = empty_table(1, 4, 2, torch.device("cpu"))
    near = torch.tensor([[[0.1, 0.0, 0.0], [5.0, 0.0, 0.0]]], dtype=torch.float64)
    sensed = sense(near, bins, 0.15)
    table, new = discover(table, sensed)
    descriptor, active, edge = observe_slots(table, bins, sensed)
    assert new.item() == 2
    assert edge[0].tolist() == [[True, True, False, False], [False] * 4]
    assert torch.equal(descriptor[0, :2], bins.descriptor[0])
    assert (descriptor[0, 2:] == 0).all()

    sensed = sense(near + 5.0, bins, 0.15)
    table, new = discover(table, sensed)
    later, active_later, edge = observe_slots(table, bins, sensed)
    assert new.item() == 0
    assert torch.equal(later, descriptor)
    assert torch.equal(active_later, active)
    assert not edge.any()


@pytest.mark.parametrize("n_slots", [0, 3])
def test_scenes_without_obstacles_have_empty_slots(n_slots):
    empty = torch.empty(2, 0, dtype=torch.float64)
    cylinders = Cylinders(
        start=empty.unsqueeze(-1).expand(2, 0, 3),
        axis=empty.unsqueeze(-1).expand(2, 0, 3),
        length=empty,
        radius=empty,
        mask=empty.bool(),
        batch_size=[2],
    )
    bins = cut_into_bins(cylinders, 0.05, 0.0)
    sensed = sense(torch.zeros(2, 6, 3, dtype=torch.float64), bins, 0.15)
    table, new = discover(empty_table(2, n_slots, 0, torch.device("cpu")), sensed)
    assert sensed.shape == (2, 6, 0)
    assert new.tolist() == [0, 0]
    assert table.bin_of_slot.shape == (2, n_slots)


def random_scene(seed: int, num_envs: int, dtype: torch.dtype) -> Cylinders:
    """Cylinders of any direction and length up to 1 m, some masked."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape, low=0.0, high=1.0):
        return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)

    axis = uniform(num_envs, 4, 3, low=-1.0)
    return Cylinders(
        start=uniform(num_envs, 4, 3, low=-0.5, high=0.5).to(dtype),
        axis=(axis / axis.norm(dim=-1, keepdim=True)).to(dtype),
        length=uniform(num_envs, 4, low=0.01).to(dtype),
        radius=uniform(num_envs, 4, low=0.01, high=0.1).to(dtype),
        mask=uniform(num_envs, 4) < 0.8,
        batch_size=[num_envs],
    )


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
@pytest.mark.parametrize("n_slots", [0, 5, 64])
@pytest.mark.parametrize("radius", [0.05, 0.15, 0.6])
def test_the_compiled_look_equals_the_dense_one_bit_by_bit(dtype, n_slots, radius):
    cylinders = random_scene(1, 50, dtype)
    bins = cut_into_bins(cylinders, 0.05, 1.0)
    generator = torch.Generator().manual_seed(2)
    compiled = dense = empty_table(50, n_slots, bins.mask.shape[1], torch.device("cpu"))
    sensed = 0
    for _ in range(12):
        agents = (torch.rand(50, 3, 3, generator=generator, dtype=torch.float64) - 0.5).to(dtype)
        found = look(agents, cylinders, bins, compiled, radius, 0.05)
        expected = look_dense(agents, bins, dense, radius)
        for name in ("new", "descriptor", "active", "edge"):
            assert torch.equal(getattr(found, name), getattr(expected, name)), name
            assert getattr(found, name).dtype == getattr(expected, name).dtype
        for name in ("bin_of_slot", "known", "count", "dropped"):
            assert torch.equal(getattr(found.table, name), getattr(expected.table, name)), name
        compiled, dense = found.table, expected.table
        sensed += int(sense(agents, bins, radius).sum())
    assert sensed > 100
    assert (compiled.dropped.sum() > 0) == (n_slots < 64)


def test_a_look_misses_no_bin_that_lies_just_within_reach():
    """Agents on spheres about the bins' centres, a hair inside and outside."""
    cylinders = random_scene(3, 200, torch.float64)
    bins = cut_into_bins(cylinders, 0.05, 1.0)
    generator = torch.Generator().manual_seed(4)
    direction = torch.randn(200, 1, 3, generator=generator, dtype=torch.float64)
    direction /= direction.norm(dim=-1, keepdim=True)
    table = empty_table(200, 100, bins.mask.shape[1], torch.device("cpu"))
    for index in torch.randint(bins.mask.shape[1], (30,), generator=generator):
        reach = (bins.descriptor[:, index, 6] + 0.15).view(-1, 1, 1)
        for hair, expected in ((-1e-12, bins.mask[:, index]), (1e-12, torch.zeros(200, dtype=torch.bool))):
            agents = bins.descriptor[:, index, None, :3] + (reach + hair) * direction
            known = look(agents, cylinders, bins, table, 0.15, 0.05).table.known[:, index]
            assert torch.equal(known, expected)


def test_a_look_leaves_the_table_that_it_was_given_alone():
    cylinders = random_scene(5, 10, torch.float64)
    bins = cut_into_bins(cylinders, 0.05, 1.0)
    table = empty_table(10, 8, bins.mask.shape[1], torch.device("cpu"))
    found = look(cylinders.start[:, :1], cylinders, bins, table, 0.15, 0.05)
    assert found.table.count.sum() > 0
    assert (table.bin_of_slot == -1).all()
    assert not table.known.any()
    assert table.count.sum() == table.dropped.sum() == 0
