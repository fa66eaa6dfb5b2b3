"""Runs that begin with a trained policy."""

import json
import signal

import pytest
import torch
from interrupted import PPO, SMALL, TINY, written

from kept_threads import kept_threads
from softgm_bench.config import compose
from softgm_bench.episodes import policy
from softgm_bench.errors import UserError
from softgm_bench.runs.interruption import Interrupted
from softgm_bench.runs.loop import train
from softgm_bench.runs.metrics import CsvWriter


@pytest.fixture(autouse=True)
def _threads_as_before():
    with kept_threads():
        yield


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A run folder of SoftGM's on `basic`."""
    folder = tmp_path_factory.mktemp("trained") / "run"
    with kept_threads():
        train(compose([*SMALL, "seed=3", f"run_dir={folder}"]))
    return folder


def state(folder):
    return policy.load(folder).policy.state_dict()


def same(one, other):
    return all(torch.equal(one[name], other[name]) for name in one)


@pytest.mark.parametrize("there", ["task=basic", "task=wall"])
def test_as_long_as_the_critic_learns_alone_a_run_acts_as_what_it_began_with(trained, tmp_path, there):
    """On another task too: SoftGM's parameters depend on no number of agents or obstacles."""
    waiting = (f"start.policy={trained}", "start.critic_frames=160")
    train(compose([*SMALL, there, *waiting, f"run_dir={tmp_path / 'held'}"]))
    assert same(state(trained), state(tmp_path / "held"))
    summary = json.loads((tmp_path / "held" / "summary.json").read_text())
    assert summary["algo"] == "softgm_started"
    assert summary["frames"] == 160
    assert summary["start"]["frames"] == 160
    assert summary["start"]["fingerprint"] == policy.fingerprint(policy.load(trained))


def test_then_it_learns(trained, tmp_path):
    train(compose([*SMALL, f"start.policy={trained}", "start.critic_frames=32", f"run_dir={tmp_path / 'run'}"]))
    assert not same(state(trained), state(tmp_path / "run"))


def test_a_run_that_began_with_a_policy_is_resumed_without_it(trained, tmp_path, monkeypatch):
    """The actor goes on waiting where it had to, and the policy's file may be gone."""
    moved = tmp_path / "policy.pt"
    policy.save(policy.load(trained), moved)
    settings = [*SMALL, f"start.policy={moved}", "start.critic_frames=96", "experiment.checkpoint.interval=16"]
    train(compose([*settings, f"run_dir={tmp_path / 'whole'}"]))

    def interrupt(self, row, _write=CsvWriter.write):
        _write(self, row)
        if row.get("frames") == 64:
            raise Interrupted(signal.SIGINT)

    with monkeypatch.context() as patch:
        patch.setattr(CsvWriter, "write", interrupt)
        with pytest.raises(Interrupted):
            train(compose([*settings, f"run_dir={tmp_path / 'parts'}"]))
    moved.unlink()
    train(compose([*settings, f"run_dir={tmp_path / 'parts'}", "resume=true"]))
    assert written(tmp_path / "parts") == written(tmp_path / "whole")


def refusal(*overrides, folder):
    with pytest.raises(UserError) as refused:
        train(compose([*overrides, f"run_dir={folder}"]))
    assert not folder.exists() or not any(folder.iterdir())
    (line,) = str(refused.value).splitlines()
    return line


def test_what_cannot_be_begun_with_is_refused_in_a_line_before_anything_is_written(trained, tmp_path):
    run = tmp_path / "run"
    begins = f"start.policy={trained}"
    assert "nothing.pt" in refusal(*SMALL, "start.policy=nothing.pt", folder=run)
    wide = refusal(*SMALL, begins, "model.hidden=32", folder=run)
    assert wide == f"start.policy={trained}: it was trained with model.hidden=16, which is 32 here"
    mirrored = refusal(*SMALL, begins, "algo.actor.mirror=average", folder=run)
    assert mirrored == f"start.policy={trained}: it was trained with algo.actor.mirror=null, which is average here"
    other = refusal(*TINY, begins, "algo=mappo", *PPO, folder=run)
    assert other.startswith(f"start.policy={trained}: it was trained with model.name=softgm, which is mlp here")
    like = ("model=softgm", "model.hidden=16", "algo.actor.state_dependent_sigma=false")
    off_policy = refusal(*TINY, begins, "algo=masac", *like, folder=run)
    assert off_policy == f"start.policy={trained}: its networks do not fit those of algo=masac task=basic"


def test_how_it_explores_may_differ(trained, tmp_path):
    train(compose([*SMALL, f"start.policy={trained}", "algo.actor.max_sigma=1.5", f"run_dir={tmp_path / 'run'}"]))
    assert (tmp_path / "run" / "summary.json").exists()
