"""A GPU is never waited for inside the environment: shown without one, and that both ways do the same."""

import pytest
import torch
from torchrl.envs import EnvBase

from dense import force_dense
from round_trips import RoundTrips
from softgm_bench.envs import SoftArmEnv, entries, make_env
from softgm_bench.rod.parameters import RodParameters

TASKS = ("basic", "structured", "wall", "wall_sliding", "swinging_posts")


class Standing:
    """A rod that does not move, so that only the environment's own operations are seen."""

    def __init__(self, parameters: RodParameters) -> None:
        self.parameters = parameters

    def control_step(self, state, couple, **others):
        return state.clone()


@pytest.fixture
def build(settings):
    def environment(task, num_envs=6, substeps=20, **options):
        config = settings(f"task={task}")
        return make_env(config.task, RodParameters(substeps=substeps), num_envs=num_envs, seed=0, **options)

    return environment


def actions(env, steps):
    generator = torch.Generator().manual_seed(1)
    return 2.0 * torch.rand((steps, *env.batch_size, env.sizes.n_agents, 2), generator=generator) - 1.0


def leaves(td):
    return dict(td.items(include_nested=True, leaves_only=True))


def stepped(env):
    """What six steps, and the resets among them, wait for on another device's way, and the last frame."""
    env.simulator.backend = Standing(env.backend.parameters)
    td = env.reset()
    with force_dense():
        env.step_and_maybe_reset(td.clone().set(entries.ACTION, actions(env, 1)[0]))  # constants are copied once
        with RoundTrips() as trips:
            for action in actions(env, 6):
                _, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
    return trips.found, td


@pytest.mark.parametrize("task", TASKS)
def test_neither_steps_nor_resets_wait_for_a_device(build, task):
    found, td = stepped(build(task, horizon=3, stagger=True))
    assert found == []
    assert not td["done"].any()  # the horizon has come by, so there were resets


def test_the_same_watch_finds_the_cpus_shortcuts(build):
    env = build("wall")
    with RoundTrips() as trips:
        env.step_and_maybe_reset(env.reset().set(entries.ACTION, actions(env, 1)[0]))
    assert any("sync.py" in found for found in trips.found)


@pytest.mark.parametrize("task", TASKS)
def test_a_step_can_be_taken_where_tensors_have_no_values_and_no_cpu_tensor_joins_in(build, task):
    """On the meta device a look at any value raises, and so does an operation between two devices."""
    env = build(task)
    env.simulator.backend = Standing(env.backend.parameters)
    td = env.reset().set(entries.ACTION, actions(env, 1)[0])
    expected = leaves(env._step(td))
    vars(env)["_device"] = torch.device("meta")  # env.to() would look at the bounds in the specs
    vars(env.simulator)["device"] = torch.device("meta")
    for owner in (vars(env), vars(env.simulator)):
        owner.update({name: value.to("meta") for name, value in owner.items() if isinstance(value, torch.Tensor)})
    env.simulator.state = env.simulator.state.to("meta")
    env.simulator._actuation.matrix = env.simulator._actuation.matrix.to("meta")
    found = leaves(env._step(td.to("meta")))
    assert found.keys() == expected.keys()
    for key, value in found.items():
        assert value.device.type == "meta", key
        assert value.shape == expected[key].shape, key
        assert value.dtype == expected[key].dtype, key


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_both_ways_make_the_same_episodes_bit_by_bit(build, task, dtype):
    def play(env, td):
        frames = []
        push = actions(env, 40).mul_(0.3)
        push[..., 0] += 0.6  # towards the wall
        for step, action in enumerate(push):
            if step == 20:  # one of them breaks
                state = env.simulation_state()
                state["episodes", "rod", "velocity"][2, 0, 5] = float("nan")
                env.load_simulation_state(state)
            td = env.step(td.exclude("next", "reward").set(entries.ACTION, action))["next"]
            frames.append(leaves(td))
        return frames

    def begin():
        env = build(task, substeps=100, dtype=dtype)
        return env, env.reset()

    compiled = play(*begin())
    started = begin()
    with force_dense():
        dense = play(*started)
    if task != "basic":
        assert compiled[-1]["info", "discovered"].sum() > 0
    assert compiled[-1]["terminated"].squeeze(-1).sum() >= 1
    for step, (one, other) in enumerate(zip(compiled, dense, strict=True)):
        assert one.keys() == other.keys()
        for key in one:
            assert torch.equal(one[key], other[key]), (step, key)


@pytest.mark.parametrize("blind", [False, True], ids=["compiled", "dense"])
@pytest.mark.parametrize("task", ["basic", "wall"])
def test_automatic_resets_equal_torchrls_and_leave_the_last_frames_alone(build, task, blind):
    def play(maybe_reset):
        env = build(task, horizon=4, stagger=True)
        td, frames, resets = env.reset(), [], 0
        for action in actions(env, 9):
            out = env.step(td.set(entries.ACTION, action))
            last = leaves(out["next"].clone())
            resets += int(last["done"].sum())
            td = maybe_reset(env, env._step_mdp(out))
            assert all(torch.equal(value, last[key]) for key, value in leaves(out["next"]).items())
            frames.append({key: value.clone() for key, value in leaves(td).items() if key != entries.ACTION})
        assert resets > 6
        return frames

    def both():
        return play(SoftArmEnv.maybe_reset), play(EnvBase.maybe_reset)

    if blind:
        with force_dense():
            ours, theirs = both()
    else:
        ours, theirs = both()
    for one, other in zip(ours, theirs, strict=True):
        assert one.keys() == other.keys()
        for key in one:
            assert torch.equal(one[key], other[key]), key
