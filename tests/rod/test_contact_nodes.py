"""Which nodes touch: the two implementations against the definition and each other."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from dense import force_dense
from softgm_bench.rod.contact import element_radius
from softgm_bench.rod.contact_nodes import contact_nodes, contact_nodes_dense, point_segment_distance
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.state import Cylinders, straight_rods

PARAMETERS = RodParameters(n_elements=6)
VOLUME = torch.as_tensor(rod_constants(PARAMETERS).volume)
SEEDS = st.integers(0, 2**32 - 1)
BOTH = pytest.mark.parametrize("touching", [contact_nodes, contact_nodes_dense], ids=["compiled", "dense"])

coordinate = st.floats(-2.0, 2.0, allow_subnormal=False)
point = st.tuples(coordinate, coordinate, coordinate)


def tensor(values) -> Tensor:
    return torch.as_tensor(values, dtype=torch.float64)


def cylinder(start, axis, length: float, radius: float) -> Cylinders:
    one = {"start": start, "axis": axis, "length": length, "radius": radius}
    values = {name: tensor(value)[None, None] for name, value in one.items()}
    return Cylinders(**values, mask=torch.ones(1, 1, dtype=torch.bool), batch_size=[1])


def random_scene(seed: int, num_envs: int = 1, n_cylinders: int = 5) -> tuple[Tensor, Cylinders]:
    """Crooked rods among cylinders of any direction, some near, some far, some masked."""
    generator = np.random.default_rng(seed)
    position = straight_rods(PARAMETERS, num_envs).position + tensor(generator.normal(0.0, 0.08, (num_envs, 3, 7)))
    axis = tensor(generator.normal(size=(num_envs, n_cylinders, 3)))
    cylinders = Cylinders(
        start=tensor(generator.uniform((-0.5, -0.5, -0.3), (0.5, 0.5, 1.3), (num_envs, n_cylinders, 3))),
        axis=axis / axis.norm(dim=-1, keepdim=True),
        length=tensor(generator.uniform(0.1, 1.5, (num_envs, n_cylinders))),
        radius=tensor(generator.uniform(0.02, 0.2, (num_envs, n_cylinders))),
        mask=torch.as_tensor(generator.random((num_envs, n_cylinders)) < 0.8),
        batch_size=[num_envs],
    )
    return position, cylinders


def test_every_rod_may_have_volumes_of_its_own():
    position, cylinders = random_scene(1, num_envs=40)
    volume = torch.linspace(0.25, 2.0, 40, dtype=torch.float64)[:, None] * VOLUME
    found = contact_nodes(position, volume, cylinders)
    assert torch.equal(found, contact_nodes_dense(position, volume, cylinders))
    for row in range(40):
        alone = contact_nodes(position[row : row + 1], volume[row], cylinders[row : row + 1])
        assert torch.equal(found[row : row + 1], alone)
    assert not torch.equal(found, contact_nodes(position, VOLUME, cylinders))


@given(p=point, start=point, end=point)
def test_point_segment_distance_equals_brute_force(p: tuple, start: tuple, end: tuple):
    p, start, end = tensor(p), tensor(start), tensor(end)
    length = (end - start).norm()
    axis = (end - start) / length if length > 0.0 else tensor([1.0, 0.0, 0.0])
    actual = point_segment_distance(p, start, axis, length)
    along = torch.linspace(0.0, 1.0, 2001, dtype=torch.float64)[:, None] * length
    sampled = (start + along * axis - p).norm(dim=-1).min()
    assert actual <= sampled + 1e-12
    assert actual >= sampled - length / 4000.0 - 1e-12


def test_point_segment_distance_is_zero_with_zero_gradient_on_the_segment():
    p = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    distance = point_segment_distance(p, tensor([0.0, 0.0, -1.0]), tensor([0.0, 0.0, 1.0]), tensor(2.0))
    distance.backward()
    assert distance == 0.0
    assert torch.equal(p.grad, torch.zeros(3, dtype=torch.float64))


@BOTH
@settings(max_examples=50, deadline=None)
@given(seed=SEEDS)
def test_contact_nodes_equal_their_definition(touching, seed: int):
    position, cylinders = random_scene(seed)
    radius = element_radius(position, VOLUME)
    found = touching(position, VOLUME, cylinders)
    assert found.dtype == torch.bool
    elements = [[0], *([k - 1, k] for k in range(1, 6)), [5]]
    for k in range(7):
        node_radius = radius[0, elements[k]].mean()
        expected = False
        for c in torch.nonzero(cylinders.mask[0]).flatten():
            values = (cylinders.start[0, c], cylinders.axis[0, c], cylinders.length[0, c])
            expected |= bool(point_segment_distance(position[0, :, k], *values) < node_radius + cylinders.radius[0, c])
        assert found[0, k] == expected


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_compiled_loop_equals_the_dense_test_in_many_scenes(dtype: torch.dtype):
    position, cylinders = random_scene(0, num_envs=400)
    cylinders = cylinders.apply(lambda x: x.to(dtype) if x.is_floating_point() else x)
    compiled = contact_nodes(position.to(dtype), VOLUME.to(dtype), cylinders)
    assert torch.equal(compiled, contact_nodes_dense(position.to(dtype), VOLUME.to(dtype), cylinders))
    assert 0.1 < compiled.double().mean() < 0.9
    with force_dense():
        assert torch.equal(contact_nodes(position.to(dtype), VOLUME.to(dtype), cylinders), compiled)


@BOTH
def test_contact_nodes_of_known_scene(touching):
    position = straight_rods(PARAMETERS, 1).position  # nodes every 1/6
    across = cylinder([0.079, -0.5, 0.5], [0.0, 1.0, 0.0], 1.0, 0.03)
    assert touching(position, VOLUME, across)[0].tolist() == [False, False, False, True, False, False, False]
    assert not touching(position, VOLUME, across.replace(radius=across.radius - 0.002)).any()
    beside = cylinder([0.079, 0.0, 0.4], [0.0, 0.0, 1.0], 0.3, 0.03)
    assert touching(position, VOLUME, beside)[0].tolist() == [False, False, False, True, True, False, False]


@BOTH
def test_masked_cylinders_are_never_read(touching):
    position, cylinders = random_scene(3, num_envs=20)
    poisoned = cylinders.clone()
    for values in (poisoned.start, poisoned.axis, poisoned.length, poisoned.radius):
        values[~poisoned.mask] = float("nan")
    assert torch.equal(touching(position, VOLUME, poisoned), touching(position, VOLUME, cylinders))


@BOTH
def test_no_cylinders_mean_no_contact(touching):
    position, cylinders = random_scene(0)
    assert not touching(position, VOLUME, cylinders.apply(lambda values: values[:, :0])).any()
