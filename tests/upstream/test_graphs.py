"""What surrounds a CUDA graph: inputs and results, attempts that leave no trace, and the way back to plain calls."""

import pytest
import torch
from tensordict import TensorDict

from recordings import Broken, Repetition, recordings
from softgm_bench.upstream import graphs

CPU = torch.device("cpu")


class Sum:
    """Adds inputs and noise to a total; remembers where its inputs were."""

    def __init__(self, generators=()):
        self.total, self.places = torch.zeros(3), []
        self.recorded = graphs.Recorded(self.add, lambda: [self.total], CPU, "the sum", generators)
        self.generators = generators

    def add(self, inputs):
        self.places.append(inputs["x"].data_ptr())
        inputs["added"] = inputs["x"]  # losses leave things behind, too
        noise = [torch.randn(3, generator=generator) for generator in (None, *self.generators)]
        self.total += inputs["x"].sum(0) + sum(noise)
        return self.total.clone()


def inputs(value, size=4):
    return TensorDict({"x": torch.full((size, 3), float(value))}, [size])


def totals(values, sizes=None, recorded=True):
    torch.manual_seed(0)
    one = Sum([torch.Generator().manual_seed(1)])
    call = one.recorded if recorded else one.add
    sizes = sizes or [4] * len(values)
    return one, [call(inputs(value, size)) for value, size in zip(values, sizes, strict=True)]


@pytest.mark.parametrize("kind", [Repetition, Broken])
def test_a_recorded_function_gives_what_the_function_gives(kind):
    _, expected = totals([1, 2, 3], recorded=False)
    with recordings(kind):
        _, found = totals([1, 2, 3])
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


def test_it_is_warmed_up_then_recorded_then_replayed_once_a_call():
    with recordings() as log:
        totals([1, 2])
    assert log == ["warm-up"] * graphs.WARM_UPS + ["record", "replay", "replay"]


def test_inputs_are_copied_to_where_they_were_recorded_and_results_are_not_overwritten():
    with recordings():
        one, found = totals([1, 2, 3])
    assert len(set(one.places)) == 1
    assert len({result.data_ptr() for result in found}) == 3


def test_another_size_is_not_replayed():
    with recordings() as log:
        _, found = totals([1, 2, 3], [4, 2, 4])
    assert log.count("replay") == 2
    assert log.count("record") == 1
    _, expected = totals([1, 2, 3], [4, 2, 4], recorded=False)
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


def test_a_failure_is_said_once_in_one_line_and_never_tried_again(capsys):
    with recordings(Broken) as log:
        one, _ = totals([1, 2, 3])
    assert one.recorded.failed
    assert log.count("record") == 1
    said = capsys.readouterr().err
    assert said == (
        "the sum runs without a CUDA graph: RuntimeError: operation not permitted when stream is capturing\n"
    )


def test_what_is_forgotten_is_recorded_anew():
    with recordings() as log:
        one, _ = totals([1])
        one.total = torch.ones(3)
        one.recorded.forget()
        assert (one.recorded(inputs(0)) != 0).all()
    assert log.count("record") == 2


def test_copies_reach_every_target_whatever_its_type():
    targets = [torch.zeros(2), torch.zeros(2, dtype=torch.int64), torch.zeros(2, dtype=torch.bool), torch.zeros(1)]
    sources = [torch.ones(2), torch.full((2,), 5), torch.ones(2, dtype=torch.bool), torch.full((1,), 3.0)]
    graphs.copy_into(targets, sources)
    assert all(torch.equal(*pair) for pair in zip(targets, sources, strict=True))


def optimizer(lr=0.1):
    torch.manual_seed(0)
    parameter = torch.nn.Parameter(torch.randn(5))
    return parameter, torch.optim.Adam([parameter], lr=lr, eps=1e-5, fused=True)


def descend(parameter, one, steps):
    for _ in range(steps):
        one.zero_grad(set_to_none=True)
        parameter.square().sum().backward()
        one.step()


def test_a_prepared_optimiser_takes_the_steps_of_a_plain_one():
    (plain, one), (prepared, other) = optimizer(), optimizer()
    graphs.prepare_optimizer(other)
    assert torch.equal(plain, prepared)
    assert other.param_groups[0]["capturable"]
    assert graphs.optimizer_tensors(other)
    assert not any(tensor.any() for tensor in graphs.optimizer_tensors(other))
    for lr in (0.1, 0.02):
        held = other.param_groups[0]["lr"]
        graphs.set_lr(one, lr)
        graphs.set_lr(other, lr)
        assert other.param_groups[0]["lr"] is held  # a graph reads it there
        descend(plain, one, 3)
        descend(prepared, other, 3)
        torch.testing.assert_close(prepared, plain, rtol=1e-6, atol=1e-7)


def test_preparing_leaves_an_optimiser_under_way_where_it_is():
    parameter, one = optimizer()
    descend(parameter, one, 3)
    before = [tensor.clone() for tensor in graphs.optimizer_tensors(one)]
    graphs.prepare_optimizer(one)
    assert all(torch.equal(*pair) for pair in zip(graphs.optimizer_tensors(one), before, strict=True))


def test_the_state_that_is_kept_does_not_tell_whether_steps_were_recorded():
    (parameter, one), (other_parameter, other) = optimizer(), optimizer()
    graphs.prepare_optimizer(other)
    descend(parameter, one, 2)
    descend(other_parameter, other, 2)
    states = [graphs.portable_state(each, 0.1) for each in (one, other)]
    assert states[0]["param_groups"] == states[1]["param_groups"]
    one.load_state_dict(states[1])
    assert one.param_groups[0]["lr"] == 0.1
