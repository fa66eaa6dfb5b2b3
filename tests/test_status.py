"""What a folder of runs says about itself: every kind of run, with and without a grid."""

import fcntl
import json
import os
import subprocess
import sys

import pytest

from made_up_runs import write_run
from softgm_bench import status
from softgm_bench.errors import UserError
from softgm_bench.sweeps import record as sweep_record

HOLD = """
import fcntl, os, sys
descriptor = os.open(sys.argv[1], os.O_RDONLY)
fcntl.flock(descriptor, fcntl.LOCK_EX)
print("held", flush=True)
sys.stdin.read()
"""


def begun(folder, frames=(100, 200)):
    """A run that has written something down and has not come to its end."""
    folder.mkdir(parents=True)
    (folder / "config.yaml").write_text("experiment:\n  total_frames: 1000\n")
    rows = "".join(f"{k},{value}\n" for k, value in enumerate(frames, 1))
    (folder / "metrics.csv").write_text(f"iteration,frames\n{rows}")
    return folder


def test_a_finished_run_is_done_with_its_success_and_interval(tmp_path):
    folder = write_run(tmp_path, "wall", "softgm", 0, success=0.5, count=100)
    rate = json.loads((folder / "summary.json").read_text())["final_evaluation"]["success_rate"]
    expected = f"success {rate['mean']:.3f} [{rate['low']:.3f}, {rate['high']:.3f}]"
    assert sweep_record.state(folder) == sweep_record.State("done", expected)


def test_a_run_is_running_while_a_process_locks_its_folder_and_stopped_when_that_was_killed(tmp_path):
    folder = begun(tmp_path / "run")
    (folder / "running.json").write_text(json.dumps({"pid": 4711, "host": "node3", "device": "cuda:1"}))
    holder = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(folder)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert holder.stdout.readline() == "held\n"
    held = sweep_record.state(folder)
    holder.kill()
    holder.communicate()

    assert held == sweep_record.State("running", "process 4711 on node3 cuda:1, 200 frames, 20%")
    assert sweep_record.state(folder) == sweep_record.State("stopped", "200 frames, 20%")


def test_looking_does_not_keep_a_run_from_its_folder(tmp_path):
    folder = begun(tmp_path / "run")
    sweep_record.state(folder)
    descriptor = os.open(folder, os.O_RDONLY)
    fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    os.close(descriptor)


def test_frames_are_those_of_the_last_whole_row(tmp_path):
    folder = begun(tmp_path / "run", frames=range(100, 100_100, 100))
    with (folder / "metrics.csv").open("a") as file:
        file.write("1001,1")
    assert sweep_record.state(folder).detail == "100,000 frames, 100%"


def test_a_failure_is_told_until_the_next_attempt_begins(tmp_path):
    folder = tmp_path / "run"
    sweep_record.write_failure(folder, "seed=-1: a seed is a whole number")
    assert sweep_record.state(folder) == sweep_record.State("failed", "seed=-1: a seed is a whole number")
    with sweep_record.running(folder, "cuda:2"):
        assert not (folder / "failure.json").exists()
        assert json.loads((folder / "running.json").read_text())["pid"] == os.getpid()
        assert json.loads((folder / "running.json").read_text())["device"] == "cuda:2"
    assert list(folder.iterdir()) == []


def test_a_failure_is_not_left_beside_a_finished_run(tmp_path):
    folder = write_run(tmp_path, "wall", "softgm", 0)
    sweep_record.write_failure(folder, "other settings")
    assert sweep_record.state(folder).kind == "done"
    assert not (folder / "failure.json").exists()


def test_a_damaged_summary_is_a_failure(tmp_path):
    folder = write_run(tmp_path, "wall", "softgm", 0)
    (folder / "summary.json").write_text("{")
    assert sweep_record.state(folder) == sweep_record.State("failed", "summary.json is damaged")


def test_the_table_has_a_line_a_run_and_counts_them(tmp_path):
    begun(tmp_path / "basic/mappo/seed0")
    assert status.table(tmp_path, status._runs(tmp_path)).splitlines()[-1] == "1 run: 1 stopped"
    sweep_record.write_failure(tmp_path / "basic/mappo/seed1", "no space left")
    write_run(tmp_path, "basic", "mappo", 2)
    lines = status.table(tmp_path, status._runs(tmp_path)).splitlines()
    assert [line.split()[:2] for line in lines[:-1]] == [
        ["basic/mappo/seed0", "stopped"],
        ["basic/mappo/seed1", "failed"],
        ["basic/mappo/seed2", "done"],
    ]
    assert lines[-1] == "3 runs: 1 done, 1 failed, 1 stopped"


def test_a_grid_shows_its_own_cells_and_what_is_missing(tmp_path):
    write_run(tmp_path, "wall", "softgm", 1)
    write_run(tmp_path, "basic", "softgm", 1)
    lines = status.table(tmp_path, status._cells(tmp_path, "table2")).splitlines()
    assert [line.split()[:2] for line in lines[:-1]] == [
        ["wall/softgm/seed0", "missing"],
        ["wall/softgm/seed1", "done"],
        ["wall/softgm/seed2", "missing"],
    ]
    assert lines[-1] == "3 runs: 1 done, 2 missing"


def test_an_unknown_grid_is_refused_with_those_there_are(tmp_path):
    with pytest.raises(UserError, match=r"grid=table3: no such grid; choose one of ablation, .*, ladder, rivals, "):
        status._cells(tmp_path, "table3")


def test_an_empty_folder_has_no_runs_and_a_missing_one_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["status", str(tmp_path)])
    assert status.main() == 0
    assert capsys.readouterr().out == "0 runs\n"
    monkeypatch.setattr(sys, "argv", ["status", str(tmp_path / "gone")])
    assert status.main() == 2
    assert capsys.readouterr().err == f"softgm_bench.status: {tmp_path / 'gone'}: no such folder\n"
