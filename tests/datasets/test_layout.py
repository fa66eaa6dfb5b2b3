import torch
from hypothesis import given
from hypothesis import strategies as st
from tensordict import TensorDict

from softgm_bench.datasets import layout


@given(st.integers(0, 40), st.integers(0, 5), st.integers(0, 2**31))
def test_flags_come_back_from_their_bits(slots, rows, seed):
    flags = torch.rand(rows, 2, slots, generator=torch.Generator().manual_seed(seed)) < 0.5
    packed = layout.bits(flags)
    assert packed.shape == (rows, 2, -(-slots // 8))
    assert torch.equal(layout.flags(packed, slots), flags)


def test_the_first_flag_is_the_lowest_bit():
    assert layout.bits(torch.tensor([True] + [False] * 8 + [True])).tolist() == [1, 2]


def content(first, frames, rows):
    """A file's content with ``rows`` of a table that count from ``first``."""
    slots = TensorDict({"begin": torch.arange(frames) % rows, "count": torch.ones(frames)}, [frames])
    return TensorDict(
        {
            layout.FRAMES: TensorDict({"slots": slots}, [frames]),
            layout.TABLE: TensorDict({"descriptor": first + torch.arange(rows).unsqueeze(-1)}, [rows]),
            layout.EPISODES: TensorDict({"begin": torch.tensor([0])}, [1]),
        }
    )


def test_joined_files_say_of_every_frame_what_they_said_before():
    parts = [content(100, 5, 3), content(200, 4, 2)]
    whole = layout.joined(parts)
    assert whole[layout.EPISODES, "begin"].tolist() == [0, 5]
    told = whole[layout.TABLE, "descriptor"].squeeze(-1)[whole[layout.FRAMES, "slots", "begin"]]
    assert told.tolist() == [100, 101, 102, 100, 101, 200, 201, 200, 201]
    assert parts[1][layout.FRAMES, "slots", "begin"].tolist() == [0, 1, 0, 1]  # the parts stay as they were
