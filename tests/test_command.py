import sys
from dataclasses import dataclass

import pytest

from softgm_bench import command
from softgm_bench.errors import UserError


@dataclass
class Options:
    episodes: int = 100
    out: str | None = None


def test_a_path_own_settings_and_a_policys_are_told_apart_in_any_order():
    path, options, others = command.parse(
        ["episodes=3", "runs/a", "task=wall", "perturbation.steps=2"], Options, "run", others=True
    )
    assert (str(path), options, others) == ("runs/a", Options(episodes=3), ["task=wall", "perturbation.steps=2"])


def test_what_exists_is_a_path_whatever_its_name(tmp_path):
    folder = tmp_path / "episodes=5"
    folder.mkdir()
    path, options, _ = command.parse([str(folder)], Options, "run")
    assert (path, options) == (folder, Options())


MISTAKES = {
    "no path": (["episodes=3"], True, "give one run, found none; settings are written key=value"),
    "two paths": (["a", "b"], True, "give one run, found a, b; "),
    "an option": (["--fast"], True, "give one run, found --fast; "),
    "unknown": (["a", "episode=3"], True, "episode: no such setting; did you mean episodes?"),
    "unlike any": (
        ["a", "xyz=3"],
        True,
        "xyz: no such setting; choose from episodes, out, task, rod, perturbation, randomise, ",
    ),
    "nothing of a policy's": (["a", "task=wall"], False, "task: no such setting; choose from episodes, out"),
    "wrong type": (["a", "episodes=many"], True, "episodes: Value 'many' of type 'str' could not be"),
    "unreadable": (["a", "out=[1"], True, "out=[1: a value that cannot be read"),
}


@pytest.mark.parametrize(("arguments", "others", "says"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_refused_in_one_line(arguments, others, says):
    with pytest.raises(UserError) as caught:
        command.parse(arguments, Options, "run", others=others)
    assert str(caught.value).startswith(says)
    assert "\n" not in str(caught.value)


def fail(error):
    def body(arguments):
        raise error

    return body


@pytest.mark.parametrize(
    ("error", "status", "line"),
    [
        (UserError("x is 3: it must be 2"), 2, "softgm_bench.name: x is 3: it must be 2\n"),
        (FileNotFoundError(2, "No such file or directory", "a.pt"), 2, "softgm_bench.name: a.pt: No such file or"),
        (KeyboardInterrupt(), 130, "softgm_bench.name: interrupted\n"),
    ],
)
def test_errors_of_the_user_are_one_line_and_a_status(monkeypatch, capsys, error, status, line):
    monkeypatch.setattr(sys, "argv", ["name", "a"])
    assert command.run("name", "text", fail(error)) == status
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err.startswith(line)
    assert printed.err.count("\n") == 1


def test_an_error_of_ours_is_not_hidden(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["name"])
    with pytest.raises(ZeroDivisionError):
        command.run("name", "text", lambda arguments: 1 / 0)


def test_help_is_printed_and_nothing_is_done(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["name", "a", "--help"])
    assert command.run("name", "\nhow to use it\n", fail(UserError("never"))) == 0
    assert capsys.readouterr().out == "how to use it\n"


def test_all_went_well(monkeypatch):
    monkeypatch.setattr(sys, "argv", ["name", "a", "b=1"])
    seen = []
    assert command.run("name", None, seen.extend) == 0
    assert seen == ["a", "b=1"]
