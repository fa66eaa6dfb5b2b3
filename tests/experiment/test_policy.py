import subprocess
import sys

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench.config import UserError, compose
from softgm_bench.envs import keys, make_env
from softgm_bench.experiment import checkpoint, policy
from softgm_bench.experiment.loop import train

TINY = (
    "experiment=smoke",
    "task=wall",
    "threads=1",
    "experiment.total_frames=16",
    "experiment.num_envs=4",
    "experiment.steps_per_batch=4",
    "experiment.evaluation.interval=16",
    "experiment.evaluation.horizon=2",
    "experiment.evaluation.final_horizon=2",
    "rod.n_elements=20",
)
ALGORITHMS = {
    "softgm": ("algo.epochs=1", "algo.minibatch_size=8"),
    "masac": ("algo.batch_size=4", "algo.random_frames=8", "algo.updates_per_frame=0.25"),
}


@pytest.fixture(scope="module", params=ALGORITHMS)
def run(request, tmp_path_factory):
    folder = tmp_path_factory.mktemp(request.param)
    threads = torch.get_num_threads()
    train(compose([*TINY, f"algo={request.param}", f"run_dir={folder}", *ALGORITHMS[request.param]]))
    torch.set_num_threads(threads)
    return folder


def actions(trained):
    env = make_env(trained.config.task, trained.config.rod, num_envs=3, seed=1)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        return env.rollout(3, trained.policy)[keys.ACTION]


def test_a_kept_policy_acts_as_the_runs_and_is_small(run, tmp_path):
    of_run = policy.load(run)
    newest = checkpoint.latest(run / "checkpoints")
    policy.save(of_run, tmp_path / "kept.pt")
    kept = policy.load(tmp_path / "kept.pt")
    assert torch.equal(actions(of_run), actions(kept))
    assert torch.equal(actions(of_run), actions(policy.load(newest)))
    assert kept.config == of_run.config
    assert (kept.frames, kept.versions) == (of_run.frames, of_run.versions) == (16, of_run.versions)
    assert (tmp_path / "kept.pt").stat().st_size < newest.stat().st_size / 2


def test_the_policy_is_the_trained_one(run):
    trained = policy.load(run)
    state = checkpoint.load(checkpoint.latest(run / "checkpoints"))["algorithm"]["loss"]
    values = [value for name, value in state.items() if name.startswith("actor_network_params.")]
    stored = sum(value.sum() for value in values if value.is_floating_point())
    torch.testing.assert_close(sum(value.sum() for value in trained.policy.parameters()).detach(), stored)


def test_what_holds_no_policy_is_refused_in_one_line(run, tmp_path):
    with pytest.raises(UserError, match=r"^\S+: no checkpoint here[^\n]*$"):
        policy.load(tmp_path)
    state = checkpoint.load(checkpoint.latest(run / "checkpoints"))
    state["config"]["model"]["hidden"] = 64
    torch.save(state, tmp_path / "other.pt")
    with pytest.raises(UserError, match=r"^\S+: this version cannot build its networks[^\n]*$"):
        policy.load(tmp_path / "other.pt")


def test_the_command_keeps_a_policy_or_says_what_is_wrong(run, tmp_path):
    command = [sys.executable, "-m", "softgm_bench.export"]
    done = subprocess.run([*command, run, tmp_path / "kept.pt"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "on wall after 16 frames" in done.stdout
    assert policy.load(tmp_path / "kept.pt").frames == 16
    failed = subprocess.run([*command, tmp_path / "nowhere", tmp_path / "x.pt"], capture_output=True, text=True)
    assert failed.returncode == 2
    assert len(failed.stderr.splitlines()) == 1
