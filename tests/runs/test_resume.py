"""A run that is interrupted anywhere and resumed is the run that was not."""

import fcntl
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import pytest
import torch
from interrupted import PPO, SMALL, TINY, differences, start, state, written

from kept_threads import kept_threads
from pairwise import partly
from softgm_bench.config import compose
from softgm_bench.errors import UserError
from softgm_bench.runs import checkpoint, ending, loop
from softgm_bench.runs.interruption import Interrupted
from softgm_bench.runs.metrics import CsvWriter
from softgm_bench.storage.run_folder import RunFolder

OFF_POLICY = (
    "algo.batch_size=8",
    "algo.random_frames=40",
    "algo.updates_per_frame=0.11",
    "algo.replay_capacity=100",
    "algo.checkpoint_replay=true",
)
CURRICULUM = (
    "task.curriculum.enabled=true",
    "task.curriculum.episodes=4",
    "task.curriculum.promote=0.3",
    "task.curriculum.demote=0.1",
    "task.success_radius=0.7",
)
RUNS = {
    "softgm with everything that moves": (
        "task=wall",
        "algo=softgm",
        "model.hidden=16",
        "perturbation=noise",
        "algo.value_norm_decay=0.9",
        "algo.lr_schedule=linear",
        "algo.target_kl=0.001",
        "algo.critic.asymmetric=true",
        *CURRICULUM,
        *PPO,
    ),
    "softgm that remembers": (
        "task=wall",
        "algo=softgm",
        "model.hidden=16",
        "perturbation=noise",
        "algo.actor.memory={cell:gru,size:8}",
        "algo.target_kl=0.001",
        *PPO,
    ),
    "softgm over a mixture of sections": (
        "task=wall",
        "task.n_agents=[4,6,5]",
        "model.hidden=16",
        "perturbation=noise",
        "algo.value_norm_decay=0.9",
        *CURRICULUM,
        *PPO,
    ),
    "mappo in float32": ("task=structured", "algo=mappo", "dtype=float32", *PPO),
    "isac": ("task=wall", "algo=isac", "perturbation=disturbance", "perturbation.first_step=1", *OFF_POLICY),
    "maddpg": ("task=basic", "algo=maddpg", "algo.noise_correlation=0.5", "algo.sigma_frames=100", *OFF_POLICY),
    "ippo on VMAS": ("task=vmas_balance", "algo=ippo", "model=vector_mlp", *PPO),
    "masac on VMAS": ("task=vmas_balance", "algo=masac", "model=vector_mlp", *OFF_POLICY),
}


QUICK = ("softgm that remembers", "mappo in float32", "maddpg", "masac on VMAS")


class Death(BaseException):
    """What nothing catches, as nothing catches a kill."""


@pytest.fixture(autouse=True)
def _threads_as_before():
    with kept_threads():
        yield


def train(folder, *overrides):
    return loop.train(compose([*overrides, f"run_dir={folder}"]))


def train_until(iteration, folder, *overrides):
    """Train until the row of an iteration is written, and no further."""
    write = CsvWriter.write

    def write_and_die(self, row):
        write(self, row)
        if row.get("iteration") == iteration:
            raise Death

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(CsvWriter, "write", write_and_die)
        with pytest.raises(Death):
            train(folder, *overrides)


def lines(capsys):
    return [line for line in capsys.readouterr().err.splitlines() if line.strip()]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folder of a run of SMALL that was never interrupted: 10 iterations, evaluations after 3, 6 and 9."""
    folder = tmp_path_factory.mktemp("whole")
    train(folder, *SMALL)
    return folder


@pytest.fixture
def broken(tmp_path):
    """Folder of the same run that has written its 7th row; its checkpoints are those after 4 and 6 iterations."""
    train_until(7, tmp_path / "run", *SMALL)
    return tmp_path / "run"


# the numbers


@pytest.mark.parametrize("overrides", partly(RUNS, QUICK))
def test_going_on_gives_the_numbers_of_a_run_that_was_never_broken_off(tmp_path, overrides):
    if "task=vmas_balance" in overrides:
        pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
    one, other = tmp_path / "one", tmp_path / "other"
    train(one, *TINY, *overrides)

    train_until(3, other, *TINY, *overrides)
    train_until(7, other, *TINY, *overrides, "resume=true")
    train(other, *TINY, *overrides, "resume=true")

    rows = written(one)[0]
    assert len(rows) == 10
    if "task.curriculum.enabled=true" in overrides:
        assert len({row["difficulty"] for row in rows}) > 2  # it does move
    assert written(other) == written(one)
    assert differences(state(other), state(one)) == []


def test_two_states_that_differ_in_one_bit_are_told_apart(whole):
    one, other = state(whole), state(whole)
    assert differences(one, other) == []

    other["environment"]["simulation"]["episodes"]["rod"]["position"][0, 0, 0] += 1e-12
    assert differences(one, other) == ["/environment/simulation/episodes/rod/position"]


def test_without_the_replay_gradient_steps_pause_until_it_has_filled_again(tmp_path):
    overrides = (*TINY, "algo=isac", *OFF_POLICY, "algo.checkpoint_replay=false")
    train_until(7, tmp_path, *overrides)
    train(tmp_path, *overrides, "resume=true")

    rows = written(tmp_path)[0]
    assert [float(row["gradient_steps"]) > 0 for row in rows] == [*[False] * 2, *[True] * 4, *[False] * 2, *[True] * 2]
    assert [row["replay_size"] for row in rows][5:8] == ["96.0", "16.0", "32.0"]


def test_the_clock_goes_on_from_the_checkpoint(broken):
    before = checkpoint.load(RunFolder(broken).newest())["counters"]["wall_time"]
    time.sleep(0.5)  # between the two
    began = time.perf_counter()
    summary = train(broken, *SMALL, "resume=true")

    assert before < summary["wall_time"] < before + time.perf_counter() - began


def test_a_run_can_be_made_longer_even_when_it_has_finished(tmp_path, whole):
    short = tuple("experiment.total_frames=96" if item.startswith("experiment.total") else item for item in SMALL)
    train(tmp_path, *short)

    train(tmp_path, *SMALL, "resume=true")

    assert written(tmp_path) == written(whole)
    assert differences(state(tmp_path), state(whole)) == []


# signals


def test_an_evaluation_that_a_signal_broke_off_is_made_up_for(tmp_path, whole, monkeypatch):
    def interrupted(*_):
        raise Interrupted(signal.SIGTERM)

    with monkeypatch.context() as patch:
        patch.setattr(ending, "play", interrupted)
        with pytest.raises(Interrupted, match="after 48 frames, resume=true resumes it"):
            train(tmp_path, *SMALL)
    train(tmp_path, *SMALL, "resume=true")

    assert written(tmp_path) == written(whole)


@pytest.mark.slow
def test_a_process_that_is_killed_again_and_again_finishes_the_run(tmp_path, whole):
    metrics, chance = tmp_path / "metrics.csv", random.Random()
    kills = 0
    while kills < 3:
        rows = metrics.read_text().count("\n") if metrics.exists() else 0
        process = start(*SMALL, f"run_dir={tmp_path}", "resume=true")
        deadline = time.monotonic() + 120
        while process.is_alive() and not (metrics.exists() and metrics.read_text().count("\n") != rows):
            assert time.monotonic() < deadline
            time.sleep(0.002)
        time.sleep(chance.uniform(0.0, 0.3))
        process.kill()
        process.join()
        if process.exitcode != -signal.SIGKILL:
            break
        kills += 1
    assert kills

    train(tmp_path, *SMALL, "resume=true")
    assert written(tmp_path) == written(whole)
    assert differences(state(tmp_path), state(whole)) == []


@pytest.mark.slow
def test_it_may_be_killed_at_the_worst_moments(tmp_path, whole):
    moments = [
        ("config.yaml", True),  # before there is a run
        ("config.yaml", False),
        (".rehearsal/summary.json", True),  # while the end is rehearsed
        ("frames-000000000032", True),  # before its first checkpoint is in place
        ("frames-000000000064", True),  # with another behind it
        ("frames-000000000096", False),  # before older ones are removed
        ("summary.json", True),  # at its end
    ]
    for name, before in moments:
        process = start(*SMALL, f"run_dir={tmp_path}", "resume=true", dying=(name, before))
        process.join(120)
        assert process.exitcode == -signal.SIGKILL, (name, before)
    train(tmp_path, *SMALL, "resume=true")

    assert written(tmp_path) == written(whole)
    assert differences(state(tmp_path), state(whole)) == []
    assert not list(tmp_path.rglob(".*"))
    assert len(list((tmp_path / "checkpoints").iterdir())) == 2


# checkpoints


def test_a_damaged_checkpoint_is_passed_over_in_one_line(broken, whole, capsys):
    newest = RunFolder(broken).newest()
    newest.write_bytes(newest.read_bytes()[:-100])
    capsys.readouterr()

    train(broken, *SMALL, "resume=true")

    said = lines(capsys)
    assert said[0].startswith(f"passed over {newest}: damaged")
    assert said[1] == f"{broken}: resuming after 64 frames"
    assert written(broken) == written(whole)


def test_if_all_checkpoints_are_damaged_nothing_is_lost(broken):
    for path in RunFolder(broken).in_order():
        path.write_bytes(b"")
    before = {path: path.read_bytes() for path in broken.rglob("*") if path.is_file()}

    with pytest.raises(UserError, match=r"no checkpoint here can be used; to begin anew, give overwrite=true[^\n]*$"):
        train(broken, *SMALL, "resume=true")
    assert before == {path: path.read_bytes() for path in broken.rglob("*") if path.is_file()}


def test_a_damaged_checkpoint_does_not_push_out_the_whole_ones(tmp_path):
    folder = RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    paths = [checkpoint.save(folder, frames, {}, keep=2) for frames in (100, 300)]
    paths[1].write_bytes(b"damaged")

    assert sorted(folder.checkpoints.iterdir()) == sorted([paths[0], paths[1]])
    newer = checkpoint.save(folder, 200, {}, keep=2)
    assert sorted(folder.checkpoints.iterdir()) == [paths[0], newer]


def test_without_a_checkpoint_it_begins_anew_and_says_so(tmp_path, whole, capsys):
    train_until(1, tmp_path / "run", *SMALL)
    capsys.readouterr()

    train(tmp_path / "run", *SMALL, "resume=true")

    assert lines(capsys)[0] == f"{tmp_path / 'run'}: no checkpoint to resume from, the run begins anew"
    assert written(tmp_path / "run") == written(whole)


def test_rows_that_are_missing_are_not_papered_over(broken):
    metrics = broken / "metrics.csv"
    metrics.write_text("".join(metrics.read_text().splitlines(keepends=True)[:4]))

    with pytest.raises(UserError, match=r"metrics\.csv: what stood there before the checkpoint is missing; [^\n]*$"):
        train(broken, *SMALL, "resume=true")
    assert metrics.read_text().count("\n") == 4


def test_a_checkpoint_of_another_version_is_refused_in_one_line(broken):
    newest = RunFolder(broken).newest()
    held = checkpoint.load(newest)
    del held["environment"]["shown"]
    torch.save(held, newest)

    with pytest.raises(UserError, match=r"^[^\n]*: this version cannot resume from its checkpoint; [^\n]*$"):
        train(broken, *SMALL, "resume=true")


# disks

FULL_DISK = """
mount -t tmpfs -o size="$1" tmpfs disk || exit 100
shift
"$@"; first=$?
ls -A disk/run/checkpoints
mount -o remount,size=1g disk
"$@" resume=true; second=$?
"$@" resume=true; third=$?
cp -r disk/run copy
echo "$first $second $third"
"""


@pytest.mark.slow
def test_a_run_whose_disk_was_full_goes_on_where_there_is_room_again(tmp_path, whole):
    """The commands themselves, on a disk of their own with room for two checkpoints and a half."""
    (tmp_path / "disk").mkdir()
    size = int(2.5 * RunFolder(whole).newest().stat().st_size)
    command = [sys.executable, "-m", "softgm_bench", *SMALL, "run_dir=disk/run"]
    namespace = ["unshare", "--map-root-user", "--mount", "sh", "-c", FULL_DISK, "sh", str(size)]
    if shutil.which("unshare") is None:
        pytest.skip("no unshare here")
    result = subprocess.run([*namespace, *command], cwd=tmp_path, capture_output=True, text=True, check=False)
    if not result.stdout or result.returncode == 100:
        pytest.skip(f"no disk of its own may be mounted here: {result.stderr}")

    listed = ["frames-000000000032.pt", "frames-000000000064.pt"]  # nothing half written
    said = result.stdout.splitlines()
    assert said[:2] == listed
    assert said[-2:] == ["disk/run: finished already", "2 0 0"]
    errors = [line for line in result.stderr.splitlines() if line.startswith(("softgm_bench:", "disk/run:"))]
    assert errors == [
        "softgm_bench: disk/run: No space left on device; earlier checkpoints are whole, resume=true resumes it",
        "disk/run: resuming after 64 frames",
    ]
    assert written(tmp_path / "copy") == written(whole)


@pytest.mark.slow
def test_where_no_checkpoint_can_be_written_a_run_ends_before_it_trains(tmp_path, whole):
    process = start(*SMALL, f"run_dir={tmp_path}", file_size=20_000)
    process.join(120)
    assert process.exitcode == 1
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoints", "config.yaml"]
    assert not list((tmp_path / "checkpoints").iterdir())

    train(tmp_path, *SMALL, "resume=true")
    assert written(tmp_path) == written(whole)


# settings and folders


def test_a_finished_run_is_left_as_it_is(whole, capsys):
    before = {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in whole.rglob("*")}
    capsys.readouterr()

    summary = train(whole, *SMALL, "resume=true", "overwrite=true")

    assert capsys.readouterr().out == f"{whole}: finished already\n"
    assert summary == json.loads((whole / "summary.json").read_text())
    assert before == {path: (path.stat().st_mtime_ns, path.stat().st_ino) for path in whole.rglob("*")}


@pytest.mark.parametrize(
    ("setting", "said"),
    [
        ("seed=1", r"^seed=1: the run in \S+ has 0; give that, or choose another run_dir$"),
        ("task=wall", r"^task\.name=wall: the run in \S+ has basic; "),
        ("algo.target_kl=0.01", r"^algo\.target_kl=0\.01: the run in \S+ has null; "),
        ("experiment.total_frames=100", r"^experiment\.total_frames=100: the run has 160; it can only grow$"),
    ],
)
def test_other_settings_are_refused_by_naming_the_first(whole, broken, setting, said):
    for folder in (whole, broken):
        with pytest.raises(UserError, match=said):
            train(folder, *SMALL, setting, "resume=true")


def test_a_longer_run_with_a_schedule_keeps_the_schedule_that_it_began_with(tmp_path):
    train_until(3, tmp_path, *SMALL, "algo.lr_schedule=linear")
    longer = ("algo.lr_schedule=linear", "experiment.total_frames=192", "resume=true")

    with pytest.raises(UserError, match=r"^algo\.lr_schedule_frames=192: the run in \S+ has 160; give that"):
        train(tmp_path, *SMALL, *longer)
    train(tmp_path, *SMALL, *longer, "algo.lr_schedule_frames=160")
    assert [float(row["critic_lr"]) > 0 for row in written(tmp_path)[0]] == [True] * 9 + [False] * 3


def test_what_no_number_depends_on_may_change(broken, whole):
    free = ("experiment.checkpoint.keep=1", "experiment.checkpoint.interval=64", "overwrite=true")
    train(broken, *SMALL, *free, "resume=true")
    assert written(broken) == written(whole)
    assert len(list((broken / "checkpoints").iterdir())) == 1


def test_a_folder_without_its_settings_is_not_replaced_by_going_on(broken):
    for content in (None, "damaged: [", "seed: 0\nno_such_key: 1\n"):
        (broken / "config.yaml").unlink() if content is None else (broken / "config.yaml").write_text(content)
        with pytest.raises(UserError, match=r"config\.yaml: missing or of another version; to begin anew[^\n]*$"):
            train(broken, *SMALL, "resume=true")
    assert len(RunFolder(broken).in_order()) == 2


def test_two_processes_do_not_write_the_same_run(broken, whole):
    descriptor = os.open(broken, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        with pytest.raises(UserError, match=r"another process is at work on this run; [^\n]*$"):
            train(broken, *SMALL, "resume=true")
    finally:
        os.close(descriptor)
    train(broken, *SMALL, "resume=true")
    assert written(broken) == written(whole)
