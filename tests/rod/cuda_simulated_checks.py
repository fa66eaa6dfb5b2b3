"""The CUDA kernels of ``cuda_checks`` under Numba's simulator against tensors; run by ``test_cuda_checks.py``."""

import pytest
import torch
from test_contact_nodes import PARAMETERS, VOLUME, random_scene

from dense import force_dense
from softgm_bench.rod import cuda_checks
from softgm_bench.rod.contact_nodes import contact_nodes, contact_nodes_dense
from softgm_bench.rod.divergence import diverged, diverged_dense
from softgm_bench.rod.parameters import rod_constants
from softgm_bench.rod.state import straight_rods

DTYPES = [torch.float64, torch.float32]
REST = torch.as_tensor(rod_constants(PARAMETERS).rest_length)
FIELDS = ("position", "director", "velocity", "omega")


@pytest.fixture(autouse=True)
def _kernels(monkeypatch):
    """Every test must reach a kernel: where it launches none, it would compare tensors with themselves."""
    launches = []

    def counted(*arguments):
        launches.append(arguments)
        return launch(*arguments)

    launch = cuda_checks.launch
    monkeypatch.setattr(cuda_checks, "launch", counted)
    with force_dense():
        yield
    assert launches


@pytest.mark.parametrize("dtype", DTYPES)
def test_nodes_touch_as_by_the_dense_test(dtype):
    position, cylinders = random_scene(0, num_envs=40)
    position = position.to(dtype)
    cylinders = cylinders.apply(lambda x: x.to(dtype) if x.is_floating_point() else x)
    found = contact_nodes(position, VOLUME.to(dtype), cylinders)
    assert 0.1 < found.double().mean() < 0.9
    assert torch.equal(found, contact_nodes_dense(position, VOLUME.to(dtype), cylinders))


def test_nodes_touch_with_the_volumes_of_their_own_rod():
    position, cylinders = random_scene(0, num_envs=40)
    volume = torch.linspace(0.25, 2.0, 40, dtype=torch.float64)[:, None] * VOLUME
    found = contact_nodes(position, volume, cylinders)
    assert torch.equal(found, contact_nodes_dense(position, volume, cylinders))
    assert not torch.equal(found, contact_nodes_dense(position, VOLUME, cylinders))


def test_masked_cylinders_are_never_read_and_no_cylinders_mean_no_contact():
    position, cylinders = random_scene(3, num_envs=5)
    expected = contact_nodes(position, VOLUME, cylinders)
    for values in (cylinders.start, cylinders.axis, cylinders.length, cylinders.radius):
        values[~cylinders.mask] = float("nan")
    assert torch.equal(contact_nodes(position, VOLUME, cylinders), expected)
    assert not contact_nodes(position, VOLUME, cylinders.apply(lambda values: values[:, :0])).any()


@pytest.mark.parametrize("dtype", DTYPES)
def test_rods_break_as_by_the_dense_test(dtype):
    generator = torch.Generator().manual_seed(0)
    state = straight_rods(PARAMETERS, 24, dtype)
    noise = torch.randn(state.position.shape, generator=generator, dtype=torch.float64)
    state.position += (torch.linspace(0.0, 0.2, 24).view(-1, 1, 1) * noise).to(dtype)
    found = diverged(state, REST.to(dtype), 0.5, 2.0)
    assert torch.equal(found, diverged_dense(state, REST.to(dtype), 0.5, 2.0))
    assert 2 < found.sum() < 22


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_one_value_that_is_not_finite_breaks_its_rod_alone(value):
    for field in FIELDS:
        for place in (0, -1):
            state = straight_rods(PARAMETERS, 3)
            getattr(state, field)[1].view(-1)[place] = value
            assert diverged(state, REST, 0.5, 2.0).tolist() == [False, True, False], (field, place)
