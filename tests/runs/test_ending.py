"""What the end of a run needs is tried at its beginning, and leaves nothing behind."""

import importlib.metadata

import pytest
from interrupted import SMALL, written

from softgm_bench.config import compose
from softgm_bench.episodes.evaluation import EpisodeRecords
from softgm_bench.errors import UserError
from softgm_bench.runs import checkpoint, ending, loop
from softgm_bench.runs.run import Run
from softgm_bench.storage import versions
from softgm_bench.storage.run_folder import RunFolder


@pytest.fixture(autouse=True)
def _trains_nothing(request, monkeypatch):
    """In these tests a run that trains has not been stopped in time."""
    if "allowed" not in request.node.name:

        def learned(*_):
            raise AssertionError("it trained")

        monkeypatch.setattr(loop, "_learn", learned)


def run(folder, *overrides):
    return loop.train(compose([*SMALL, f"run_dir={folder}", *overrides]))


def broken(*_, **__):
    raise RuntimeError("this cannot be done here")


@pytest.mark.parametrize(
    ("owner", "name"),
    [
        (versions, "versions"),  # what a checkpoint and the summary say; the names below look it up elsewhere
        (Run, "state_dict"),
        (checkpoint, "save"),
        (checkpoint, "load"),
        (ending, "build_envs"),  # of the final evaluation
        (ending, "evaluate"),
        (ending, "summarise"),
        (EpisodeRecords, "rows"),
        (ending, "write_atomically"),
    ],
    ids=lambda value: getattr(value, "__name__", value),
)
def test_what_the_end_could_not_do_ends_the_run_before_it_trains(tmp_path, monkeypatch, owner, name):
    monkeypatch.setattr(owner, name, broken)
    if owner is versions:
        monkeypatch.setattr(ending, "versions", broken)
    with pytest.raises(RuntimeError, match="this cannot be done here"):
        run(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["checkpoints", "config.yaml"]


def test_a_checkpoint_that_could_not_be_read_again_ends_the_run_before_it_trains(tmp_path, monkeypatch):
    monkeypatch.setattr(Run, "state_dict", lambda run: {"algorithm": {"network": broken}})
    with pytest.raises(Exception, match=r"pickle|damaged"):
        run(tmp_path)
    assert not list((tmp_path / "checkpoints").iterdir())


def test_a_disk_without_room_for_a_checkpoint_is_one_line_before_it_trains(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(checkpoint, "write_atomically", full)
    with pytest.raises(UserError, match=r"^\S+: No space left on device; [^\n]*$"):
        run(tmp_path)


def test_packages_that_are_not_installed_are_allowed(tmp_path, monkeypatch):
    def not_installed(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(versions, "version", not_installed)
    summary = run(tmp_path)
    assert set(versions.PACKAGES) < set(summary["versions"])
    assert checkpoint.load(RunFolder(tmp_path).newest())["versions"] == summary["versions"]


@pytest.mark.parametrize(
    "overrides", [(), ("task=vmas_navigation", "algo=ippo", "model=vector_mlp")], ids=["arm, allowed", "vmas, allowed"]
)
def test_no_number_depends_on_the_rehearsal(tmp_path, monkeypatch, overrides):
    if overrides:
        pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
    kept = [one for one in SMALL if overrides == () or not one.startswith(("model.", "rod."))]
    for name in ("with", "without"):
        if name == "without":
            monkeypatch.setattr(ending, "rehearse", lambda run: None)
        loop.train(compose([*kept, *overrides, f"run_dir={tmp_path / name}"]))
    assert written(tmp_path / "with") == written(tmp_path / "without")
    assert not list(tmp_path.rglob(".*"))


def test_what_a_killed_rehearsal_left_is_removed_and_never_read_allowed(tmp_path):
    left = tmp_path / ending.REHEARSAL / "checkpoints"
    left.mkdir(parents=True)
    (left.parent / "summary.json").write_text("{}")
    assert RunFolder(tmp_path).newest() is None
    run(tmp_path)
    assert not left.parent.exists()
