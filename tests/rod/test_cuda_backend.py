"""The CUDA kernel: its physics under Numba's simulator, its machine code without a GPU, and all of it on one."""

import ast
import os
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest
import torch

from softgm_bench.rod.cuda_backend import CudaBackend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import straight_rods

SIMULATED = Path(__file__).with_name("cuda_simulated.py")
NAMES = [node.name for node in ast.parse(SIMULATED.read_text()).body if isinstance(node, ast.FunctionDef)]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> dict[str, list[str | None]]:
    """Each simulated test's results, one for each of its cases: None where it passed."""
    report = tmp_path_factory.mktemp("cuda") / "report.xml"
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", str(SIMULATED), f"--junitxml={report}"]
    environment = os.environ | {"NUMBA_ENABLE_CUDASIM": "1", "OMP_NUM_THREADS": "1"}
    run = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=900, check=False)
    assert report.exists(), run.stdout + run.stderr
    results: dict[str, list[str | None]] = {}
    for case in ElementTree.parse(report).iter("testcase"):
        trouble = [f"{case.get('name')}: {child.get('message')}\n{child.text}" for child in case]
        results.setdefault(str(case.get("name")).split("[")[0], []).append("\n".join(trouble) or None)
    return results


@pytest.mark.slow
@pytest.mark.parametrize("name", [name for name in NAMES if name.startswith("test_")])
def test_simulated(simulated: dict[str, list[str | None]], name: str):
    results = simulated[name]
    failures = [trouble for trouble in results if trouble is not None]
    assert not failures, "\n\n".join(failures)


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
