"""Grids as a user launches them: each cell is done once, whatever happens to the others or to the sweep."""

import csv
import json
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from softgm_bench.config import available_threads
from softgm_bench.sweeps import launch as sweep

TINY = (
    "experiment=smoke",
    "experiment.total_frames=64",
    "experiment.num_envs=2",
    "experiment.steps_per_batch=4",
    "experiment.train_horizon=3",
    "experiment.evaluation.interval=32",
    "experiment.evaluation.episodes=2",
    "experiment.evaluation.horizon=2",
    "experiment.evaluation.final_horizon=2",
    "experiment.evaluation.final_episodes=2",
    "experiment.checkpoint.interval=8",
    "rod.n_elements=20",
    "algo.epochs=1",
    "model.hidden=16",
)
JOBS = min(2, available_threads())
ENDLESS = ("experiment.total_frames=1_000_000", "experiment.checkpoint.interval=1_000_000")


def start(folder, *arguments):
    command = [sys.executable, "-m", "softgm_bench", "-m", *TINY, *arguments]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def run(folder, *arguments):
    process = start(folder, *arguments)
    output, errors = process.communicate(timeout=900)
    return process.returncode, output, errors


def cell_lines(output):
    """Folder, outcome and the rest of each line about a cell, ``[1 of 4] outputs/...: done, ...``."""
    lines = re.findall(r"^\[\d+ of \d+\] (outputs/.*)$", output, re.MULTILINE)
    return {line.partition(": ")[0]: line.partition(": ")[2].partition(", ")[::2] for line in lines}


def outcomes(output):
    return {Path(name).name: outcome for name, (outcome, _) in cell_lines(output).items()}


def wait_for(condition, process=None, seconds=300):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        assert process is None or process.poll() is None, process.stderr.read()
        time.sleep(0.1)


def assert_whole(run_dir, frames=64):
    """Finished, with every iteration written down once."""
    summary = json.loads((run_dir / "summary.json").read_text())
    rows = list(csv.DictReader((run_dir / "metrics.csv").open()))
    assert summary["frames"] == frames
    assert [int(row["frames"]) for row in rows] == list(range(8, frames + 1, 8))
    assert not (run_dir / "failure.json").exists()
    assert not (run_dir / "running.json").exists()


def no_process_left(folder):
    """Whether nobody trains below the folder any more."""
    from softgm_bench.sweeps import record as sweep_record

    return all(sweep_record.state(path.parent).kind != "running" for path in folder.rglob("output.log"))


@pytest.mark.slow
def test_a_killed_training_fails_alone_and_is_retried_alone(tmp_path):
    seeds = tmp_path / "outputs/basic/softgm"
    if not sweep.installed("joblib"):
        pytest.skip("hydra-joblib-launcher is not installed")
    process = start(tmp_path, "seed=0,1,-1,2", f"hydra.launcher.n_jobs={JOBS}")
    wait_for(lambda: (seeds / "seed0/running.json").exists(), process)
    os.kill(json.loads((seeds / "seed0/running.json").read_text())["pid"], signal.SIGKILL)
    output, errors = process.communicate(timeout=900)

    assert process.returncode == 2
    assert outcomes(output) == {"seed0": "failed", "seed1": "done", "seed-1": "failed", "seed2": "done"}
    listed = errors.splitlines()[-3:]
    assert listed[0] == "softgm_bench: 2 of 4 cells failed:"
    assert listed[1].startswith("  outputs/basic/softgm/seed0: killed by SIGKILL")
    assert listed[2].startswith("  outputs/basic/softgm/seed-1: seed=-1: a seed is")
    assert "Traceback" not in errors
    assert (seeds / "seed-1/failure.json").exists()
    before = (seeds / "seed1/summary.json").stat().st_mtime_ns

    code, output, errors = run(tmp_path, "seed=0,1,2")

    assert code == 0, errors
    assert outcomes(output) == {"seed0": "done", "seed1": "skipped", "seed2": "skipped"}
    assert (seeds / "seed1/summary.json").stat().st_mtime_ns == before
    for seed in (0, 1, 2):
        assert_whole(seeds / f"seed{seed}")
    assert sorted(path.name for path in (tmp_path / "outputs").iterdir()) == ["basic", "multirun.yaml"]


@pytest.mark.slow
def test_a_sweep_that_is_killed_takes_its_trainings_along(tmp_path):
    if not sweep.installed("joblib"):
        pytest.skip("hydra-joblib-launcher is not installed")
    seeds = range(JOBS)
    metrics = [tmp_path / f"outputs/basic/softgm/seed{seed}/metrics.csv" for seed in seeds]
    process = start(tmp_path, f"seed={','.join(map(str, seeds))}", f"hydra.launcher.n_jobs={JOBS}", *ENDLESS)
    wait_for(lambda: all(path.exists() for path in metrics), process)
    process.kill()
    process.communicate()

    wait_for(lambda: no_process_left(tmp_path), seconds=60)
    for path in metrics:  # each has saved a checkpoint, its only one, before it stopped
        assert len(list((path.parent / "checkpoints").glob("frames-*.pt"))) == 1
        assert not (path.parent / "running.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("launcher", ["basic", "joblib", "submitit_local", "ray"])
def test_every_launcher_does_four_cells_of_which_one_fails(tmp_path, launcher):
    if launcher != "basic" and not sweep.installed(launcher):
        pytest.skip(f"the launcher is not installed; extra {sweep.EXTRAS[launcher]}")

    code, output, errors = run(tmp_path, f"hydra/launcher={launcher}", "algo=softgm,mappo", "seed=0,-1")

    lines = cell_lines(output)
    assert code == 2, errors
    assert {name: outcome for name, (outcome, _) in lines.items()} == {
        "outputs/basic/softgm/seed0": "done",
        "outputs/basic/mappo/seed0": "done",
        "outputs/basic/softgm/seed-1": "failed",
        "outputs/basic/mappo/seed-1": "failed",
    }
    assert errors.splitlines()[-3] == "softgm_bench: 2 of 4 cells failed:"
    for algo in ("softgm", "mappo"):
        assert_whole(tmp_path / f"outputs/basic/{algo}/seed0")


@pytest.mark.slow
def test_twelve_cells_are_each_done_once_though_the_sweep_is_killed_half_way(tmp_path):
    if not sweep.installed("joblib"):
        pytest.skip("hydra-joblib-launcher is not installed")
    grid = ("algo=softgm,mappo", "task=basic,wall", "seed=0,1,2")

    def done():
        return {path.parent: path.stat().st_mtime_ns for path in tmp_path.rglob("summary.json")}

    process = start(tmp_path, *grid)
    wait_for(lambda: len(done()) >= 5, process, seconds=900)
    process.kill()
    process.communicate()
    wait_for(lambda: no_process_left(tmp_path), seconds=60)
    before = done()
    assert len(before) < 12

    code, output, errors = run(tmp_path, *grid)

    assert code == 0, errors
    after = done()
    assert len(after) == 12
    assert {folder: after[folder] for folder in before} == before
    lines = cell_lines(output)
    assert {tmp_path / name for name, (outcome, _) in lines.items() if outcome == "skipped"} == before.keys()
    assert {
        tmp_path / name for name, (outcome, _) in lines.items() if outcome == "done"
    } == after.keys() - before.keys()
    for folder in after:
        assert_whole(folder)
