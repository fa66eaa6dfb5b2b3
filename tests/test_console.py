"""The console command: what it says of itself, which commands it knows, and what a shell may complete after it."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from softgm_bench import __main__ as entry
from softgm_bench import __version__
from softgm_bench.config import compose_untyped
from softgm_bench.console import COMMANDS, HELP, completions

ROOT = Path(__file__).parents[1]


def console(*arguments, **environment):
    """What the installed script does, from this checkout."""
    code = "import sys; from softgm_bench.__main__ import console; sys.argv[0] = 'softgm-bench'; sys.exit(console())"
    return subprocess.run(
        [sys.executable, "-c", code, *arguments],
        capture_output=True,
        text=True,
        env=os.environ | environment,
        timeout=120,
        cwd=ROOT,
        check=False,
    )


@pytest.mark.parametrize("arguments", [["--help"], ["-h"], ["help"]])
def test_help_explains_in_25_lines_with_three_examples_and_every_command(arguments, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["softgm-bench", *arguments])
    assert entry.main() == 0
    text = capsys.readouterr().out
    assert text == HELP
    lines = text.splitlines()
    assert len(lines) <= 25
    assert max(map(len, lines)) <= 100
    assert sum(line.startswith("  softgm-bench ") for line in lines) == 3
    assert all(re.search(rf"^  {name} ", text, re.MULTILINE) for name in COMMANDS)


def test_the_examples_of_the_help_name_files_and_settings_that_exist():
    for line in HELP.splitlines():
        if line.startswith("  softgm-bench "):
            _, command, *settings = line.partition("#")[0].split()
            assert command in COMMANDS
            for word in settings:
                assert "=" in word or word.startswith("outputs/") or (ROOT / word).is_file(), word
            if command == "train":
                compose_untyped(settings)


def test_the_console_alone_says_what_it_can_do_and_the_module_alone_still_trains(monkeypatch, capsys):
    trained = []
    monkeypatch.setattr(entry, "_train", lambda: trained.append(list(sys.argv)) or 0)
    monkeypatch.setattr(sys, "argv", ["softgm-bench"])
    assert entry.console() == 0
    assert capsys.readouterr().out == HELP
    assert entry.main() == 0
    assert trained == [["softgm-bench"]]


@pytest.mark.parametrize("arguments", [["train", "task=wall"], ["task=wall"]])
def test_train_and_no_name_are_the_same(arguments, monkeypatch):
    trained = []
    monkeypatch.setattr(entry, "_train", lambda: trained.append(sys.argv[1:]) or 0)
    monkeypatch.setattr(sys, "argv", ["softgm-bench", *arguments])
    assert entry.console() == 0
    assert trained == [["task=wall"]]


def test_the_version_is_ours(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["softgm-bench", "--version"])
    assert entry.main() == 0
    assert capsys.readouterr().out == f"softgm-bench {__version__}\n"


@pytest.mark.parametrize("name", [name for name in COMMANDS if name != "train"])
def test_each_command_has_help_that_begins_with_how_to_call_it(name, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["softgm-bench", name, "--help"])
    with pytest.raises(SystemExit) as left:
        entry.console()
    assert not left.value.code
    text = capsys.readouterr().out
    assert f"softgm-bench {name} " in text.splitlines()[0]
    assert "``" not in text


def test_help_of_training_lists_its_groups_and_flags_and_the_named_values_exist():
    text = console("train", "--help").stdout
    assert "softgm-bench train [OPTION ...]" in text
    assert "task: basic, structured" in text
    settings = re.findall(r"^  (\w+)=(\w+) +or ([\w, ]+)", text, re.MULTILINE)
    assert len(settings) >= 4
    for key, first, others in settings:
        for value in [first, *re.findall(r"\w+", others.partition(";")[0])]:
            compose_untyped([f"{key}={value}"])


def test_several_values_without_m_say_how_a_sweep_is_written():
    done = console("seed=0,1")
    assert done.returncode == 2
    assert done.stderr == (
        "softgm_bench: seed=0,1: several values; add -m for a sweep, a run for each, or write a list as seed=[0,1]\n"
    )


# completion


def test_the_first_word_is_completed_to_commands_and_settings():
    assert completions("softgm-bench ev") == (["evaluate"], "softgm-bench ev")
    assert completions("softgm-bench ")[0] == list(COMMANDS)


def test_after_train_hydra_completes_what_it_would_without():
    assert completions("softgm-bench train task=w") == ([], "softgm-bench task=w")
    assert completions("softgm-bench train -m algo=ippo ") == ([], "softgm-bench -m algo=ippo ")


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("softgm-bench evaluate run epi", ["episodes="]),
        ("softgm-bench render a.pt az", ["azimuth="]),
        ("softgm-bench evaluate run pert", ["perturbation="]),
        ("softgm-bench status outputs ", ["grid="]),
        ("softgm-bench export a ", []),
    ],
)
def test_settings_of_a_command_are_completed(line, words):
    assert completions(line) == (words, None)


def test_every_command_that_is_listed_can_be_completed():
    for name in set(COMMANDS) - {"train"}:
        completions(f"softgm-bench {name} ")


@pytest.mark.slow
def test_a_shell_completes_settings_of_a_training():
    asked = console("-sc", "query=bash", COMP_LINE="softgm-bench train task=w")
    assert set(asked.stdout.split()) == {f"task={path.stem}" for path in (ROOT / "conf/task").glob("w*.yaml")}
    script = console("--shell-completion", "install=bash")
    assert "complete -o nospace -o default -F hydra_bash_completion softgm-bench" in script.stdout
