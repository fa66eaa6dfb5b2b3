"""The CUDA kernel's machine code for an H200 (sm_90), compiled without a GPU."""

import re
import shutil
import subprocess
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba.cuda.dispatcher
import numpy as np
import pytest
import torch
from numba import cuda, int64, typeof, types

from softgm_bench.rod import cuda_backend
from softgm_bench.rod.cuda_step import most_registers
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, straight_rods

ARCHITECTURE = (9, 0)
DTYPES = {np.float64: torch.float64, np.float32: torch.float32}
PRECISIONS = list(DTYPES)


@cache
def why_not() -> str | None:
    """Numba needs NVVM from a CUDA toolkit."""
    try:
        cuda.compile_ptx(lambda array: None, (types.Array(int64, 1, "C"),), cc=ARCHITECTURE)
    except Exception as error:  # differs between Numba's own CUDA target and the numba-cuda package
        return f"Numba compiles no CUDA code here: {type(error).__name__}"
    return None


def launch(n_elements: int, real: type, contact: str | None) -> tuple[Any, tuple]:
    """The kernel that a control step launches, and the types of its arguments."""
    parameters = RodParameters(n_elements=n_elements, contact_model=contact or "pyelastica")
    state = straight_rods(parameters, 2, DTYPES[real])
    cylinders = Cylinders(
        start=torch.zeros(2, 3, 3),
        axis=torch.ones(2, 3, 3),
        length=torch.ones(2, 3),
        radius=torch.ones(2, 3),
        mask=torch.ones(2, 3, dtype=torch.bool),
        batch_size=[2],
    )
    launched = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda_backend, "_check_device", lambda *arguments, **named: None)
        patch.setattr(cuda_backend, "_launch", lambda *arguments: launched.append(arguments))
        backend = cuda_backend.CudaBackend(parameters)
        backend.control_step(state, torch.zeros(2, 3, n_elements), cylinders=cylinders if contact else None)
    ((kernel, tensors, given, constants, substeps),) = launched
    arguments = (*(tensor.numpy() for tensor in tensors), *given, constants, substeps)
    return kernel, tuple(typeof(argument) for argument in arguments)


@cache
def ptx(n_elements: int, real: type, contact: str | None) -> str:
    kernel, signature = launch(n_elements, real, contact)
    here = SimpleNamespace(compute_capability=ARCHITECTURE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba.cuda.dispatcher, "get_current_device", lambda: here)
        return cuda.compile_ptx(kernel.py_func, signature, cc=ARCHITECTURE)[0]


@pytest.fixture(autouse=True)
def _compiler() -> None:
    if why_not():
        pytest.skip(why_not())


def assembled(n_elements: int, real: type, contact: str | None, folder: Path) -> dict[str, int]:
    """What ``ptxas`` says of the kernel."""
    if shutil.which("ptxas") is None:
        pytest.skip("no ptxas of a CUDA toolkit in PATH")
    source = folder / "kernel.ptx"
    source.write_text(ptx(n_elements, real, contact))
    limit = f"-maxrregcount={most_registers(n_elements, real)}"
    command = ["ptxas", "-v", "-arch=sm_90", limit, "-o", str(folder / "kernel.cubin"), str(source)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    found = {
        "registers": re.search(r"Used (\d+) registers", said),
        "shared": re.search(r"(\d+) bytes smem", said),
        "stack": re.search(r"(\d+) bytes stack frame", said),
        "spills": re.search(r"(\d+) bytes spill stores", said),
    }
    return {name: int(match[1]) if match else 0 for name, match in found.items()}


@pytest.mark.parametrize("contact", [None, "pyelastica", "exact"])
def test_float32_code_holds_no_float64_instruction(contact: str | None):
    assert ".f64" not in ptx(60, np.float32, contact)


def test_float64_code_holds_float64_instructions():
    assert ".f64" in ptx(60, np.float64, None)


def test_a_substep_has_two_barriers():
    assert len(re.findall(r"bar\.sync|barrier\.sync", ptx(60, np.float32, "exact"))) == 2


@pytest.mark.parametrize("contact", [None, "pyelastica", "exact"])
@pytest.mark.parametrize("real", PRECISIONS)
def test_the_arm_stays_in_registers(real: type, contact: str | None, tmp_path: Path):
    used = assembled(60, real, contact, tmp_path)
    print(used)
    assert used["registers"] <= {np.float32: 96, np.float64: 168}[real]
    assert used["spills"] <= {np.float32: 0, np.float64: 100}[real]  # contact in float64 is a little too long


@pytest.mark.parametrize(("n_elements", "real"), [(500, np.float64), (1023, np.float32)])
def test_long_rods_fit_into_a_block(n_elements: int, real: type, tmp_path: Path):
    used = assembled(n_elements, real, "exact", tmp_path)
    warps = -(-(n_elements + 1) // 32)
    assert used["registers"] * warps * 32 <= 65536
    assert used["shared"] <= 49152
