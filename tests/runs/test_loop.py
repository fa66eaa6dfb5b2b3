import csv
import json
import subprocess
import sys

import numba
import pytest
import torch

from kept_threads import kept_threads
from softgm_bench.config import compose
from softgm_bench.errors import UserError
from softgm_bench.runs import checkpoint
from softgm_bench.runs.loop import train
from softgm_bench.runs.machine import set_threads
from softgm_bench.runs.run import derive_seeds
from softgm_bench.storage.run_folder import RunFolder

TINY = (
    "experiment=smoke",
    "threads=1",
    "experiment.total_frames=48",
    "experiment.num_envs=4",
    "experiment.steps_per_batch=4",
    "experiment.train_horizon=3",
    "experiment.evaluation.interval=16",
    "experiment.evaluation.horizon=2",
    "experiment.evaluation.final_horizon=2",
    "experiment.evaluation.final_episodes=5",
    "rod.n_elements=20",
    "algo.epochs=2",
    "algo.minibatch_size=8",
)
TIMINGS = ("wall_time", "frames_per_second")


@pytest.fixture(autouse=True)
def _threads_as_before():
    with kept_threads():
        yield


def trained(folder, *overrides):
    train(compose([*TINY, f"run_dir={folder}", *overrides]))
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    return [{name: value for name, value in row.items() if name not in TIMINGS} for row in rows]


def test_metrics_repeat_with_the_seed_however_often_training_is_looked_at(tmp_path):
    first = trained(tmp_path / "first", "task=wall")
    again = trained(tmp_path / "again", "task=wall", "experiment.evaluation.interval=1_000_000")
    sampled = trained(tmp_path / "sampled", "task=wall", "experiment.evaluation.deterministic=false")
    other = trained(tmp_path / "other", "task=wall", "seed=1")

    assert len(first) == 3
    assert first == again == sampled
    assert all(one["episode_return"] != another["episode_return"] for one, another in zip(first, other, strict=True))


def test_a_run_without_loggers_of_others_warns_of_none(tmp_path, capsys):
    trained(tmp_path)
    assert "stopped" not in capsys.readouterr().err


def test_a_perturbation_acts_in_training_too_and_its_state_is_kept(tmp_path):
    plain = trained(tmp_path / "plain", "task=wall")
    noisy = trained(tmp_path / "noisy", "task=wall", "perturbation=noise")
    again = trained(tmp_path / "again", "task=wall", "perturbation=noise")

    assert noisy == again
    assert all(one["loss_critic"] != other["loss_critic"] for one, other in zip(plain, noisy, strict=True))
    assert json.loads((tmp_path / "noisy/summary.json").read_text())["algo"] == "softgm_noise"
    generators = [
        checkpoint.load(RunFolder(tmp_path / name).newest())["environment"]["generator"] for name in ("plain", "noisy")
    ]
    assert generators[1].shape == (2, *generators[0].shape)


def test_a_finished_run_holds_what_its_settings_promise(tmp_path):
    summary = train(compose([*TINY, f"run_dir={tmp_path}", "task=structured", "experiment.total_frames=33"]))

    assert summary == json.loads((tmp_path / "summary.json").read_text())
    assert (summary["task"], summary["algo"], summary["model"], summary["seed"]) == (
        "structured",
        "softgm",
        "softgm",
        0,
    )
    assert summary["observation"] == "standard"
    assert summary["frames"] == 48  # whole iterations of 4 x 4
    assert summary["threads"] == 1
    assert summary["final_evaluation"]["episodes"] == 5
    assert summary["final_evaluation"]["episode_length"] == {"mean": 2.0, "std": 0.0}
    evaluations = [json.loads(line) for line in (tmp_path / "evaluations.jsonl").read_text().splitlines()]
    assert [(line["frames"], line["episodes"]) for line in evaluations] == [(16, 4), (32, 4), (48, 4)]
    # horizon 3 and clocks that start anywhere: in 12 steps each of the 4 environments ends 4 episodes
    with (tmp_path / "metrics.csv").open() as file:
        assert sum(int(row["episodes"]) for row in csv.DictReader(file)) == 16
    with (tmp_path / "episodes.csv").open() as file:
        assert [row["length"] for row in csv.DictReader(file)] == ["2"] * 5


@pytest.mark.parametrize("task", ["basic", "structured", "wall", "wall_narrow", "wall_fixed"])
@pytest.mark.parametrize("recipe", ["paper", "tuned"])
def test_every_task_trains_under_both_recipes(tmp_path, task, recipe):
    rows = trained(tmp_path, f"task={task}", f"recipe={recipe}", "model.hidden=16")
    assert len(rows) == 3
    assert all(float(row["loss_critic"]) == float(row["loss_critic"]) for row in rows)  # no NaN


@pytest.mark.parametrize("algo", ["ippo", "masac"])
def test_an_oracles_results_cannot_be_taken_for_anything_else(tmp_path, capsys, algo):
    folder = tmp_path / "oracle"
    sizes = TINY[:-2] if algo == "masac" else TINY
    train(compose([*sizes, f"run_dir={folder}", "task=wall", "observation=oracle", f"algo={algo}"]))

    summary = json.loads((folder / "summary.json").read_text())
    assert (summary["algo"], summary["observation"]) == (f"{algo}_oracle", "oracle")
    printed = capsys.readouterr()
    assert f"{algo}_oracle on wall, seed 0" in printed.out
    assert printed.err.count("frames (oracle): success") == 3


def test_settings_that_only_the_algorithm_can_refuse_are_one_line_and_leave_nothing_behind(tmp_path):
    small = ("algo=isac", "algo.batch_size=4", "algo.replay_capacity=7")
    with pytest.raises(UserError, match=r"^algo\.replay_capacity is 7: it must be at least two frames[^\n]*$"):
        train(compose([*TINY[:-2], f"run_dir={tmp_path / 'run'}", *small]))
    assert not (tmp_path / "run").exists()


def test_a_checkpoint_holds_what_going_on_needs(tmp_path):
    train(compose([*TINY, f"run_dir={tmp_path}", "task=wall"]))

    state = checkpoint.load(RunFolder(tmp_path).newest())

    assert state["frames"] == 48
    assert state["counters"]["iteration"] == 3
    assert state["config"]["model"]["name"] == "softgm"
    assert state["environment"]["simulation"]["episodes"]["rod"]["position"].shape[0] == 4
    assert state["environment"]["simulation"]["episodes"]["rod"]["position"].dtype == torch.float64
    assert {"loss", "actor_optimizer", "critic_optimizer"} <= state["algorithm"].keys()


def test_a_full_disk_is_one_line_that_names_the_folder(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "save", full)
    with pytest.raises(UserError, match=r"^\S+/run: No space left on device; [^\n]*$"):
        train(compose([*TINY, f"run_dir={tmp_path}/run"]))


def test_derived_seeds_share_nothing_and_repeat():
    seeds = [derive_seeds(seed) for seed in range(50)]

    assert len({word for four in seeds for word in four}) == 200
    assert derive_seeds(7) == seeds[7]


def test_threads_are_set_everywhere():
    assert set_threads(1) == torch.get_num_threads() == numba.get_num_threads() == 1


def test_a_fresh_process_uses_the_threads_that_it_is_told_to():
    """Numba starts its threads when it is first asked for some, and tells torch how many."""
    code = "import torch; from softgm_bench.runs.machine import set_threads; set_threads(1)"
    command = [sys.executable, "-c", f"{code}; print(torch.get_num_threads())"]
    assert subprocess.run(command, capture_output=True, text=True, check=True).stdout == "1\n"


def test_a_curriculum_is_followed_in_training_and_shown(tmp_path):
    rows = trained(tmp_path, "task=wall", "task.curriculum.enabled=true")
    assert all(float(row["difficulty"]) == 0.0 for row in rows)  # too short to be promoted
    assert "difficulty" not in trained(tmp_path / "without", "task=wall", "recipe=paper")[0]
