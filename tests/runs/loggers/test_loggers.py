import csv
import json
import os
import resource
import subprocess
import sys
import time

import pytest
import torch

from kept_threads import kept_threads
from softgm_bench.config import compose
from softgm_bench.errors import UserError
from softgm_bench.runs.loggers import guarded
from softgm_bench.runs.loggers.guarded import Loggers, flattened
from softgm_bench.runs.loop import train

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
    "algo.epochs=1",
)
TIMINGS = ("wall_time", "frames_per_second")


@pytest.fixture(autouse=True, scope="module")
def _threads_as_before():
    with kept_threads():
        yield


def rows(path):
    with path.open() as file:
        return [{name: value for name, value in row.items() if name not in TIMINGS} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Folder of a run without loggers."""
    folder = tmp_path_factory.mktemp("alone")
    train(compose([*TINY, f"run_dir={folder}"]))
    return folder


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    """Folder of the same run with both loggers."""
    folder = tmp_path_factory.mktemp("logged")
    with pytest.MonkeyPatch.context() as patch:
        patch.delenv("WANDB_MODE", raising=False)
        train(compose([*TINY, f"run_dir={folder}", "logger=[wandb,tensorboard]"]))
    return folder


def test_loggers_leave_every_number_of_a_run_as_it_is(alone, logged):
    assert rows(logged / "metrics.csv") == rows(alone / "metrics.csv")
    assert rows(logged / "episodes.csv") == rows(alone / "episodes.csv")


class TestWandb:
    @pytest.fixture
    def file(self, logged):
        pytest.importorskip("wandb")
        import wandb_file

        (path,) = logged.glob("wandb/offline-run-*/run-*.wandb")
        wandb_file.wait_for_end(path)
        return path

    def test_the_history_holds_every_row_by_frames(self, logged, file):
        import wandb_file

        iterations = [row for row in wandb_file.history(file) if "train/iteration" in row]

        with (logged / "metrics.csv").open() as metrics:
            for written, row in zip(csv.DictReader(metrics), iterations, strict=True):
                assert row["frames"] == int(written.pop("frames"))
                for name, value in written.items():
                    assert row[f"train/{name}"] == float(value)

    def test_the_history_holds_every_evaluation(self, logged, file):
        import wandb_file

        evaluations = [row for row in wandb_file.history(file) if "evaluation/success_rate" in row]

        lines = [json.loads(line) for line in (logged / "evaluations.jsonl").read_text().splitlines()]
        assert [row["frames"] for row in evaluations] == [line["frames"] for line in lines]
        for row, line in zip(evaluations, lines, strict=True):
            assert row["evaluation/final_distance"] == line["final_distance"]["mean"]
            assert row["evaluation/success_rate_high"] == line["success_rate"]["high"]

    def test_configuration_and_final_metrics_are_there(self, logged, file):
        import wandb_file

        config = wandb_file.config(file)
        assert config["algo"]["clip_epsilon"] == 0.2
        assert config["rod"]["n_elements"] == 20
        final = json.loads((logged / "summary.json").read_text())["final_evaluation"]
        summary = wandb_file.summary(file)
        assert summary["final/torque_joint"] == final["torque_joint"]["mean"]
        assert summary["final/episodes"] == 5

    def test_the_final_episodes_are_a_table(self, logged, file):
        (table,) = file.parent.glob("files/media/table/episodes_*.table.json")
        table = json.loads(table.read_text())

        with (logged / "episodes.csv").open() as episodes:
            written = list(csv.DictReader(episodes))
        assert table["columns"] == list(written[0])
        lengths = [row[table["columns"].index("length")] for row in table["data"]]
        assert lengths == [int(row["length"]) for row in written]

    def test_one_episode_is_a_video(self, file):
        av = pytest.importorskip("av")
        (video,) = file.parent.glob("files/media/videos/episode_*.mp4")

        with av.open(str(video)) as container:
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert len(frames) > 10
        assert frames[0].shape == (360, 480, 3)
        assert frames[0].std() > 5.0

    def test_parts_of_a_resumed_run_lie_side_by_side_and_none_is_uploaded_over_another(self, tmp_path, file):
        import wandb_file

        config = compose(["logger=wandb"])
        for frames in (0, 16, 32):
            with Loggers(config, tmp_path, frames) as loggers:
                loggers.metrics({"frames": frames + 16, "loss": 1.0})
                loggers.evaluation(frames + 16, {"length": 2.0})
                assert list(loggers.active) == ["wandb"]

        paths = sorted(tmp_path.glob("wandb/offline-run-*/run-*.wandb"), key=lambda path: len(path.stem))
        first = (tmp_path / "wandb/run_id").read_text()
        assert {path.stem for path in paths} == {f"run-{first}", f"run-{first}-16", f"run-{first}-32"}
        deadline = time.monotonic() + 60  # W&B writes in a process of its own
        while len(rows := [row for path in paths for row in wandb_file.history(path)]) < 3:
            assert time.monotonic() < deadline
            time.sleep(0.2)
        assert sorted(row["_step"] for row in rows) == sorted(row["frames"] for row in rows)
        assert {row["_step"] for row in rows} == {16, 32, 48}


class TestTensorboard:
    @staticmethod
    def scalars(folder):
        event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
        events = event_accumulator.EventAccumulator(str(folder / "tensorboard"), {"scalars": 0, "histograms": 0})
        events.Reload()
        return {tag: [(event.step, event.value) for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}

    def test_scalars_are_every_number_by_frames(self, logged):
        found = self.scalars(logged)

        with (logged / "metrics.csv").open() as metrics:
            written = list(csv.DictReader(metrics))
        frames = [int(row["frames"]) for row in written]
        for name in written[0].keys() - {"frames"}:
            expected = [float(torch.tensor(float(row[name]))) for row in written]
            assert found[f"train/{name}"] == list(zip(frames, expected, strict=True))
        lines = [json.loads(line) for line in (logged / "evaluations.jsonl").read_text().splitlines()]
        assert [step for step, _ in found["evaluation/success_rate"]] == [line["frames"] for line in lines]
        assert found["final/success_rate"] == [(48, 0.0)]

    def test_what_a_resumed_run_repeats_replaces_what_was_lost(self, tmp_path):
        config = compose(["logger=tensorboard"])
        with Loggers(config, tmp_path) as loggers:
            for frames in (16, 32, 48):
                loggers.metrics({"frames": frames, "loss": 1.0})
        with Loggers(config, tmp_path, 16) as loggers:
            loggers.metrics({"frames": 32, "loss": 2.0})

        assert self.scalars(tmp_path)["train/loss"] == [(16, 1.0), (32, 2.0)]

    def test_a_run_that_is_replaced_leaves_no_curve(self, tmp_path):
        for loss in (1.0, 2.0):
            with Loggers(compose(["logger=tensorboard"]), tmp_path) as loggers:
                loggers.metrics({"frames": 16, "loss": loss})

        assert self.scalars(tmp_path)["train/loss"] == [(16, 2.0)]


def assert_one_line(text, says):
    lines = [line for line in text.splitlines() if line.strip()]
    assert len(lines) == 1, text
    assert lines[0].startswith(f"softgm_bench: {says}"), text
    assert lines[0].endswith("the run goes on, its folder has everything"), text


def test_a_run_whose_loggers_cannot_write_ends_as_one_without_any(tmp_path, alone, capsys):
    (tmp_path / "wandb").write_text("a file where a folder is needed")
    (tmp_path / "tensorboard").write_text("")

    train(compose([*TINY, f"run_dir={tmp_path}", "logger=[wandb,tensorboard]"]))

    assert rows(tmp_path / "metrics.csv") == rows(alone / "metrics.csv")
    assert rows(tmp_path / "episodes.csv") == rows(alone / "episodes.csv")
    warnings = [line for line in capsys.readouterr().err.splitlines() if "logger" in line]
    assert [line.split(" (")[0] for line in warnings] == [
        "softgm_bench: logger wandb stopped",
        "softgm_bench: logger tensorboard stopped",
    ]


def test_a_logger_that_fails_half_way_is_told_no_more_and_the_others_are(tmp_path, monkeypatch, capsys):
    told = {"wandb": [], "tensorboard": []}

    class Fake:
        def __init__(self, name):
            self.name = name

        def log(self, frames, values):
            told[self.name].append((frames, values))
            if self.name == "wandb" and frames == 32:
                raise ConnectionError("nobody answers\nat all")

        def close(self, failed):
            told[self.name].append(failed)

    monkeypatch.setattr(guarded, "_open", lambda name, *_: Fake(name))
    with Loggers(compose(["logger=[wandb,tensorboard]"]), tmp_path) as loggers:
        for frames in (16, 32, 48):
            loggers.metrics({"frames": frames, "loss": 0.5, "success_rate": float("nan")})

    assert told["wandb"] == [(16, {"train/loss": 0.5}), (32, {"train/loss": 0.5})]
    assert told["tensorboard"] == [*told["wandb"], (48, {"train/loss": 0.5}), False]
    assert_one_line(capsys.readouterr().err, "logger wandb stopped (ConnectionError: nobody answers)")


def test_a_package_that_is_missing_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "wandb", None)
    monkeypatch.delitem(sys.modules, "softgm_bench.runs.loggers.wandb", raising=False)

    with Loggers(compose(["logger=wandb"]), tmp_path) as loggers:
        loggers.metrics({"frames": 16, "loss": 1.0})

    assert_one_line(capsys.readouterr().err, "logger wandb stopped (wandb is not installed: pip install 'softgm-bench[")


NO_SERVER = """
import sys
from pathlib import Path
from softgm_bench.config import compose
from softgm_bench.runs.loggers import wandb
from softgm_bench.runs.loggers.guarded import Loggers

wandb.INIT_SECONDS = 2.0
with Loggers(compose(["logger=wandb", "logger.wandb.mode=online"]), Path(sys.argv[1])) as loggers:
    loggers.metrics({"frames": 16, "loss": 1.0})
print("went on")
"""
LOGIN = "wandb: [wandb.login()] Loaded credentials for http://127.0.0.1:9 from WANDB_API_KEY.\n"


@pytest.mark.slow
def test_without_a_server_the_run_goes_on(tmp_path):
    pytest.importorskip("wandb")
    nobody = {"WANDB_BASE_URL": "http://127.0.0.1:9", "WANDB_API_KEY": "0" * 40}

    result = subprocess.run(
        [sys.executable, "-c", NO_SERVER, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
        env=os.environ | nobody,
    )

    assert result.stdout == "went on\n"
    assert_one_line(result.stderr.replace(LOGIN, ""), "logger wandb stopped (")


def test_a_disk_that_fills_up_costs_one_line(tmp_path, capsys):
    pytest.importorskip("tensorboard")
    largest, beyond = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, beyond))
    try:
        with Loggers(compose(["logger=tensorboard", "logger.tensorboard.flush_seconds=1"]), tmp_path) as loggers:
            for frames in range(2000):
                loggers.metrics({"frames": frames, **{str(name): 1.0 for name in range(40)}})
                if not loggers.active:
                    break
                time.sleep(0.005)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (largest, beyond))

    assert not loggers.active
    errors = capsys.readouterr().err
    assert_one_line(errors, "logger tensorboard stopped (")
    assert "File too large" in errors


@pytest.mark.parametrize(
    ("override", "says"),
    [
        ("logger.wandb.mode=onlin", "logger.wandb.mode=onlin: choose one of online"),
        ("logger.wandb.project=''", "logger.wandb.project is empty"),
        ("logger.tensorboard.flush_seconds=0", "logger.tensorboard.flush_seconds=0: it must be at least 1"),
        ("logger.csv=false", "logger.csv=False: it must be true"),
    ],
)
def test_settings_that_make_no_sense_are_refused(override, says):
    with pytest.raises(UserError, match=says):
        compose(["logger=[csv,wandb,tensorboard]", override])


def test_nested_numbers_get_names_of_their_own():
    nested = {"episodes": 4, "success_rate": {"mean": 0.5, "low": 0.1}, "note": "none", "gone": None}

    assert flattened(nested) == {"episodes": 4, "success_rate": 0.5, "success_rate_low": 0.1}


@pytest.mark.parametrize("chosen", ["[wandb,csv]", "[csv,wandb]", "wandb"])
def test_the_order_of_loggers_does_not_matter(chosen):
    logger = compose([f"logger={chosen}"]).logger

    assert logger.csv
    assert logger.wandb is not None
    assert logger.tensorboard is None


@pytest.mark.parametrize("name", ["wandb", "tensorboard"])
def test_a_logger_that_was_asked_for_and_is_not_installed_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, name
):
    monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(UserError, match=rf"^logger={name}: {name} is not installed: pip install {name}, or choose"):
        train(compose([*TINY, f"run_dir={tmp_path / 'run'}", f"logger={name}"]))
    assert not (tmp_path / "run").exists()
