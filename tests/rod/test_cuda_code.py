"""The CUDA kernel's machine code for an H200 (sm_90), compiled without a GPU."""

import re
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import cuda_code
from pairwise import partly
from softgm_bench.rod import cuda_backend
from softgm_bench.rod.bodies import Bodies
from softgm_bench.rod.cuda_step import most_registers
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, straight_rods

DTYPES = {np.float64: torch.float64, np.float32: torch.float32}
PRECISIONS = list(DTYPES)


def launch(n_elements: int, real: type, contact: str | None, moving: bool, drawn: bool) -> tuple[Any, tuple]:
    """The kernel that a control step launches, and its arguments."""
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
    backend = cuda_backend.CudaBackend(parameters)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cuda_backend, "_check_device", lambda *arguments, **named: None)
        couple = torch.zeros(2, 3, n_elements)
        given = {"cylinders": cylinders if contact else None}
        given |= {"cylinder_velocity": torch.ones(2, 3, 3)} if moving else {}
        given |= {"bodies": Bodies(*[torch.ones(2)] * len(Bodies._fields))} if drawn else {}
        return cuda_code.launched(cuda_backend, lambda: backend.control_step(state, couple, **given))


@cache
def ptx(n_elements: int, real: type, contact: str | None, moving: bool = False, drawn: bool = False) -> str:
    return cuda_code.ptx(*launch(n_elements, real, contact, moving, drawn))


@pytest.fixture(autouse=True)
def _compiler() -> None:
    if cuda_code.why_not():
        pytest.skip(cuda_code.why_not())


def assembled(n_elements: int, real: type, contact: str | None, folder: Path, moving: bool = False) -> dict[str, int]:
    return cuda_code.assembled(ptx(n_elements, real, contact, moving), folder, most_registers(n_elements, real))


@pytest.mark.parametrize("contact", partly([None, "pyelastica", "exact"], ["pyelastica"]))
def test_float32_code_holds_no_float64_instruction(contact: str | None):
    assert ".f64" not in ptx(60, np.float32, contact)


@pytest.mark.parametrize("contact", partly(["pyelastica", "exact"], ["exact"]))
def test_float32_code_with_cylinders_that_move_holds_no_float64_instruction(contact: str):
    assert ".f64" not in ptx(60, np.float32, contact, moving=True)


@pytest.mark.parametrize("contact", partly([None, "pyelastica"], [None]))
def test_float32_code_of_bodies_holds_no_float64_instruction(contact: str | None):
    assert ".f64" not in ptx(60, np.float32, contact, drawn=True)


def test_float64_code_holds_float64_instructions():
    assert ".f64" in ptx(60, np.float64, None)


def test_a_substep_has_two_barriers():
    assert len(re.findall(r"bar\.sync|barrier\.sync", ptx(60, np.float32, "exact"))) == 2


@pytest.mark.parametrize("contact", [None, "pyelastica", "exact"])
@pytest.mark.parametrize("real", partly(PRECISIONS, [np.float32]))
def test_the_arm_stays_in_registers(real: type, contact: str | None, tmp_path: Path):
    used = assembled(60, real, contact, tmp_path)
    print(used)
    assert used["registers"] <= {np.float32: 96, np.float64: 168}[real]
    assert used["spills"] <= {np.float32: 0, np.float64: 100}[real]  # contact in float64 is a little too long


@pytest.mark.slow
@pytest.mark.parametrize(("n_elements", "real"), [(500, np.float64), (1023, np.float32)])
def test_long_rods_fit_into_a_block(n_elements: int, real: type, tmp_path: Path):
    used = assembled(n_elements, real, "exact", tmp_path)
    warps = -(-(n_elements + 1) // 32)
    assert used["registers"] * warps * 32 <= 65536
    assert used["shared"] <= 49152
