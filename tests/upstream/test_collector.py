import pytest
import torch
from tensordict.nn import TensorDictModule

from dense import force_dense
from recordings import Broken, Repetition, recordings
from round_trips import RoundTrips
from softgm_bench.envs import entries, make_env
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.upstream.collector import FrameCollector, RecordingCollector


@pytest.fixture
def build(settings):
    """A collector of noisy frames: what is shown next cannot be had from the environment again."""
    config = settings("task=wall", "perturbation=noise")
    made = []

    def collector(seed, kind=FrameCollector, act=torch.sin):
        rod = RodParameters(n_elements=20, substeps=2)
        env = make_env(config.task, rod, 3, seed, horizon=5, stagger=True, perturbation=config.perturbation)
        policy = TensorDictModule(lambda place: act(place[..., :2]), [entries.AGENT_POSITION], [entries.ACTION])
        made.append(kind(env, policy, 12))
        return env, made[-1]

    yield collector
    for one in made:
        one.shutdown()


def leaves(td):
    return dict(td.items(include_nested=True, leaves_only=True))


def test_batches_go_on_bit_for_bit_from_the_place_between_two(build):
    (env, one), (other_env, other) = build(0), build(1)
    batches, others = iter(one), iter(other)
    next(batches), next(others)
    state, generator, shown = env.simulation_state(), env.generator_state(), one.shown()
    expected = [leaves(next(batches).clone()) for _ in range(3)]  # what was shown is a copy
    other_env.load_simulation_state(state)
    other_env.set_generator_state(generator)
    other.show(shown)
    found = [leaves(next(others).clone()) for _ in range(3)]
    for first, second in zip(expected, found, strict=True):
        assert first.keys() == second.keys()
        assert all(torch.equal(first[key], second[key]) for key in first)


def test_batches_never_end(build):
    batches = iter(build(0)[1])
    assert sum(next(batches).numel() for _ in range(4)) == 48


def noisy(place):
    return place.sin() + 0.1 * torch.randn_like(place)


@pytest.mark.parametrize("kind", [Repetition, Broken])
def test_recorded_steps_collect_the_same_frames(build, kind):
    """Bit for bit: random numbers go on, episodes end and begin, and attempts to record leave no trace."""
    with force_dense(), recordings(kind) as log:
        frames = []
        for collector in (FrameCollector, RecordingCollector):
            torch.manual_seed(3)
            batches = iter(build(0, collector, noisy)[1])
            frames.append([leaves(next(batches).clone()) for _ in range(5)])
    for plain, recorded in zip(*frames, strict=True):
        assert plain.keys() == recorded.keys()
        assert all(torch.equal(plain[key], recorded[key]) for key in plain)
    assert any(batch[("next", "done")].any() for batch in frames[1])
    assert log.count("record") == 1
    assert log.count("replay") == (4 * 4 if kind is Repetition else 0)


def test_recorded_collection_resumes_from_a_place_between_two_batches(build):
    with force_dense(), recordings():
        (env, one), (other_env, other) = build(0, RecordingCollector), build(1, RecordingCollector)
        batches, others = iter(one), iter(other)
        for _ in range(3):
            next(batches), next(others)
        state, generator, shown = env.simulation_state(), env.generator_state(), one.shown()
        expected = [leaves(next(batches).clone()) for _ in range(3)]
        other_env.load_simulation_state(state)
        other_env.set_generator_state(generator)
        other.show(shown)
        found = [leaves(next(others).clone()) for _ in range(3)]
    for first, second in zip(expected, found, strict=True):
        assert all(torch.equal(first[key], second[key]) for key in first)


def test_a_recorded_step_replaces_no_tensor_and_waits_for_nothing(build):
    with force_dense(), recordings():
        env, one = build(0, RecordingCollector)
        batches = iter(one)
        for _ in range(2):
            next(batches)
        places = [tensor.data_ptr() for tensor in one._changed()[: -len(env.tensors())]]
        held = [value.data_ptr() for value in leaves(env.simulator.state).values()]
        with RoundTrips() as trips:
            for _ in range(6):
                one._step()
        assert trips.found == []
        assert held == [value.data_ptr() for value in leaves(env.simulator.state).values()]
        assert places == [tensor.data_ptr() for tensor in one._changed()[: -len(env.tensors())]]
