"""``python -m softgm_bench.replay``, called as Python calls it."""

import json
import sys
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent / "episodes"))
from recorded import WALL, recorded

from softgm_bench import replay
from softgm_bench.episodes import trajectory

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    trajectory.save(recorded(*WALL, horizon=12), tmp_path / "episode.npz")

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["replay", *arguments])
        status = replay.main()
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    return call


def test_numba_says_that_every_bit_is_equal(run):
    status, out, err = run("episode.npz")
    assert (status, err) == (0, "")
    assert "recorded by numba in float64, replayed by numba in float64: equal in every bit" in out
    assert out.count("m from the target at the end, not reached") == 2


def test_pyelastica_says_how_far_it_is_at_every_time(run, tmp_path):
    pytest.importorskip("elastica")
    status, out, _ = run("episode.npz", "backend=pyelastica", "out=folder/result.json")
    assert status == 0
    assert "not equal in every bit" in out
    assert "PyElastica's bounding boxes off: they would have skipped" in out
    result = json.loads((tmp_path / "folder" / "result.json").read_text())
    assert len(result["position"]) == 13
    assert max(result["position"]) == result["largest"]["position"] < 1e-11
    assert result["missed"] >= 0
    assert max(result["contact_force"]) > 1.0
    assert f"{result['largest']['position']:.1e}" in out


def test_mistakes_are_one_line(run, tmp_path):
    (tmp_path / "kept.pt").touch()
    (tmp_path / "broken.npz").write_bytes(b"broken")
    mistakes = {
        ("kept.pt",): "kept.pt: name a recorded episode, a file that ends in .npz",
        ("broken.npz",): "broken.npz: damaged or no trajectory; record it again",
        ("absent.npz",): "absent.npz: No such file or directory",
        ("episode.npz", "backend=cuda"): "backend=cuda: choose one of numba, torch, pyelastica",
        ("episode.npz", "steps=3"): "steps: no such setting",
        ("episode.npz", "out=kept.pt/result.json"): "kept.pt: ",
    }
    for arguments, says in mistakes.items():
        status, _, err = run(*arguments)
        assert status == 2, arguments
        assert err.startswith(f"softgm_bench.replay: {says}"), err
        assert err.count("\n") == 1
