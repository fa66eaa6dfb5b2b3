import pytest
import torch
from observations import observation

from dense import force_dense
from softgm_bench.models import dot_product, dot_product_kernel
from softgm_bench.models.dot_product_kernel import DotProductAttention

HEADS, CHANNELS = 2, 3


def arguments(n_agents, itself, reach=1, dtype=torch.float64):
    """Two environments with three bins each; the last agent of all hears none of them, the first one all three."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape):
        return torch.randn(*shape, generator=generator, dtype=dtype).requires_grad_()

    total = 2 * n_agents
    edges = [3, *[1] * (total - 2), 0]
    first = torch.tensor([0, *edges]).cumsum(0)
    source = torch.arange(int(first[-1])) % 3 + 3 * (torch.arange(int(first[-1])) >= first[n_agents])
    agents, bins = normal(total, 3, HEADS, CHANNELS), normal(6, 2, HEADS, CHANNELS)
    tensors = (agents, bins, normal(total, HEADS), normal(total, n_agents), normal(len(source)))
    return *tensors, first, source, (n_agents, reach, itself)


@pytest.mark.parametrize("itself", [False, True])
@pytest.mark.parametrize(("n_agents", "reach"), [(1, 1), (2, 1), (4, 1), (4, 4)])
def test_its_gradients_are_right(n_agents, reach, itself):
    both = lambda *given: DotProductAttention.apply(*given)[:2]  # noqa: E731
    assert torch.autograd.gradcheck(both, arguments(n_agents, itself, reach))


def test_it_is_taken_on_a_cpu_and_where_values_may_be_read(monkeypatch):
    calls = []
    kernel = dot_product_kernel.gather
    monkeypatch.setattr(dot_product_kernel, "gather", lambda *given: calls.append(1) or kernel(*given))

    def attend(discovered=False):
        hearing = dot_product.listen(observation((2,), 3, 5), 1, itself=True, discovered=discovered)
        agents, bins = torch.ones(6, 3, HEADS, CHANNELS), torch.ones(len(hearing.bins), 2, HEADS, CHANNELS)
        return dot_product.attend(agents, bins, hearing)

    attend()
    assert len(calls) == 1
    attend(discovered=True)
    with force_dense():
        attend()
    assert len(calls) == 1
