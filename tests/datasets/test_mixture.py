import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from small import POLICY
from tensordict import TensorDict

from softgm_bench.datasets import mixture
from softgm_bench.envs import entries
from softgm_bench.errors import UserError


@given(st.lists(st.floats(0.01, 100.0), min_size=1, max_size=6), st.integers(6, 10**6))
def test_shares_add_up_and_each_is_right_to_one(shares, transitions):
    counts = mixture._apportioned(shares, transitions)
    assert sum(counts) == transitions
    for share, count in zip(shares, counts, strict=True):
        assert abs(count - share / sum(shares) * transitions) < 1.0


def test_random_actions_fill_their_range_and_follow_the_seed():
    uniform, td = mixture.Uniform(3, 2), TensorDict({}, [500])
    torch.manual_seed(1)
    action = uniform(td.clone())[entries.ACTION]
    assert action.shape == (500, 3, 2)
    assert -1.0 <= action.min() < -0.99
    assert 0.99 < action.max() <= 1.0
    assert abs(action.mean()) < 0.05
    torch.manual_seed(1)
    assert torch.equal(uniform(td.clone())[entries.ACTION], action)


def test_parts_have_seeds_of_their_own():
    seeds = [mixture.part_seed(seed, policy, part) for seed in (0, 1) for policy in (0, 1) for part in range(3)]
    assert len(set(seeds)) == 12


def test_policies_act_in_the_same_or_are_refused():
    basic, wall = POLICY.format(task="basic"), POLICY.format(task="wall")
    with pytest.raises(UserError, match=f"{wall} acts in another task than {basic}: add task=NAME for both"):
        mixture.load([basic, "random", wall], [1, 1, 1], 10, "cpu", [])
    behaviours, config = mixture.load([basic, "random", wall], [1, 2, 1], 10, "cpu", ["task=wall"])
    assert config.task.name == "wall"
    assert [one.about["transitions"] for one in behaviours] == [3, 5, 2]
    assert [one.about["label"] for one in behaviours] == ["softgm", "random", "softgm"]
    with pytest.raises(UserError, match="name a task too"):
        mixture.load(["random"], [1], 10, "cpu", [])
    with pytest.raises(UserError, match=f"transitions=10: {basic} would have none"):
        mixture.load(["random", basic], [1000, 1], 10, "cpu", ["task=basic"])
