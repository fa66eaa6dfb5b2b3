"""The campaign's script, rehearsed on the CPU: killed in the middle, unpacked, gone on with, read by the report."""

import json
import os
import signal
import subprocess
import sys
import tarfile
import time
from pathlib import Path

import pytest

from softgm_bench.sweeps import campaign
from softgm_bench.sweeps import record as sweep_record

ROOT = Path(__file__).parents[2]
SMALL = (
    "experiment=smoke",
    "experiment.num_envs=2",
    "experiment.steps_per_batch=4",
    "experiment.total_frames=16",
    "experiment.evaluation.interval=8",
    "experiment.evaluation.final_episodes=2",
    "experiment.evaluation.final_horizon=2",
    "experiment.evaluation.horizon=2",
    "rod.n_elements=20",
    "algo.epochs=1",
    "model.hidden=16",
    "task=basic",
    "algo=mappo",
)
KEPT = {"config.yaml", "metrics.csv", "evaluations.jsonl", "episodes.csv", "summary.json", campaign.POLICY}


def start(folder, *arguments, minutes=3.0):
    timing = ["--least", "0.05", "--start-up", "5", "--reserve", "5", "--minutes", str(minutes)]
    places = ["--out", str(folder / "out"), "--work", str(folder / "work"), "--device", "cpu", "--jobs", "1"]
    command = [sys.executable, str(ROOT / "experiments/gpu_campaign.py"), *places, *timing, *arguments]
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src"), "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)


def wait_for_line(process, part, seconds=300):
    """Read what it prints until a line has this part in it; returns the lines."""
    lines, end = [], time.monotonic() + seconds
    for line in process.stdout:
        lines.append(line.rstrip())
        if part in line:
            return lines
        assert time.monotonic() < end
    raise AssertionError("\n".join(lines))


def unpacked(folder, into):
    for path in sorted((folder / "out").glob("pack-*.tar.gz")):
        with tarfile.open(path) as archive:
            archive.extractall(into, filter="data")
    return into


def nobody_trains(folder):
    end = time.monotonic() + 60.0
    while any(sweep_record.state(path.parent).kind == "running" for path in folder.rglob("config.yaml")):
        assert time.monotonic() < end
        time.sleep(0.2)


@pytest.mark.slow
def test_what_has_finished_outlives_a_kill_and_a_further_campaign_does_the_rest(tmp_path):
    first = start(tmp_path / "first", "--only-cells", *SMALL, "seed=0,1,2")
    wait_for_line(first, "basic/mappo/seed0: packed")
    wait_for_line(first, "seed1: begins")
    first.kill()
    first.communicate()
    nobody_trains(tmp_path / "first")  # its training has noticed
    done = unpacked(tmp_path / "first", tmp_path / "unpacked")
    assert campaign.finished(done) == ["basic/mappo/seed0"]
    assert {path.name for path in (done / "runs/basic/mappo/seed0").iterdir()} == KEPT
    assert "basic/mappo/seed0: begins" in (done / "log.txt").read_text()

    second = start(tmp_path / "second", "--only-cells", "--done", str(done), "--", *SMALL, "seed=0,1,2")
    output, _ = second.communicate(timeout=300)
    assert second.returncode == 0, output
    assert "seed0: begins" not in output
    unpacked(tmp_path / "second", done)
    assert campaign.finished(done) == [f"basic/mappo/seed{seed}" for seed in (0, 1, 2)]
    assert len(list((tmp_path / "second/out").iterdir())) <= 6

    report = [sys.executable, "-m", "softgm_bench.report", str(done), f"out={tmp_path / 'report'}", "resamples=100"]
    result = subprocess.run(report, capture_output=True, text=True, check=False)
    assert result.returncode == 0, result.stderr
    assert result.stdout.startswith("3 runs, ")


@pytest.mark.slow
def test_a_signal_stops_the_trainings_and_keeps_what_they_had(tmp_path):
    process = start(tmp_path, "--only-cells", *SMALL, "experiment.total_frames=100_000_000")
    metrics = tmp_path / "work/runs/basic/mappo/seed0/metrics.csv"
    wait_for_line(process, "begins")
    end = time.monotonic() + 200.0
    while not (metrics.exists() and metrics.read_text().count("\n") > 2):
        assert time.monotonic() < end
        time.sleep(0.1)
    process.send_signal(signal.SIGTERM)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.SIGTERM, output
    nobody_trains(tmp_path)
    held = unpacked(tmp_path, tmp_path / "unpacked")
    assert {path.name for path in (held / "unfinished/basic/mappo/seed0").iterdir()} >= {"metrics.csv", campaign.POLICY}
    assert campaign.finished(held) == []
    assert "interrupted" in (held / "log.txt").read_text()


@pytest.mark.slow
def test_endless_cells_end_in_time_with_their_summaries_and_a_failing_one_says_why(tmp_path):
    settings = [*SMALL, "experiment.total_frames=100_000_000", "seed=0", "perturbation=none,section_failure"]
    broken = ("perturbation=section_failure", "perturbation.failed_agents=[77]")
    began = time.monotonic()
    process = start(tmp_path, "--only-cells", *settings, minutes=1.5)
    output, _ = process.communicate(timeout=300)
    assert process.returncode == 0, output
    assert time.monotonic() - began < 90.0 + 10.0
    held = unpacked(tmp_path, tmp_path / "unpacked")
    for name in campaign.finished(held):
        summary = json.loads((held / "runs" / name / "summary.json").read_text())
        assert 0 < summary["frames"] < 100_000_000
    assert "basic/mappo/seed0" in campaign.finished(held)

    failing = start(tmp_path / "failing", "--only-cells", *SMALL, *broken)
    output, _ = failing.communicate(timeout=300)
    assert "basic/mappo_section_failure/seed0: failed, perturbation.failed_agents" in output


@pytest.mark.slow
def test_settings_that_make_no_sense_are_one_line_before_anything_is_written(tmp_path):
    process = start(tmp_path, "--only-cells", "task=wal")
    output, _ = process.communicate(timeout=120)
    assert (process.returncode, output.count("\n")) == (2, 1), output
    assert output.startswith("gpu_campaign: task=wal: no such task")
    assert list(tmp_path.iterdir()) == []
