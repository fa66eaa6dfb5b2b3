import torch
from hypothesis import given
from hypothesis import strategies as st

from softgm_bench.models.activation import Tanh, tanh

VALUES = st.lists(st.floats(-100, 100, width=32), min_size=1, max_size=50)


@given(VALUES)
def test_it_is_the_hyperbolic_tangent_to_rounding(values):
    x = torch.tensor(values, dtype=torch.float32)
    assert (tanh(x) - torch.tanh(x)).abs().max() <= 3 * torch.finfo(torch.float32).eps
    assert torch.equal(Tanh()(x), tanh(x))
    assert x.tolist() == values


def test_its_gradient_is_right():
    x = torch.linspace(-4, 4, 33, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(tanh, x)


def test_it_can_be_mapped_over():
    x = torch.randn(4, 5)
    torch.testing.assert_close(torch.vmap(tanh)(x), torch.tanh(x))
