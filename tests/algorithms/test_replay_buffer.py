import pytest
import torch
from hypothesis import given
from hypothesis import settings as trials
from hypothesis import strategies as st
from tensordict import TensorDict
from torchrl.collectors import Collector

from softgm_bench.algorithms.replay_buffer import FRAMES_PER_EPISODE, ReplayBuffer
from softgm_bench.envs import entries, make_env
from softgm_bench.envs.interface import Sizes
from softgm_bench.rod.parameters import RodParameters

pytestmark = pytest.mark.usefixtures("one_thread")

SAMPLED = (*entries.OBSERVATION, entries.ACTION)
SAMPLED_NEXT = (*entries.OBSERVATION, entries.REWARD, entries.DONE, entries.TERMINATED)


class Stream:
    """Random episodes of one environment, kept as they were; the reward numbers the frames."""

    def __init__(self, environment, n_agents, n_slots, ends, seed):
        self.sizes = n_agents, n_slots
        self.ends = ends
        self.random = torch.Generator().manual_seed(1000 * seed + environment)
        self.number = environment * 10_000
        self.frames, self.episode_of = [], []
        self.episode = -1
        self.begin()

    def begin(self):
        """A new episode, whether or not the previous one was done."""
        self.episode += 1
        self.table = torch.randn(self.sizes[1], 9, generator=self.random)
        self.count = 0
        self.now = self.observe()

    def observe(self):
        n_agents, n_slots = self.sizes
        self.count = min(n_slots, self.count + int(torch.randint(3, (), generator=self.random)))
        active = torch.arange(n_slots) < self.count
        td = TensorDict({}, [])
        td[entries.AGENT_POSITION] = torch.randn(n_agents, 3, generator=self.random)
        td[entries.AGENT_VELOCITY] = torch.randn(n_agents, 3, generator=self.random)
        td[entries.PREVIOUS_ACTION] = torch.randn(n_agents, 2, generator=self.random)
        td[entries.EDGE] = (torch.rand(n_agents, n_slots, generator=self.random) < 0.5) & active
        td[entries.SLOT_DESCRIPTOR] = self.table * active.unsqueeze(-1)
        td[entries.SLOT_ACTIVE] = active
        td[entries.TIP] = torch.randn(3, generator=self.random)
        td[entries.TARGET] = torch.randn(3, generator=self.random)
        return td

    def step(self):
        frame = self.now.clone()
        frame[entries.ACTION] = torch.randn(self.sizes[0], 2, generator=self.random)
        after = self.observe()
        terminated, truncated = (torch.rand(2, 1, generator=self.random) < self.ends).unbind(0)
        self.now = after.clone()
        after[entries.REWARD] = torch.tensor([float(self.number)])
        after[entries.TERMINATED], after[entries.DONE] = terminated, terminated | truncated
        frame["next"] = after
        self.number += 1
        self.frames.append(frame)
        self.episode_of.append(self.episode)
        if after[entries.DONE]:
            self.begin()
        return frame


def streams(num_envs, n_agents=2, n_slots=11, ends=0.2, seed=0):
    return [Stream(environment, n_agents, n_slots, ends, seed) for environment in range(num_envs)]


def batch_of(some, steps):
    return torch.stack([torch.stack([one.step() for _ in range(steps)]) for one in some])


def held(replay):
    """Every transition that can be sampled, by the number in its reward."""
    lower = replay._lower().tolist()
    pairs = [(time, environment) for environment, first in enumerate(lower) for time in range(first, replay._now)]
    assert len(pairs) == len(replay)
    time, environment = torch.tensor(pairs).T
    return {int(one["next", entries.REWARD]): one for one in replay._transitions(time, environment).unbind(0)}


def same(sampled, stored):
    return all(torch.equal(sampled[key], stored[key]) for key in SAMPLED) and all(
        torch.equal(sampled["next", key], stored["next", key]) for key in SAMPLED_NEXT
    )


@trials(max_examples=60, deadline=None)
@given(
    num_envs=st.integers(1, 3),
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=12),
    ends=st.sampled_from([0.0, 0.05, 0.3, 1.0]),
    rows=st.sampled_from([6, 9, 40]),
    n_slots=st.sampled_from([0, 1, 8, 11]),
    interrupted=st.sets(st.integers(0, 11)),
    seed=st.integers(0, 100),
)
def test_what_is_held_equals_what_was_stored_bit_for_bit(num_envs, lengths, ends, rows, n_slots, interrupted, seed):
    """Episodes of any length, ends of both kinds, resets between batches, rings that wrap around."""
    some = streams(num_envs, n_slots=n_slots, ends=ends, seed=seed)
    replay = ReplayBuffer(rows * num_envs, num_envs, Sizes(2, 2, n_slots=n_slots), "cpu")
    for index, steps in enumerate(lengths):
        if index in interrupted:
            some[-1].begin()
        replay.add(batch_of(some, steps))

        kept = held(replay)
        expected = {}
        for one in some:
            # the newest `rows` frames, as far as they belong to the newest `episodes` episodes
            begun = sorted(set(one.episode_of))[-replay.episodes :]
            for frame, episode in list(zip(one.frames, one.episode_of, strict=True))[-replay.rows :]:
                if episode in begun:
                    expected[int(frame["next", entries.REWARD])] = frame
        assert kept.keys() == expected.keys()
        assert all(same(kept[number], expected[number]) for number in kept)


def test_sampling_is_uniform_over_all_that_is_held():
    some = streams(2, ends=0.5)
    some[1].ends = 0.0
    replay = ReplayBuffer(64, 2, Sizes(2, 2, n_slots=11), "cpu")
    for _ in range(10):
        replay.add(batch_of(some, 5))
    assert len(held(replay)) == len(replay) < 64  # short episodes made the first environment give up old frames
    torch.manual_seed(0)
    drawn = replay.sample(20_000)["next", entries.REWARD].flatten().long()
    numbers, counts = drawn.unique(return_counts=True)
    assert set(numbers.tolist()) == held(replay).keys()
    mean = 20_000 / len(replay)
    assert (counts - mean).abs().max() < 5 * mean**0.5


def test_half_a_million_transitions_on_the_wall_fit_in_four_gibibytes(settings):
    env = make_env(settings("task=wall").task, RodParameters(), num_envs=128, seed=0)
    observation = env.reset().select(*entries.OBSERVATION)
    plain = 2 * sum(value.nbytes for value in observation.values(True, True)) / 128  # now and next, as they come
    replay = ReplayBuffer(25_600, 128, env.sizes, "cpu")
    owned = [value for value in vars(replay).values() if isinstance(value, torch.Tensor)]
    owned += [value for group in (replay._frames, replay._last) for value in group.values()]
    taken = sum(tensor.untyped_storage().nbytes() for tensor in owned) / 25_600
    assert replay.bytes_per_transition == pytest.approx(taken, rel=0.01)
    assert 500_000 * taken < 2**30 / 2
    assert taken < plain / 10


def test_transitions_of_the_arm_come_back_as_they_were(settings):
    """Real frames with discovered bins, edges, truncations and the resets of a collector."""
    config = settings("task=wall", "task.sensing_radius=0.4")
    env = make_env(config.task, RodParameters(substeps=5), num_envs=3, seed=0, horizon=4)
    replay = ReplayBuffer(240, 3, env.sizes, "cpu")
    collector = Collector(env, None, frames_per_batch=9, total_frames=54)
    frames = []
    for batch in collector:
        replay.add(batch)
        frames += [batch[environment, step].clone() for environment in range(3) for step in range(3)]
    collector.shutdown()
    environments = [number % 9 // 3 for number in range(54)]
    sampled = []
    for environment in range(3):
        time = torch.arange(18)
        sampled += list(replay._transitions(time, torch.full_like(time, environment)).unbind(0))
    stored = [
        frame for environment in range(3) for frame, of in zip(frames, environments, strict=True) if of == environment
    ]
    assert len(replay) == len(stored) == 54
    assert all(same(one, other) for one, other in zip(sampled, stored, strict=True))
    assert sum(frame["next", entries.DONE].item() for frame in stored) >= 12
    assert max(int(frame[entries.SLOT_ACTIVE].sum()) for frame in stored) > 5
    assert max(int(frame[entries.EDGE].sum()) for frame in stored) > 5


def test_a_loaded_memory_holds_and_samples_the_same():
    some = streams(2)
    replay, other = (ReplayBuffer(40, 2, Sizes(2, 2, n_slots=11), "cpu") for _ in range(2))
    replay.add(batch_of(some, 7))
    other.load_state_dict(replay.state_dict())
    for memory in (replay, other):
        memory.drawn = (torch.manual_seed(3), memory.sample(50))[1]
    assert (replay.drawn == other.drawn).all()
    more = batch_of(some, 9)
    replay.add(more)
    other.add(more)
    kept, loaded = held(replay), held(other)
    assert kept.keys() == loaded.keys()
    assert all(same(kept[number], loaded[number]) for number in kept)


def test_what_cannot_be_stored_is_refused_with_a_reason():
    with pytest.raises(ValueError, match=r"replay_capacity is 7.* two frames of each of 4 environments"):
        ReplayBuffer(7, 4, Sizes(2, 2, n_slots=11), "cpu")
    replay = ReplayBuffer(FRAMES_PER_EPISODE, 2, Sizes(2, 2, n_slots=11), "cpu")
    with pytest.raises(ValueError, match="it must hold the 10 frames of one iteration"):
        replay.add(batch_of(streams(2), 5))
    gap = batch_of(streams(2), 3)
    gap[entries.SLOT_ACTIVE] = torch.arange(11).expand(2, 3, 11) == 4
    with pytest.raises(ValueError, match="are not its first ones"):
        replay.add(gap)
