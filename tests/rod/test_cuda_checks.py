"""The CUDA kernels of ``cuda_checks``: their results under Numba's simulator, their machine code without a GPU."""

from pathlib import Path

import pytest
import torch

import cuda_code
import cuda_simulator
from softgm_bench.rod import cuda_checks
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.state import Cylinders, straight_rods

simulated, test_simulated = cuda_simulator.suite(Path(__file__).with_name("cuda_simulated_checks.py"))
ARM = RodParameters()


@pytest.mark.skipif(bool(cuda_code.why_not()), reason=str(cuda_code.why_not()))
@pytest.mark.parametrize("check", ["contact_nodes", "diverged"])
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_code_rounds_every_product_and_stays_in_its_precision(check: str, dtype: torch.dtype, tmp_path: Path):
    constants, state = rod_constants(ARM), straight_rods(ARM, 2, dtype)
    vectors, numbers = torch.ones(2, 20, 3, dtype=dtype), torch.ones(2, 20, dtype=dtype)
    geometry = {"start": vectors, "axis": vectors, "length": numbers, "radius": numbers}
    cylinders = Cylinders(**geometry, mask=torch.ones(2, 20, dtype=torch.bool), batch_size=[2])

    def work():
        if check == "contact_nodes":
            return cuda_checks.contact_nodes(state.position, torch.as_tensor(constants.volume, dtype=dtype), cylinders)
        return cuda_checks.diverged(state, torch.as_tensor(constants.rest_length, dtype=dtype), 0.5, 2.0)

    code = cuda_code.ptx(*cuda_code.launched(cuda_checks, work))
    assert (".f64" in code) == (dtype == torch.float64)
    assert not cuda_code.fuses(code)
    used = cuda_code.assembled(code, tmp_path)
    assert used["registers"] <= 64
    assert used["spills"] == used["stack"] == 0
