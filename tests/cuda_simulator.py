"""Running tests under Numba's CUDA simulator, which has to be chosen before Numba is imported: a process of its own."""

import ast
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest

Results = dict[str, list[str | None]]  # of each test, one for each of its cases: None where it passed


def suite(*scripts: Path) -> tuple[Any, Callable[..., None]]:
    """Make a module's fixture ``simulated``, which runs the scripts, and the slow test that asks for each result.

    A test module assigns them to the names ``simulated`` and ``test_simulated``.
    """

    @pytest.fixture(scope="module", name="simulated")
    def simulated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Results]:
        return {script.stem: run(script, tmp_path_factory.mktemp("cuda")) for script in scripts}

    @pytest.mark.slow
    @pytest.mark.parametrize(("script", "name"), [(script.stem, name) for script in scripts for name in names(script)])
    def test_simulated(simulated: dict[str, Results], script: str, name: str) -> None:
        found = failures(simulated[script], name)
        assert not found, found

    return simulated, test_simulated


def names(script: Path) -> list[str]:
    """The tests in a file."""
    functions = [node.name for node in ast.parse(script.read_text()).body if isinstance(node, ast.FunctionDef)]
    return [name for name in functions if name.startswith("test_")]


def run(script: Path, folder: Path) -> Results:
    """Results of a file's tests, reported in ``folder``."""
    report = folder / "report.xml"
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(script), f"--junitxml={report}"]
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1", "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900, check=False)
    assert report.exists(), done.stdout + done.stderr
    results: Results = {}
    for case in ElementTree.parse(report).iter("testcase"):
        trouble = [f"{case.get('name')}: {child.get('message')}\n{child.text}" for child in case]
        results.setdefault(str(case.get("name")).split("[")[0], []).append("\n".join(trouble) or None)
    return results


def failures(results: Results, name: str) -> str:
    """What went wrong in a test's cases; it must have had some."""
    return "\n\n".join(trouble for trouble in results[name] if trouble is not None)
