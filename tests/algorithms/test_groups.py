"""Several batches as one: scales over all, minibatches with a share of each."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from tensordict import TensorDict

from softgm_bench.algorithms.groups import joined, minibatches, standardised, weighted_mean


def numbered(*lengths):
    """Frames that carry their group and their number."""
    return [
        TensorDict({"group": torch.full((length,), group), "frame": torch.arange(length)}, [length])
        for group, length in enumerate(lengths)
    ]


@settings(deadline=None)
@given(st.lists(st.integers(1, 60), min_size=1, max_size=4), st.integers(1, 80))
def test_an_epoch_meets_every_frame_once_but_for_a_rest_below_half_a_minibatch(lengths, size):
    total = sum(lengths)
    met = list(minibatches(numbered(*lengths), size))
    assert all(len(part) for parts in met for part in parts)
    seen = [(int(part["group"][0]), int(frame)) for parts in met for part in parts for frame in part["frame"]]
    assert len(seen) == len(set(seen))
    rest = total % size if total > size else 0
    assert total - len(seen) <= (rest + len(lengths) if 2 * rest < size and rest else 0)


@settings(deadline=None)
@given(st.lists(st.integers(1, 60), min_size=1, max_size=4), st.integers(0, 80))
def test_no_group_is_ever_a_whole_frame_away_from_its_share(lengths, more):
    size, total, so_far = len(lengths) + more, sum(lengths), [0] * len(lengths)
    for number, parts in enumerate(minibatches(numbered(*lengths), size), start=1):
        for part in parts:
            so_far[int(part["group"][0])] += len(part)
        if number * size <= total:
            shares = [number * size * length / total for length in lengths]
            assert all(abs(met - share) < 1 for met, share in zip(so_far, shares, strict=True))


def test_groups_of_equal_lengths_have_equal_shares():
    for minibatch in minibatches(numbered(20, 20, 20), 15):
        assert [len(part) for part in minibatch] == [5, 5, 5]


@pytest.mark.parametrize(("length", "size", "sizes"), [(10, 4, [4, 4, 2]), (9, 4, [4, 4]), (3, 4, [3]), (8, 4, [4, 4])])
def test_one_group_is_split_as_torch_would_split_it(length, size, sizes):
    torch.manual_seed(0)
    found = [parts[0] for parts in minibatches(numbered(length), size)]
    assert [len(part) for part in found] == sizes
    torch.manual_seed(0)
    order = torch.randperm(length)
    assert torch.equal(torch.cat([part["frame"] for part in found]), order[: sum(sizes)])


def test_a_scale_is_that_of_all_groups():
    groups = [torch.tensor([[1.0], [2.0]]), torch.tensor([[[3.0], [4.0]], [[5.0], [9.0]]])]
    one, other = standardised(groups)
    assert (one.shape, other.shape) == (groups[0].shape, groups[1].shape)
    everything = joined([one, other])
    assert everything.mean().item() == pytest.approx(0.0, abs=1e-6)
    assert everything.std().item() == pytest.approx(1.0, abs=1e-6)
    torch.testing.assert_close(other[0, 0] - one[1], (groups[1][0, 0] - groups[0][1]) / joined(groups).std())
    assert joined(groups[1:]) is groups[1]


def test_means_of_groups_weigh_by_their_frames():
    assert weighted_mean([1.0, 4.0], [10, 20]) == pytest.approx(3.0)
    assert weighted_mean([0.1], [7]) == 0.1
