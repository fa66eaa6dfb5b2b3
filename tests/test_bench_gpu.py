"""The GPU's benchmark, rehearsed on the CPU: its tables are whole, and without a GPU it says so."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "bench_gpu.py"


def run(*arguments):
    return subprocess.run(
        [sys.executable, str(SCRIPT), *map(str, arguments)], capture_output=True, text=True, check=False
    )


@pytest.mark.slow
def test_a_rehearsal_on_the_cpu_fills_every_row(tmp_path):
    output = tmp_path / "gpu.json"
    result = run("--short", "--device", "cpu", "--batches", 2, 3, "--repetitions", 1, "--output", output)
    assert result.returncode == 0, result.stderr
    written = json.loads(output.read_text())
    assert [(row["task"], row["environments"]) for row in written["training"]] == [
        (task, count) for task in ("basic", "structured", "wall") for count in (2, 3)
    ]
    assert {
        (row["elements"], row["dtype"], row["rods"]) for row in written["rods"] if row["scene"] == "no obstacle"
    } == {(elements, dtype, count) for elements in (20, 60) for dtype in ("float32", "float64") for count in (2, 3)}
    for row in written["rods"]:
        assert row["rod_steps_per_s"] > 0
        if row["elements"] == 60:
            assert row["arm_seconds_per_s"] == pytest.approx(4e-4 * row["rod_steps_per_s"])
    for row in written["training"]:
        assert min(value for name, value in row.items() if name.endswith(("per_s", "gb"))) > 0
    assert written["versions"]["torch"] == torch.__version__


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_is_one_line(tmp_path):
    result = run("--output", tmp_path / "gpu.json")
    assert (result.returncode, result.stderr) == (2, "bench_gpu: no CUDA GPU here, nothing to measure\n")
    assert not (tmp_path / "gpu.json").exists()
