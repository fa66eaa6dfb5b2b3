"""The command that certifies scenes."""

import subprocess
import sys

import pytest

from softgm_bench import certify
from softgm_bench.episodes import certified

SMALL = ("task=basic", "task.success_radius=0.3", "rod.n_elements=20", "episodes=6", "steps=40")


def call(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["certify", *arguments])
    code = certify.main()
    return code, capsys.readouterr()


def test_it_writes_what_it_finds_and_goes_on_from_it(tmp_path, monkeypatch, capsys):
    out = tmp_path / "basic.npz"
    code, printed = call(monkeypatch, capsys, *SMALL, f"out={out}", "minutes=0.1")
    assert code == 0
    first = certified.load(out)
    assert first.scenes == 6
    assert f"{(first.length > 0).sum()} certified of 6 tried of 6" in printed.out
    code, _ = call(monkeypatch, capsys, *SMALL, f"out={out}", "minutes=0")
    assert code == 0
    assert ((certified.load(out).length > 0) == (first.length > 0)).all()
    code, printed = call(monkeypatch, capsys, *SMALL, f"out={out}", "seed=1")
    assert code == 2
    assert "holds other scenes" in printed.err


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["episodes=3"], "name a task"),
        (["task=basic", "episodes=0"], "episodes=0"),
        (["task=basic", "minutes=-1"], "minutes=-1"),
        (["task=basic", "threads=1000"], "threads=1000"),
        (["task=basic", "nothing=1"], "nothing"),
        (["task=wall_sliding"], "task=wall_sliding: its obstacles move"),
        (["task=vmas_balance", "model=vector_mlp"], "model"),
    ],
)
def test_settings_that_make_no_sense_are_refused_in_one_line(arguments, message, monkeypatch, capsys):
    code, printed = call(monkeypatch, capsys, *arguments)
    assert code == 2
    assert message in printed.err
    assert printed.err.count("\n") == 1


@pytest.mark.slow
def test_the_module_runs_as_a_command(tmp_path):
    command = [sys.executable, "-m", "softgm_bench.certify", *SMALL, f"out={tmp_path / 'basic.npz'}", "minutes=0"]
    assert subprocess.run(command, check=False, timeout=300).returncode == 0
