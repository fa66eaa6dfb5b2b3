import torch

from softgm_bench.upstream.functorch import is_wrapped, transforms_active


def test_a_transform_and_its_tensors_are_noticed_while_it_is_at_work():
    seen = []

    def look(value):
        seen.append((transforms_active(), is_wrapped(value)))
        return value.sum()

    values = torch.ones(3, 2)
    look(values)
    torch.vmap(look)(values)
    torch.func.grad(look)(values)
    look(values)
    assert seen == [(False, False), (True, True), (True, True), (False, False)]
