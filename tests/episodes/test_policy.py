import subprocess
import sys

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench.config import compose
from softgm_bench.envs import entries, make_env
from softgm_bench.episodes import policy
from softgm_bench.errors import UserError
from softgm_bench.runs import checkpoint
from softgm_bench.runs.loop import train
from softgm_bench.storage.run_folder import RunFolder

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
        return env.rollout(3, trained.policy)[entries.ACTION]


def test_a_kept_policy_acts_as_the_runs_and_is_small(run, tmp_path):
    of_run = policy.load(run)
    newest = RunFolder(run).newest()
    policy.save(of_run, tmp_path / "kept.pt")
    kept = policy.load(tmp_path / "kept.pt")
    assert torch.equal(actions(of_run), actions(kept))
    assert torch.equal(actions(of_run), actions(policy.load(newest)))
    assert kept.config == of_run.config
    assert (kept.frames, kept.versions) == (of_run.frames, of_run.versions) == (16, of_run.versions)
    assert (tmp_path / "kept.pt").stat().st_size < newest.stat().st_size / 2


def test_the_policy_is_the_trained_one(run):
    trained = policy.load(run)
    state = checkpoint.load(RunFolder(run).newest())["algorithm"]["loss"]
    values = [value for name, value in state.items() if name.startswith(("actor_network.", "actor_network_params."))]
    stored = sum(value.sum() for value in values if value.is_floating_point())
    torch.testing.assert_close(sum(value.sum() for value in trained.policy.parameters()).detach(), stored)


def test_what_holds_no_policy_is_refused_in_one_line(run, tmp_path):
    with pytest.raises(UserError, match=r"^\S+: no checkpoint here[^\n]*$"):
        policy.load(tmp_path)
    state = checkpoint.load(RunFolder(run).newest())
    state["config"]["model"]["hidden"] = 64
    torch.save(state, tmp_path / "other.pt")
    with pytest.raises(UserError, match=r"^\S+: this version cannot build its networks[^\n]*$"):
        policy.load(tmp_path / "other.pt")


@pytest.mark.slow
def test_the_command_keeps_a_policy_or_says_what_is_wrong(run, tmp_path):
    command = [sys.executable, "-m", "softgm_bench.export"]
    done = subprocess.run([*command, run, tmp_path / "kept.pt"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "on wall after 16 frames" in done.stdout
    assert policy.load(tmp_path / "kept.pt").frames == 16
    failed = subprocess.run([*command, tmp_path / "nowhere", tmp_path / "x.pt"], capture_output=True, text=True)
    assert failed.returncode == 2
    assert len(failed.stderr.splitlines()) == 1


def test_a_policy_acts_in_other_settings_with_the_same_parameters(run):
    trained = policy.load(run)
    changed = policy.load(run, overrides=["task.n_agents=4", "perturbation=noise", "task.horizon=7", "dtype=float32"])
    assert (changed.config.task.n_agents, changed.config.perturbation.name) == (4, "noise")
    assert (changed.config.task.horizon, changed.config.dtype) == (7, "float32")
    assert changed.run == trained.run == trained.config
    assert changed.label == trained.label == trained.run.algo.name
    parameters = changed.policy.state_dict()
    assert all(torch.equal(value, parameters[name]) for name, value in trained.policy.state_dict().items())
    assert actions(changed).shape == (3, 3, 4, 2)


def test_another_task_replaces_all_of_the_trainings_and_single_keys_come_after_it(run):
    config = policy.load(run, overrides=["task.horizon=9", "task=wall_narrow", "perturbation=section_failure"]).config
    assert (config.task.name, config.task.horizon, config.task.opening_side) == ("wall_narrow", 9, 0.24)
    assert config.rod.n_elements == 20  # the run's
    assert config.perturbation.failed_agents == (2,)


def test_a_policy_with_settings_is_kept_as_it_was_trained(run, tmp_path):
    policy.save(policy.load(run, overrides=["task.n_agents=3"]), tmp_path / "kept.pt")
    assert policy.load(tmp_path / "kept.pt").config == policy.load(run).run


def test_from_a_kept_file_too_a_policy_explores_as_at_the_end_of_training(run, tmp_path):
    state = checkpoint.load(RunFolder(run).newest())
    of_run = policy.load(run)
    policy.save(of_run, tmp_path / "kept.pt")
    kept = policy.load(tmp_path / "kept.pt")
    fitted = policy.load(tmp_path / "kept.pt", overrides=["task.horizon=9"])
    assert state["config"]["algo"]["name"] != "masac" or of_run.policy.uniform is False
    for other in (kept, fitted):
        assert getattr(other.policy, "uniform", None) is getattr(of_run.policy, "uniform", None)
        assert getattr(other.policy, "sigma", None) == getattr(of_run.policy, "sigma", None)


def test_an_mlp_is_told_which_slots_it_needs_and_softgm_needs_none(run):
    if policy.load(run).label == "softgm":
        assert actions(policy.load(run, overrides=["task=structured"])).shape == (3, 3, 6, 2)
        return
    with pytest.raises(UserError, match=r"128 obstacle slots, task=structured .* has 64: add task.slots=128$"):
        policy.load(run, overrides=["task=structured"])
    assert actions(policy.load(run, overrides=["task=structured", "task.slots=128"])).shape == (3, 3, 6, 2)


def test_settings_that_training_has_settled_are_refused(run):
    with pytest.raises(
        UserError, match=r"^algo.gamma: not a setting of trained policies; those are task, rod, [^\n]*$"
    ):
        policy.load(run, overrides=["algo.gamma=0.5"])
    with pytest.raises(UserError, match=r"^task: settings are written key=value$"):
        policy.load(run, overrides=["task"])
