import json

import pytest

from made_up_runs import write_evaluation, write_run
from softgm_bench.analysis.runs import find
from softgm_bench.errors import UserError


def test_a_run_is_read_with_its_episodes_and_the_evaluations_on_its_way(tmp_path):
    write_run(tmp_path / "runs", "basic", "softgm", 3, success=0.7, count=50, points=4)
    (run,) = find(tmp_path / "runs").runs
    assert (run.final.task, run.final.label, run.final.seed) == ("basic", "softgm", 3)
    assert run.final.folder == "runs/basic/softgm/seed3"
    assert run.final.episodes["length"].shape == (50,)
    assert set(run.final.episodes["success"]) == {0.0, 1.0}
    assert run.final.episodes["success"].mean() == run.summary["final_evaluation"]["success_rate"]["mean"]
    assert [entry["frames"] for entry in run.progress] == [500_000, 1_000_000, 1_500_000, 2_000_000]
    assert (run.final.horizon, run.progress_horizon) == (2000, 200)
    assert (run.oracle, run.curriculum, run.trained_with) == (False, False, "none")


def test_an_evaluation_inside_a_run_is_found_with_it(tmp_path):
    folder = write_run(tmp_path, "wall", "softgm", 0)
    noise = {"name": "noise", "position_sigma": 0.1}
    write_evaluation(folder / "evaluations" / "noise", "wall", "softgm", 0, noise, overrides=("perturbation=noise",))
    found = find(tmp_path)
    (evaluation,) = found.evaluations
    assert len(found.runs) == 1
    assert not found.problems
    assert evaluation.perturbation == noise
    assert evaluation.overrides == ()
    assert evaluation.horizon == 2000  # of episodes that ended with neither success nor divergence


def test_an_unfinished_run_says_how_far_it_came(tmp_path):
    (write_run(tmp_path, "basic", "softgm", 0) / "summary.json").unlink()
    found = find(tmp_path)
    assert not found.runs
    (problem,) = found.problems
    assert problem.reason == "unfinished: summary.json is missing; 2,000,000 frames so far"


def cut(path):
    path.write_text(path.read_text()[:-30])


def drop_seed(path):
    path.write_text(json.dumps({key: value for key, value in json.loads(path.read_text()).items() if key != "seed"}))


def drop_row(path):
    path.write_text("\n".join(path.read_text().splitlines()[:-1]) + "\n")


def lengthen(path):
    path.write_text(path.read_text().replace(",2000,", ",2001,"))


@pytest.mark.parametrize(
    ("name", "damage", "reason"),
    [
        ("summary.json", cut, "damaged: "),
        ("summary.json", drop_seed, "damaged: a file lacks an entry ('seed')"),
        ("episodes.csv", cut, "damaged: episodes.csv"),
        ("episodes.csv", drop_row, "damaged: episodes.csv has 99 episodes, summary.json 100"),
        ("episodes.csv", lengthen, "damaged: episodes.csv and summary.json differ"),
        ("evaluations.jsonl", cut, "damaged: "),
        ("config.yaml", cut, "damaged: "),
        ("config.yaml", lambda path: path.unlink(), "damaged: config.yaml is missing"),
        ("episodes.csv", lambda path: path.unlink(), "damaged: episodes.csv is missing"),
        ("summary.json", lambda path: path.write_bytes(b"\xff\xfe\x00"), "damaged: "),
    ],
)
def test_a_damaged_run_is_listed_with_the_reason_and_the_others_are_kept(tmp_path, name, damage, reason):
    damage(write_run(tmp_path, "basic", "softgm", 0, success=0.5) / name)
    write_run(tmp_path, "basic", "softgm", 1)
    found = find(tmp_path)
    assert [run.final.seed for run in found.runs] == [1]
    (problem,) = found.problems
    assert problem.reason.startswith(reason)
    assert problem.folder.endswith("basic/softgm/seed0")
    assert "\n" not in problem.reason


def test_the_order_does_not_depend_on_the_order_of_writing(tmp_path):
    for seed in (2, 0, 1):
        write_run(tmp_path, "basic", "softgm", seed)
    assert [run.final.seed for run in find(tmp_path).runs] == [0, 1, 2]


def test_other_folders_are_no_problem(tmp_path):
    (tmp_path / "notes").mkdir()
    (tmp_path / "notes" / "readme.txt").write_text("hello")
    found = find(tmp_path)
    assert (found.runs, found.evaluations, found.problems) == ([], [], [])


def test_a_folder_that_does_not_exist_is_the_users_error(tmp_path):
    with pytest.raises(UserError, match="no such folder"):
        find(tmp_path / "nowhere")
