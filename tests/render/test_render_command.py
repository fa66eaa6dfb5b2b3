import importlib.util
import sys
from pathlib import Path

import pytest
from arms import bending_arm
from PIL import Image

from softgm_bench import command
from softgm_bench.episodes import trajectory
from softgm_bench.render import __main__ as render

POLICY = Path(__file__).parents[2] / "experiments" / "policies" / "basic_softgm.pt"
SMALL = ("width=64", "height=48")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("recorded") / "episode.npz"
    trajectory.save(bending_arm(attention=False), path)
    return path


def run(monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["render", *map(str, arguments)])
    return command.run("render", render.__doc__, render.main)


def test_a_recorded_episode_becomes_every_kind_of_file(monkeypatch, capsys, recorded, tmp_path):
    files = [tmp_path / "new" / f"arm{kind}" for kind in render.KINDS]
    arguments = ["out=" + ",".join(map(str, files)), *SMALL, "fps=5", "speed=1"]
    assert run(monkeypatch, recorded, *arguments) == 0
    assert sorted(tmp_path.glob("new/*")) == sorted(files)  # and no temporary ones
    printed = capsys.readouterr().out
    assert all(str(file) in printed and file.stat().st_size > 100 for file in files)
    with Image.open(files[0]) as image:
        assert image.size == (64, 48)


def test_a_policy_is_recorded_drawn_and_kept(monkeypatch, tmp_path):
    out, kept = tmp_path / "a.png", tmp_path / "a.npz"
    chosen = ("seed=1", "horizon=3", "attention=true", "task.n_agents=4")
    assert run(monkeypatch, POLICY, f"out={out}", f"save={kept}", *chosen, *SMALL) == 0
    episode = trajectory.load(kept)
    assert (episode.steps, episode.n_agents, episode.info["seed"]) == (3, 4, 1)
    again = tmp_path / "b.png"
    assert run(monkeypatch, kept, f"out={again}", "attention=true", *SMALL) == 0
    assert again.read_bytes() == out.read_bytes()


def test_the_chosen_step_is_drawn(monkeypatch, recorded, tmp_path):
    for name, step in (("start", "step=0"), ("end", "step=6"), ("last", "text=false")):
        assert run(monkeypatch, recorded, f"out={tmp_path / name}.png", step, *SMALL) == 0
    start, end, last = ((tmp_path / f"{name}.png").read_bytes() for name in ("start", "end", "last"))
    assert start != end == last


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        ((), "out: name a file"),
        (("out=a.bmp",), "a.bmp: its name must end in one of .png"),
        (("out=a,b.png",), "out=a,b.png: commas stand between files, and a ends in none of .png"),
        (("out=a.png", "width=5"), "width is 5"),
        (("out=a.mp4", "height=49"), "height is 49: an MP4 video needs an even number"),
        (("out=a.mp4", "speed=-1"), "speed is -1.0: it must be above 0"),
        (("out=a.png", "step=7"), "step is 7: this episode has steps 0 to 6"),
        (("out=a.png", "step=nan"), "step=nan: it must be a finite number"),
        (("out=a.png", "elevation=90"), "elevation is 90.0"),
        (("out=a.png", "azimuth=nan"), "azimuth=nan: it must be a finite number"),
        (("out=a.png", "fps=many"), "fps"),
        (("out=a.png", "seed=1"), "is recorded already"),
        (("out=a.png", "task=wall"), "takes no settings"),
        (("out=a.png", "save=a.txt"), "a.txt: a trajectory's file ends in .npz"),
        (("out=a.png", "attention=true"), "attention: this episode has none"),
    ],
)
def test_what_makes_no_sense_is_one_line(monkeypatch, capsys, recorded, tmp_path, arguments, told):
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, recorded, *arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert told in error
    assert not list(tmp_path.iterdir())


def test_a_missing_source_is_one_line(monkeypatch, capsys, tmp_path):
    assert run(monkeypatch, tmp_path / "none.npz", "out=a.png") == 2
    assert run(monkeypatch, "out=a.png") == 2
    assert capsys.readouterr().err.count("\n") == 2


def test_a_file_that_cannot_be_written_is_one_line(monkeypatch, capsys, recorded, tmp_path):
    (tmp_path / "file").touch()
    assert run(monkeypatch, recorded, f"out={tmp_path / 'file' / 'a.png'}", *SMALL) == 2
    assert "choose a file that can be written" in capsys.readouterr().err


def test_what_is_not_installed_is_named(monkeypatch, capsys, recorded):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "av" else find(name))
    assert run(monkeypatch, recorded, "out=a.mp4") == 2
    assert "pip install '.[render]'" in capsys.readouterr().err
