"""TorchRL's own classes read the files without code of ours, and find what our loader gives."""

import pytest
import torch
from small import POLICY, Asked, write
from tensordict import TensorDict
from torchrl.collectors.utils import split_trajectories
from torchrl.data import SliceSampler, TensorDictReplayBuffer, TensorStorage
from torchrl.envs.transforms import NextStateReconstructor

from softgm_bench.datasets.reading import load
from softgm_bench.errors import UserError

PLAIN = [("agents", "position"), ("agents", "velocity"), ("agents", "previous_action"), "tip", "target"]


@pytest.fixture(scope="module")
def wall(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wall") / "x"
    write(folder, Asked(["random", POLICY.format(task="wall")], transitions=60, horizon=10, chunk=20))
    return folder


def test_torchrl_alone_draws_from_a_mapped_chunk_what_our_storage_gives(wall):
    frames = TensorDict.load_memmap(wall / "chunk-00000.tdz")["frames"]
    buffer = TensorDictReplayBuffer(
        storage=TensorStorage(frames),
        sampler=SliceSampler(slice_len=2, traj_key="episode", truncated_key=None, init_key=None),
        transform=NextStateReconstructor(PLAIN, traj_key="episode", done_key=None),
        batch_size=400,
    )
    drawn = buffer.sample()[::2]  # of each pair of frames the first, whose next one was beside it
    ours, storage = load(wall), load(wall).storage()
    begin = torch.as_tensor(ours.episodes["begin"])[drawn["episode"].long()]
    before = torch.as_tensor(ours.episodes["length"]).cumsum(0) - torch.as_tensor(ours.episodes["length"])
    index = drawn["index"].reshape(-1) - begin + before[drawn["episode"].long()]
    assert len(index.unique()) > 10
    expected = storage[index]
    for key in PLAIN:
        assert torch.equal(drawn[key], expected[key])
        following = ("next", key) if isinstance(key, str) else ("next", *key)
        assert torch.equal(drawn[following], expected[following])
    for key in (("agents", "action"), ("next", "reward"), ("next", "done"), ("next", "terminated"), "policy"):
        assert torch.equal(drawn[key], expected[key])


def test_a_buffer_draws_every_transition_of_all_chunks(wall):
    data = load(wall)
    assert len(set(data.episodes["chunk"].tolist())) > 1
    buffer = data.replay_buffer(2000)
    assert len(buffer) == data.transitions
    sample = buffer.sample()
    assert len(sample["index"].unique()) == data.transitions
    assert torch.equal(sample["next", "reward"], data.storage()[sample["index"]]["next", "reward"])
    assert not sample["next", "is_init"].any()
    assert ("next", "reward_terms", "time") not in sample.keys(True)
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        buffer.extend(sample)
    with pytest.raises(RuntimeError, match="doesn't allow writing"):
        buffer.empty()


def test_slices_are_consecutive_steps_of_an_episode(wall):
    data = load(wall)
    sample = data.replay_buffer(120, slice_length=4).sample().reshape(-1, 4)
    assert (sample["episode"] == sample["episode"][:, :1]).all()
    index = sample["index"].reshape(-1, 4)
    assert (index.diff(dim=1) == 1).all()
    assert torch.equal(sample["tip"][:, 1:], sample["next", "tip"][:, :-1])
    assert torch.equal(sample["slots", "descriptor"][:, 1:], sample["next", "slots", "descriptor"][:, :-1])
    assert sample["next", "done"][:, -1].all()  # TorchRL marks a slice's end as truncated
    split = split_trajectories(data.replay_buffer(40, slice_length=4).sample(), done_key="truncated")
    assert split.shape == (10, 4)


def test_a_single_episode_has_slices_too(tmp_path):
    write(tmp_path / "x", Asked(["random"], ["task=basic"], transitions=3, batch=1))
    data = load(tmp_path / "x")
    assert len(data.episodes["length"]) == 1
    index = data.replay_buffer(60, slice_length=3).sample()["index"].reshape(-1, 3)
    assert (index.diff(dim=1) == 1).all()
    assert set(index[:, 0].tolist()) == set(range(data.transitions - 2))


def test_one_policy_of_the_mixture_can_be_taken_alone(wall):
    data = load(wall)
    counts = [len(data.storage(policy=number)) for number in range(2)]
    assert sum(counts) == data.transitions
    assert (data.storage(policy=1)[:]["policy"] == 1).all()
    assert (data.replay_buffer(51, slice_length=3, policy=1).sample()["policy"] == 1).all()
    with pytest.raises(UserError, match="policy=2: the data set has 0 to 1"):
        data.storage(policy=2)


def test_all_kinds_of_index_mean_the_same(wall):
    storage = load(wall).storage(reward_terms=True)
    whole = storage[:]
    order = torch.randperm(len(storage), generator=torch.Generator().manual_seed(0))
    for index in (order, order.tolist(), (order,), order - len(storage)):
        assert (storage[index] == whole[order]).all()
    assert (storage[3] == whole[3]).all()
    assert (storage[torch.tensor(3)] == whole[3]).all()
    assert storage[[]].shape == (0,)
    for outside in (len(storage), -len(storage) - 1):
        with pytest.raises(IndexError):
            storage[[outside]]
    assert whole["next", "reward_terms", "time"].shape == (len(storage), 1)


def test_a_dataset_is_refused_until_it_is_finished(wall, tmp_path):
    with pytest.raises(UserError, match="no data set here"):
        load(tmp_path)
    copy = tmp_path / "x"
    copy.mkdir()
    for name in ("dataset.json", "chunk-00000.tdz"):
        (copy / name).write_bytes((wall / name).read_bytes())
    with pytest.raises(UserError, match="has not finished"):
        load(copy)
    assert 0 < load(copy, unfinished=True).transitions < load(wall).transitions
    (copy / "chunk-00000.tdz").unlink()
    with pytest.raises(UserError, match="no chunk"):
        load(copy, unfinished=True)
