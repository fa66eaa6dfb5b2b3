"""Gradient steps that are recorded as CUDA graphs learn what plain ones do; the graph is a stand-in on the CPU."""

import itertools
from copy import deepcopy

import pytest
import torch

from dense import force_dense
from off_policy_cases import SHORT, SMALL, batches
from pairwise import partly
from recordings import Broken, Repetition, recordings
from round_trips import RoundTrips
from softgm_bench.algorithms import build_algorithm
from softgm_bench.envs import make_env

pytestmark = pytest.mark.usefixtures("one_thread")

ON_POLICY, OFF_POLICY = ("softgm", "mappo", "ippo"), ("masac", "isac", "maddpg", "iddpg")
# 32 frames an iteration: two minibatches of the usual size and an odd one
PPO = ("algo.epochs=2", "algo.minibatch_size=12", "algo.target_kl=0.001", "algo.lr_schedule=linear")


@pytest.fixture
def build(settings):
    def algorithm(name, recorded):
        small = PPO if name in ON_POLICY else SMALL
        config = settings("task=wall", f"algo={name}", *small)
        torch.manual_seed(0)
        env = make_env(config.task, SHORT, num_envs=4, seed=0, horizon=7)
        one = build_algorithm(config.algo, config.model, env)
        if recorded:
            one.use_graphs()
        return one, env

    return algorithm


@pytest.fixture
def learn(build):
    def metrics(name, recorded, iterations=3):
        one, env = build(name, recorded)
        with force_dense():
            rows = [one.update(batch) for batch in batches(one, env, iterations)]
        return one, rows

    return metrics


def assert_same(rows, expected):
    for row, other in zip(rows, expected, strict=True):
        assert row == pytest.approx(other, rel=1e-4, abs=1e-5, nan_ok=True)


@pytest.mark.parametrize("kind", [Repetition, Broken])
@pytest.mark.parametrize("name", partly([*ON_POLICY, *OFF_POLICY], ["softgm", "masac", "maddpg"]))
def test_recorded_steps_learn_what_plain_ones_do(learn, name, kind):
    plain, expected = learn(name, recorded=False)
    with recordings(kind) as log:
        recorded, rows = learn(name, recorded=True)
    assert_same(rows, expected)
    assert log.count("record") == 1
    assert (log.count("replay") > 0) == (kind is Repetition)
    for key, value in plain.policy.state_dict().items():
        torch.testing.assert_close(recorded.policy.state_dict()[key], value, rtol=1e-4, atol=1e-5)


def test_as_many_gradient_steps_are_taken_and_learning_rates_reach_them(learn):
    with recordings() as log:
        recorded, rows = learn("softgm", recorded=True)
    assert log.count("replay") == 3 * 2 * 2
    plain, _ = learn("softgm", recorded=False)
    for one, other in zip(recorded._optimizers, plain._optimizers, strict=True):
        steps = [{int(state["step"]) for state in each.state.values()} for each in (one, other)]
        assert steps == [{3 * 2 * 3}] * 2
        assert float(one.param_groups[0]["lr"]) == pytest.approx(other.param_groups[0]["lr"])
    assert float(recorded.actor_optimizer.param_groups[0]["lr"]) == pytest.approx(rows[-1]["actor_lr"])
    assert rows[-1]["actor_lr"] < recorded.config.actor_lr


def test_sigma_moves_under_a_recorded_step(build):
    with recordings(), force_dense():
        one, env = build("mappo", recorded=True)
        (batch,) = batches(one, env)
        sigma = dict(one.policy.named_parameters())["module.0.sigma"]
        seen = [sigma.detach().clone()]
        for _ in range(3):
            one.update(batch)
            seen.append(sigma.detach().clone())
    assert all(not torch.equal(before, after) for before, after in itertools.pairwise(seen))


@pytest.mark.parametrize("name", partly(["softgm", "masac"], ["masac"]))
@pytest.mark.parametrize(("before", "after"), [(True, True), (True, False), (False, True)])
def test_a_checkpoint_resumes_recorded_or_not(build, name, before, after):
    with recordings() as log, force_dense():
        one, env = build(name, before)
        frames = list(batches(one, env, 4))
        for batch in frames[:2]:
            one.update(batch)
        state = deepcopy(one.state_dict())  # as a file holds it
        other, _ = build(name, after)
        other.update(frames[3])  # something else, recorded already
        other.load_state_dict(state)
        if name == "masac":
            other.replay.load_state_dict(one.replay.state_dict())
        rows = []
        for each in (one, other):
            torch.manual_seed(5)
            rows.append([each.update(batch) for batch in frames[2:]])
    assert_same(*rows)
    assert log.count("record") == 1 * before + 2 * after
    kept = other.state_dict()
    groups = (
        [kept[f"{part}_optimizer"] for part in ("actor", "critic")] if name == "softgm" else kept["optimizers"].values()
    )
    for group in groups:
        assert isinstance(group["param_groups"][0]["lr"], float)
        assert not group["param_groups"][0]["capturable"]


@pytest.mark.parametrize("name", [*ON_POLICY, *OFF_POLICY])
def test_nothing_in_a_step_waits_for_a_device(build, name):
    with recordings(), force_dense():
        one, env = build(name, recorded=True)
        found = []
        step = one._recorded._function

        def watched(inputs):
            with RoundTrips() as trips:
                metrics = step(inputs)
            found.append(trips.found)
            return metrics

        one._recorded._function = watched
        for batch in batches(one, env, 2):
            one.update(batch)
    assert found
    assert not any(found)


def test_plain_steps_stay_plain(build):
    one, _ = build("softgm", recorded=False)
    assert one._recorded is None
    assert isinstance(one.actor_optimizer.param_groups[0]["lr"], float)
