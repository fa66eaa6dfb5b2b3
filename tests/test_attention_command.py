"""``python -m softgm_bench.attention``, called as Python calls it."""

import dataclasses
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

sys.path.insert(0, str(Path(__file__).parent / "episodes"))
from recorded import SEEN, untrained, watched

from softgm_bench import attention
from softgm_bench.episodes import policy, recording, trajectory


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    threads = torch.get_num_threads()
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["attention", *map(str, arguments)])
        status = attention.main()
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    yield call
    torch.set_num_threads(threads)


def test_a_policys_episode_gives_arrays_and_pictures(run, tmp_path):
    policy.save(untrained(*SEEN), tmp_path / "kept.pt")
    status, out, err = run("kept.pt", "episode=1", "horizon=5", "steps=[0,4]", "threads=1")
    assert (status, err) == (0, "")
    files = [Path(line) for line in out.splitlines()]
    names = ["attention.npz", "overview.png", "step0000.png", "step0000_heads.png", "step0004.png"]
    assert [file.name for file in files] == [*names, "step0004_heads.png"]
    assert files[0].parent == Path("outputs/attention/kept/wall_seed0_episode1of2")
    for file in files[1:]:
        assert file.read_bytes().startswith(b"\x89PNG")
    one = recording.record(untrained(*SEEN), 0, 1, 5, attention=True)
    with np.load(files[0]) as arrays:
        assert np.allclose(arrays["stage1"], one.attention["stage1"], atol=1e-6)
        assert np.allclose(arrays["stage2"], one.attention["stage2"], atol=1e-6)
        assert np.array_equal(arrays["edge"], one.observation["agents/edge"][:-1])


def test_a_recorded_episode_is_drawn_without_its_policy(run, tmp_path):
    trajectory.save(watched(*SEEN), tmp_path / "episode.npz")
    status, out, _ = run("episode.npz", "out=drawn", "steps=[3]")
    assert status == 0
    assert len(out.splitlines()) == 4
    assert (tmp_path / "drawn" / "step0003_heads.png").exists()


def test_mistakes_are_one_line(run, tmp_path):
    policy.save(untrained("task=basic", "algo=mappo"), tmp_path / "mlp.pt")
    trajectory.save(watched(*SEEN), tmp_path / "episode.npz")
    trajectory.save(dataclasses.replace(watched(*SEEN), attention={}), tmp_path / "blind.npz")
    mistakes = {
        ("mlp.pt",): "mlp.pt: its model has no attention of two stages; name a policy",
        ("blind.npz",): "blind.npz: this episode has no attention; record one",
        ("episode.npz", "seed=1"): "seed=1: episode.npz is recorded already",
        ("episode.npz", "task=wall"): "task=wall: episode.npz is recorded already",
        ("episode.npz", "steps=[30]"): "steps=30: the episode's steps are 0 to 29",
        ("absent.pt",): "absent.pt: No such file or directory",
        ("mlp.pt", "threads=0"): "threads=0: choose 1 to",
    }
    for arguments, says in mistakes.items():
        status, out, err = run(*arguments)
        assert (status, out) == (2, "")
        assert err.startswith(f"softgm_bench.attention: {says}")
        assert err.count("\n") == 1
    assert not list(tmp_path.glob("outputs/**/*.png"))
