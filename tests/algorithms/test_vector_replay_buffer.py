import pytest
import torch
from tensordict import TensorDict

from softgm_bench.algorithms.vector_replay_buffer import VectorReplayBuffer
from softgm_bench.envs import entries
from softgm_bench.envs.vmas import OBSERVATION


def frames(first, envs=2, steps=3):
    """Frames that carry their own number in every entry."""
    number = (first + torch.arange(envs * steps, dtype=torch.float32)).view(envs, steps, 1)
    agents = number.unsqueeze(-1).expand(envs, steps, 4, 5)
    flag = number.long() % 2 == 0
    after = {"agents": {"observation": agents + 0.5}, "reward": -number, "done": flag, "terminated": ~flag}
    before = {"agents": {"observation": agents, "action": agents[..., :2], "state_value": agents[..., :1]}}
    return TensorDict({**before, "next": after}, [envs, steps])


def test_a_sample_is_a_stored_transition():
    replay = VectorReplayBuffer(100, "cpu")
    replay.add(frames(0))
    sample = replay.sample(64)
    number = sample[OBSERVATION][:, 0, 0]
    assert set(number.tolist()) == set(range(6))
    assert torch.equal(sample[entries.ACTION][:, 3, 1], number)
    assert torch.equal(sample["next", *OBSERVATION][:, 3, 4], number + 0.5)
    assert torch.equal(sample["next", entries.REWARD].squeeze(-1), -number)
    assert torch.equal(sample["next", entries.DONE].squeeze(-1), number % 2 == 0)
    assert torch.equal(sample["next", entries.TERMINATED].squeeze(-1), number % 2 == 1)


def test_the_newest_are_kept():
    replay = VectorReplayBuffer(8, "cpu")
    for first in (0, 6, 12):
        replay.add(frames(first))
    assert (len(replay), replay.stored) == (8, 18)
    assert set(replay.sample(200)[OBSERVATION][:, 0, 0].tolist()) == set(range(10, 18))


def test_more_than_it_holds_is_refused():
    with pytest.raises(ValueError, match=r"algo\.replay_capacity is 5: it must hold the 6 frames"):
        VectorReplayBuffer(5, "cpu").add(frames(0))


def test_a_saved_memory_goes_on_exactly():
    replay, other = VectorReplayBuffer(8, "cpu"), VectorReplayBuffer(8, "cpu")
    replay.add(frames(0))
    other.load_state_dict(replay.state_dict())
    for memory in (replay, other):
        memory.add(frames(6))
    torch.manual_seed(0)
    expected = replay.sample(32)
    torch.manual_seed(0)
    assert bool((other.sample(32) == expected).all())
