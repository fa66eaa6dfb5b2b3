"""Benchmarks run: they reach into the program's parts by name, and nothing else would notice when a name changes."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "smallest"),
    [
        ("env", ["--sizes", "2", "--repetitions", "1"]),
        ("models", ["--batch", "8", "--threads", "1"]),
        ("rivals", ["--frames", "8", "--tasks", "basic"]),
        ("training", ["--algorithms", "mappo", "--tasks", "basic", "--repetitions", "1", "--threads", "1"]),
    ],
)
def test_a_benchmark_at_its_smallest_writes_its_figures(name, smallest, tmp_path):
    output = tmp_path / "figures.json"
    command = [sys.executable, BENCHMARKS / f"bench_{name}.py", *smallest, "--output", output]

    done = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False)

    assert done.returncode == 0, done.stderr
    assert json.loads(output.read_text())["rows"]
