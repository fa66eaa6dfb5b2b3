"""The CUDA kernel: its physics under Numba's simulator, its machine code without a GPU, and all of it on one."""

from pathlib import Path

import pytest
import torch

import cuda_simulator
from softgm_bench.rod.cuda_backend import CudaBackend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import straight_rods

simulated, test_simulated = cuda_simulator.suite(Path(__file__).with_name("cuda_simulated.py"))


def test_a_state_that_is_not_on_a_cuda_device_is_refused():
    arm = RodParameters(n_elements=4)
    with pytest.raises(ValueError, match="the state is on cpu: the cuda backend needs it on a CUDA device"):
        CudaBackend(arm).control_step(straight_rods(arm, 1), torch.zeros(1, 3, 4, dtype=torch.float64))


def test_more_elements_than_a_block_has_threads_for_are_refused():
    with pytest.raises(ValueError, match=r"rod.n_elements is 1024: the cuda backend holds at most 1023"):
        CudaBackend(RodParameters(n_elements=1024))


@pytest.mark.parametrize("name", ["couple", "force", "active", "state.position"])
def test_shapes_that_do_not_fit_are_refused_before_the_kernel_reads_them(name: str):
    arm = RodParameters(n_elements=4)
    state = straight_rods(arm, 2)
    arguments = {"couple": torch.zeros(2, 3, 4, dtype=torch.float64), "force": None, "active": None}
    if name == "state.position":
        arm = RodParameters(n_elements=5)
    else:
        arguments[name] = torch.zeros(2, 3, 3, dtype=torch.float64)
    with pytest.raises(ValueError, match=f"{name} has shape"):
        CudaBackend(arm).control_step(state, **arguments)
