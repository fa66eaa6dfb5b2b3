"""CUDA graphs on a GPU; skipped where there is none. What surrounds them is tested on the CPU, with a stand-in."""

import pytest
import torch
from tensordict import TensorDict

from softgm_bench.algorithms import build_algorithm
from softgm_bench.envs import make_env
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.upstream import graphs
from softgm_bench.upstream.collector import FrameCollector, RecordingCollector

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU here")]

SHORT = RodParameters(substeps=5)


def device():
    return torch.device("cuda", torch.cuda.current_device())


class Walk:
    """A random walk by two generators."""

    def __init__(self, spoilt=lambda: None):
        torch.manual_seed(0)
        self.generator = torch.Generator(device())
        self.generator.manual_seed(1)
        self.place, self.spoilt = torch.zeros(1000, device=device()), spoilt
        self.recorded = graphs.Recorded(self.step, lambda: [self.place], device(), "the walk", [self.generator])

    def step(self, inputs):
        self.spoilt()
        own = torch.empty_like(self.place).normal_(generator=self.generator)
        self.place += inputs["by"] * (torch.randn_like(self.place) + own)
        return self.place.clone()

    def go(self, call, steps=4):
        return [call(TensorDict({"by": torch.full((1000,), 1.0 + k, device=device())}, [1000])) for k in range(steps)]


def test_replays_draw_new_random_numbers_and_those_of_plain_calls():
    plain, recorded = Walk(), None
    expected = plain.go(plain.step)
    recorded = Walk()
    found = recorded.go(recorded.recorded)
    assert not recorded.recorded.failed
    assert not torch.equal(found[0], (found[1] - found[0]) / 2.0)
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))


def refuse_recording():
    if torch.cuda.is_current_stream_capturing():
        raise RuntimeError("not here")


def wait():
    torch.zeros((), device=device()).item()


def wait_while_recording():
    if torch.cuda.is_current_stream_capturing():
        wait()


@pytest.mark.parametrize("spoilt", [refuse_recording, wait, wait_while_recording])
def test_a_failed_recording_leaves_no_trace(spoilt, capsys):
    plain = Walk()
    expected = plain.go(plain.step)
    recorded = Walk(spoilt)
    found = recorded.go(recorded.recorded)
    assert recorded.recorded.failed
    assert capsys.readouterr().err.count("\n") == 1
    assert torch.cuda.current_stream() == torch.cuda.default_stream()
    assert torch.cuda.get_sync_debug_mode() == 0
    assert all(torch.equal(*pair) for pair in zip(found, expected, strict=True))
    again = Walk()  # the generators and the device are as good as new
    assert torch.equal(again.go(again.recorded)[-1], expected[-1])
    assert not again.recorded.failed


@pytest.fixture
def build(settings):
    def run(name, recorded):
        small = ("algo.epochs=2", "algo.minibatch_size=48", "algo.target_kl=0.001", "algo.lr_schedule=linear")
        if name == "masac":
            small = ("algo.batch_size=16", "algo.replay_capacity=400", "algo.random_frames=0")
        config = settings("task=wall", f"algo={name}", *small)
        torch.manual_seed(0)
        options = {"horizon": 7, "stagger": True, "device": device(), "dtype": torch.float32}
        env = make_env(config.task, SHORT, 16, 0, **options)
        algorithm = build_algorithm(config.algo, config.model, env)
        if recorded:
            algorithm.use_graphs()
        kind = RecordingCollector if recorded and name != "masac" else FrameCollector
        return algorithm, kind(env, algorithm.policy, 16 * 8)

    return run


@pytest.mark.parametrize("name", ["softgm", "mappo", "masac"])
def test_recorded_training_is_plain_training(build, name):
    rows, frames = [], []
    for recorded in (False, True):
        algorithm, collector = build(name, recorded)
        batches = iter(collector)
        for _ in range(4):
            batch = next(batches)
            frames.append(batch.clone())
            rows.append(algorithm.update(batch))
        collector.shutdown()
        if recorded:
            assert not algorithm._recorded.failed
            assert name == "masac" or not collector._advance.failed
    for plain, other in zip(frames[:2], frames[4:6], strict=True):
        for key in plain.keys(True, True):
            torch.testing.assert_close(other[key], plain[key], rtol=1e-3, atol=1e-3)
    for plain, other in zip(rows[:2], rows[4:6], strict=True):
        assert other == pytest.approx(plain, rel=1e-2, abs=1e-3, nan_ok=True)
    assert len({row["loss_actor" if name == "masac" else "loss_objective"] for row in rows[4:]}) == 4


def test_no_bit_of_a_recorded_collection_differs(build):
    """The same policy all the time, so that nothing but the collection can differ."""
    frames = []
    for recorded in (False, True):
        _, collector = build("softgm", recorded)
        batches = iter(collector)
        frames.append([next(batches).clone() for _ in range(4)])
        collector.shutdown()
    for plain, other in zip(*frames, strict=True):
        for key in plain.keys(True, True):
            assert torch.equal(plain[key], other[key]), key
