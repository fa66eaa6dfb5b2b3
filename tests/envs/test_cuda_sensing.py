"""The CUDA kernel of sensing: its results under Numba's simulator, its machine code without a GPU."""

from pathlib import Path

import pytest
import torch

import cuda_code
import cuda_simulator
from softgm_bench.envs import cuda_sensing

SIMULATED = Path(__file__).with_name("cuda_simulated_sensing.py")


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> cuda_simulator.Results:
    return cuda_simulator.run(SIMULATED, tmp_path_factory.mktemp("cuda"))


@pytest.mark.slow
@pytest.mark.parametrize("name", cuda_simulator.names(SIMULATED))
def test_simulated(simulated: cuda_simulator.Results, name: str):
    assert not cuda_simulator.failures(simulated, name)


@pytest.mark.skipif(bool(cuda_code.why_not()), reason=str(cuda_code.why_not()))
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_code_rounds_every_product_and_stays_in_its_precision(dtype: torch.dtype, tmp_path: Path):
    table = (torch.zeros(2, 128, dtype=torch.int64), torch.zeros(2, 560, dtype=torch.bool))
    counts = (torch.zeros(2, dtype=torch.int64),) * 2
    agents, descriptor = torch.zeros(2, 6, 3, dtype=dtype), torch.zeros(2, 560, 9, dtype=dtype)
    launched = cuda_code.launched(
        cuda_sensing, lambda: cuda_sensing.look(agents, descriptor, table[1], (*table, *counts), 0.15)
    )
    code = cuda_code.ptx(*launched)
    assert ".f32" in code or dtype == torch.float64
    assert (".f64" in code) == (dtype == torch.float64)
    assert not cuda_code.fuses(code)
    used = cuda_code.assembled(code, tmp_path)
    assert used["registers"] <= 64
    assert used["spills"] == used["stack"] == 0
