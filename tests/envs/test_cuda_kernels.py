"""The environment's CUDA kernels: their results under Numba's simulator, their machine code without a GPU."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch

import cuda_code
import cuda_simulator
from softgm_bench.envs import cuda_sensing, cuda_verdict

HERE = Path(__file__).parent
DTYPES = [torch.float64, torch.float32]
SCRIPTS = [HERE / f"cuda_simulated_{name}.py" for name in ("sensing", "verdict")]
simulated, test_simulated = cuda_simulator.suite(*SCRIPTS)
compiles = pytest.mark.skipif(bool(cuda_code.why_not()), reason=str(cuda_code.why_not()))


@pytest.mark.slow
def test_a_step_launches_what_the_committed_count_says(tmp_path: Path):
    root = HERE.parents[1]
    command = [sys.executable, str(root / "benchmarks/count_operations.py"), f"--output={tmp_path / 'counted.json'}"]
    subprocess.run(command, env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"}, cwd=root, check=True, timeout=600)

    def steps(path: Path) -> list[dict]:
        return [row for row in json.loads(path.read_text())["rows"] if row["what"] == "environment step"]

    counted = steps(tmp_path / "counted.json")
    assert counted == steps(root / "benchmarks/results/operations.json")
    assert all(row["operations"] <= 155 for row in counted)  # 152 before arms had bodies and obstacles could move


def no_larger_than_needed(code: str, folder: Path) -> None:
    used = cuda_code.assembled(code, folder)
    assert used["registers"] <= 64
    assert used["spills"] == used["stack"] == 0


@compiles
@pytest.mark.parametrize("dtype", DTYPES)
def test_sensing_rounds_every_product_and_stays_in_its_precision(dtype: torch.dtype, tmp_path: Path):
    table = (torch.zeros(2, 128, dtype=torch.int64), torch.zeros(2, 560, dtype=torch.bool))
    counts = (torch.zeros(2, dtype=torch.int64),) * 2
    agents, descriptor = torch.zeros(2, 6, 3, dtype=dtype), torch.zeros(2, 560, 9, dtype=dtype)
    launched = cuda_code.launched(
        cuda_sensing, lambda: cuda_sensing.look(agents, descriptor, table[1], (*table, *counts), 0.15)
    )
    code = cuda_code.ptx(*launched)
    assert (".f64" in code) == (dtype == torch.float64)
    assert not cuda_code.fuses(code)
    no_larger_than_needed(code, tmp_path)


@compiles
@pytest.mark.parametrize("dtype", DTYPES)
def test_the_verdict_stays_in_its_precision(settings, dtype: torch.dtype, tmp_path: Path):
    nodes, truths, whole = torch.zeros(2, 3, 61, dtype=dtype), torch.zeros(2, 61, dtype=torch.bool), torch.zeros(2)
    action, flag, count = torch.zeros(2, 6, 2), truths[:, 0].clone(), whole.long()
    step = (nodes, nodes, nodes[..., 0].clone(), action, action, truths, flag, count, flag, flag, flag, count, count)
    config = settings("task=wall").task
    code = cuda_code.ptx(*cuda_code.launched(cuda_verdict, lambda: cuda_verdict.judge(step, config, 200)))
    assert (".f64" in code) == (dtype == torch.float64)
    no_larger_than_needed(code, tmp_path)
