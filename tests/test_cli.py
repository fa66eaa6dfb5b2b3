"""The command line as a user meets it: every mistake is answered by one line."""

import os
import signal
import subprocess
import sys
import time

import pytest

from pairwise import tiered
from softgm_bench.storage.run_folder import RunFolder

TINY = [
    "experiment=smoke",
    "experiment.total_frames=16",
    "experiment.evaluation.interval=8",
    "threads=1",
    "experiment.num_envs=2",
    "experiment.steps_per_batch=4",
    "experiment.train_horizon=3",
    "experiment.evaluation.horizon=2",
    "experiment.evaluation.final_horizon=2",
    "experiment.evaluation.final_episodes=2",
    "rod.n_elements=20",
    "algo.epochs=1",
]


def command(*arguments):
    return [sys.executable, "-m", "softgm_bench", *arguments]


def run(folder, *arguments):
    return subprocess.run(command(*arguments), cwd=folder, capture_output=True, text=True, timeout=300, check=False)


# Each process takes seconds to start, so mistakes that are told apart here are those that take different ways out:
# Hydra's composition, the dataclasses, the semantic checks, the file system. The rest is in tests/config.
MISTAKES = {
    "unknown task": (
        ["task=wal"],
        "task=wal: no such task; choose one of basic, structured, swinging_posts, ",
    ),
    "misspelt key": (["experiment.num_env=4"], "experiment.num_env: no such key; did you mean experiment.num_envs?"),
    "wrong type": (["experiment.num_envs=many"], "experiment.num_envs: Value 'many' of type 'str' could not be"),
    "negative seed": (["seed=-1"], "seed=-1: a seed is a whole number from 0"),
    "zero environments": (["experiment.num_envs=0"], "experiment.num_envs=0: it must be at least 1"),
    "unwritable folder": (["run_dir=file/run"], "run_dir=file/run: Not a directory; choose a folder that can be"),
    "no override": (["wall"], "settings are written key=value"),
    "dashes": (["--seed=3"], "--seed=3: no such option; settings are written without dashes: seed=value"),
}
SLOW = ("misspelt key", "zero environments", "no override")  # they take the way out of another


@pytest.mark.parametrize(
    ("arguments", "says"),
    [tiered(*MISTAKES[name], quick=name not in SLOW, name=name) for name in MISTAKES],
)
def test_a_mistake_is_answered_by_one_line_and_leaves_nothing_behind(tmp_path, arguments, says):
    (tmp_path / "file").write_text("")

    result = run(tmp_path, *arguments)

    lines = [line for line in result.stderr.splitlines() if line.strip()]
    assert len(lines) == 1, result.stderr
    assert says in lines[0]
    assert result.returncode == 2
    assert result.stdout == ""
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_a_run_leaves_a_complete_folder_and_is_not_replaced_by_accident(tmp_path):
    result = run(tmp_path, *TINY)

    assert result.returncode == 0, result.stderr
    assert "success rate" in result.stdout
    folder = tmp_path / "outputs/basic/softgm/seed0"
    names = {path.name for path in folder.iterdir()}
    assert names == {"config.yaml", "metrics.csv", "evaluations.jsonl", "episodes.csv", "summary.json", "checkpoints"}
    assert [path.name for path in tmp_path.iterdir()] == ["outputs"]

    before = (folder / "summary.json").read_bytes()
    again = run(tmp_path, *TINY)
    assert again.returncode == 2
    assert again.stderr.count("\n") == 1
    assert "finished run: add overwrite=true" in again.stderr
    assert (folder / "summary.json").read_bytes() == before


@pytest.mark.slow
def test_a_sweep_runs_every_job_and_reports_each_that_fails(tmp_path):
    done = tmp_path / "outputs/basic/softgm/seed0"
    done.mkdir(parents=True)
    (done / "summary.json").write_text("{}")

    result = run(tmp_path, "-m", "seed=0,-1,1", *TINY)

    assert result.returncode == 2
    assert "seed0/config.yaml: missing or of another version; to begin anew, give overwrite=true" in result.stderr
    assert "seed=-1: a seed is" in result.stderr
    assert "Traceback" not in result.stderr
    assert (tmp_path / "outputs/basic/softgm/seed1/summary.json").exists()
    assert sorted(path.name for path in (tmp_path / "outputs").iterdir()) == ["basic", "multirun.yaml"]


@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        tiered(signal.SIGTERM, 143, quick=False),
        tiered(signal.SIGHUP, 129, quick=False),
        tiered(signal.SIGUSR1, 138, quick=False),
    ],
)
def test_an_interrupted_run_says_where_its_checkpoint_is(tmp_path, number, code):
    from softgm_bench.runs import checkpoint

    endless = [*TINY, "experiment.total_frames=1_000_000", "experiment.checkpoint.interval=1_000_000"]
    process = subprocess.Popen(command(*endless), cwd=tmp_path, stderr=subprocess.PIPE, text=True)
    metrics = tmp_path / "outputs/basic/softgm/seed0/metrics.csv"
    deadline = time.monotonic() + 120
    while not (metrics.exists() and metrics.read_text().count("\n") > 2):
        assert process.poll() is None, process.stderr.read()
        assert time.monotonic() < deadline
        time.sleep(0.1)
    os.kill(process.pid, number)
    _, errors = process.communicate(timeout=60)

    assert process.returncode == code
    assert "Traceback" not in errors
    last = [line for line in errors.splitlines() if line.strip()][-1]
    path = RunFolder(metrics.parent).newest()
    assert last.startswith("softgm_bench: interrupted after ")
    assert last.endswith(str(path.relative_to(tmp_path)))
    state = checkpoint.load(path)
    assert state["frames"] == 8 * state["counters"]["iteration"] == 8 * (metrics.read_text().count("\n") - 1)


@pytest.mark.slow
def test_a_run_that_nobody_reads_comes_to_its_end(tmp_path):
    command_line = " ".join(f"'{word}'" for word in command(*TINY))
    result = subprocess.run(["bash", "-c", f"{command_line} 2>&1 >/dev/full | head -c 1"], cwd=tmp_path, check=False)
    assert result.returncode == 0
    assert (tmp_path / "outputs/basic/softgm/seed0/summary.json").exists()
    closed = subprocess.run(["bash", "-c", f"{command_line} overwrite=true >&- 2>&-"], cwd=tmp_path, check=False)
    assert closed.returncode == 0
