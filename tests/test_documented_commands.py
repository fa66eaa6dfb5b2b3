"""The commands in the README and the pages: every one can be read, and those that a newcomer meets run as printed."""

import os
import re
import shlex
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import pytest

from softgm_bench import certify, command, dataset
from softgm_bench.config import compose
from softgm_bench.console import COMMANDS
from softgm_bench.sweeps import launch

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
OWN_PLUGINS = "extending.md"  # whose commands need the files that it tells to write: tests/test_extending.py runs them
MADE_BEFORE = ("outputs/", "unpacked/", "episode.npz", "SOURCE")  # by commands before, or by the reader
BLOCK = re.compile(r"^```(?:sh|bash)?\n(.*?)^```", re.MULTILINE | re.DOTALL)


def lines(page):
    """The command lines of a page's blocks, without comments."""
    for block in BLOCK.findall(page.read_text()):
        for line in block.replace("\\\n", " ").splitlines():
            yield re.sub(r"(^|\s+)# .*$", "", line).strip()


def ours(line):
    """Name and arguments of a command of ours; None for any other line."""
    words = shlex.split(line.removeprefix(".venv/bin/"))
    if words[:1] == ["softgm-bench"]:
        words = words[1:]
        return (words[0], words[1:]) if words and words[0] in COMMANDS else ("train", words)
    if words[:2] == ["python", "-m"] and words[2].split(".")[0] == "softgm_bench":
        return words[2].partition(".")[2] or "train", words[3:]
    return None


def documented():
    for page in PAGES:
        for line in lines(page):
            if line.startswith((".venv/bin/", "softgm-bench ", "python -m softgm_bench")) and page.name != OWN_PLUGINS:
                yield pytest.param(*ours(line), id=f"{page.name}: {line}")


@pytest.mark.parametrize(("name", "arguments"), list(documented()))
def test_every_documented_command_can_be_read(name, arguments):
    if {"--help", "--version", "-sc", "key=value"} & set(arguments):
        return
    if name == "train":
        settings = [one for one in arguments if not one.startswith(("-", "hydra.launcher.")) and one != "job"]
        assert all("=" in setting for setting in settings)
        if "-m" in arguments:
            assert launch.plan(settings).jobs > 1
        else:
            compose(settings)
        return
    if name == "export":
        assert len(arguments) == 2
        return
    if name in ("certify", "dataset"):
        kind = certify if name == "certify" else dataset
        options, overrides = command.split(arguments, kind.Options, others=True)
        options.check()
        assert name == "dataset" or any(override.startswith("task=") for override in overrides)
        return
    module = import_module("softgm_bench.render.__main__" if name == "render" else f"softgm_bench.{name}")
    path, options, overrides = command.parse(
        arguments, module.Options, "source", others=name in ("attention", "evaluate", "render")
    )
    assert str(path).startswith(MADE_BEFORE) or str(path) in ("outputs", "unpacked") or (ROOT / path).exists()
    if hasattr(options, "check"):
        options.check()
    assert all("=" in override for override in overrides)


def test_every_documented_make_target_exists():
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for page in PAGES:
        for line in lines(page):
            if line.startswith("make "):
                assert line.split()[1] in targets, line


SMALL = {
    "train": ["experiment=smoke", "experiment.total_frames=64", "experiment.num_envs=2", "threads=1"],
    "evaluate": ["episodes=2", "horizon=3", "threads=1"],
    "attention": ["horizon=3", "threads=1"],
    "render": ["horizon=40", "threads=1", "width=64", "height=48"],
    "report": ["resamples=100"],
    "certify": ["episodes=4", "minutes=0.1"],
    "dataset": ["transitions=20", "horizon=4", "batch=2"],
}


def small(name, arguments):
    """The same command with little to do; of a sweep one seed, of a named grid one cell."""
    if {"--help", "--version", "-sc", "--cfg"} & set(arguments):
        return [name, *arguments] if name != "train" or "--cfg" in arguments else arguments
    if any(argument.endswith(".npz") and "=" not in argument for argument in arguments):
        return [name, *arguments]
    kept = [argument for argument in arguments if not (name == "train" and argument.startswith("experiment="))]
    fewer = ["seed=0"] if "-m" in kept else []
    fewer += ["algo=ippo", "task=basic"] if any(argument.startswith("+grids=") for argument in kept) else []
    return [name, *kept, *SMALL.get(name, []), *fewer]


@pytest.mark.slow
@pytest.mark.parametrize("page", ["README.md", "docs/index.md", "docs/commands.md", "docs/rendering.md"])
def test_the_commands_of_a_page_run_one_after_another(page, tmp_path):
    (tmp_path / "experiments").symlink_to(ROOT / "experiments")
    code = "import sys; from softgm_bench.__main__ import console; sys.argv[0] = 'softgm-bench'; sys.exit(console())"
    environment = os.environ | {"PYTHONPATH": str(ROOT / "src"), "WANDB_MODE": "offline"}
    ran = 0
    for line in lines(ROOT / page):
        if not line.startswith((".venv/bin/", "softgm-bench ", "python -m softgm_bench")):
            continue
        if ours(line)[0] == "watch":  # which does not end; tests/test_watch.py
            continue
        done = subprocess.run(
            [sys.executable, "-c", code, *small(*ours(line))],
            cwd=tmp_path,
            env=environment,
            capture_output=True,
            text=True,
            timeout=600,
            check=False,
        )
        assert done.returncode == 0, f"{line}\n{done.stdout}\n{done.stderr}"
        assert "Warning" not in done.stderr, f"{line}\n{done.stderr}"
        ran += 1
    assert ran >= 2
