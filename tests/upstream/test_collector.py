import pytest
import torch
from tensordict.nn import TensorDictModule

from softgm_bench.envs import entries, make_env
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.upstream.collector import FrameCollector


@pytest.fixture
def build(settings):
    """A collector of noisy frames: what is shown next cannot be had from the environment again."""
    config = settings("task=wall", "perturbation=noise")
    made = []

    def collector(seed):
        rod = RodParameters(n_elements=20, substeps=2)
        env = make_env(config.task, rod, 3, seed, horizon=5, stagger=True, perturbation=config.perturbation)
        policy = TensorDictModule(lambda place: place[..., :2].sin(), [entries.AGENT_POSITION], [entries.ACTION])
        made.append(FrameCollector(env, policy, 12))
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
