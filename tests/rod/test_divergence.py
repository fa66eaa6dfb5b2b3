import pytest
import torch

from softgm_bench.rod.divergence import diverged, diverged_dense
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.state import straight_rods

ARM = RodParameters(n_elements=12)
BOTH = pytest.mark.parametrize("broken", [diverged, diverged_dense], ids=["compiled", "dense"])
DTYPES = pytest.mark.parametrize("dtype", [torch.float64, torch.float32])


def rods(dtype):
    rest_length = torch.as_tensor(rod_constants(ARM).rest_length, dtype=dtype)
    return straight_rods(ARM, 6, dtype), rest_length


@BOTH
@DTYPES
@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("field", ["position", "director", "velocity", "omega"])
def test_one_value_that_is_not_finite_breaks_its_rod_alone(broken, dtype, value, field):
    state, rest_length = rods(dtype)
    getattr(state, field)[1].view(-1)[7] = value
    getattr(state, field)[4].view(-1)[-1] = value
    assert broken(state, rest_length, 0.2, 5.0).tolist() == [False, True, False, False, True, False]


@BOTH
@DTYPES
def test_an_element_whose_dilatation_leaves_the_range_breaks_its_rod_alone(broken, dtype):
    state, rest_length = rods(dtype)
    for rod, stretch in enumerate((0.19, 0.21, 1.0, 4.9, 5.1)):
        state.position[rod, 2, 6:] += (stretch - 1.0) / 12  # the element between nodes 5 and 6
    assert broken(state, rest_length, 0.2, 5.0).tolist() == [True, False, False, False, True, False]


@BOTH
def test_large_values_that_are_finite_break_nothing(broken):
    state, rest_length = rods(torch.float64)
    state.velocity[:] = torch.finfo(torch.float64).max
    assert not broken(state, rest_length, 0.2, 5.0).any()
