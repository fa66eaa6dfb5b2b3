"""Running tests under Numba's CUDA simulator, which has to be chosen before Numba is imported: a process of its own."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

Results = dict[str, list[str | None]]  # of each test, one for each of its cases: None where it passed


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
