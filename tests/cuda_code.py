"""Machine code of CUDA kernels for an H200 (sm_90), compiled without a GPU."""

import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numba.cuda.dispatcher
import pytest
from numba import cuda, int64, typeof, types
from torch import Tensor

ARCHITECTURE = (9, 0)
_FUSED = re.compile(r"\bfma\.rn\.f(32|64)")


@cache
def why_not() -> str | None:
    """Numba needs NVVM from a CUDA toolkit."""
    try:
        cuda.compile_ptx(lambda array: None, (types.Array(int64, 1, "C"),), cc=ARCHITECTURE)
    except Exception as error:  # differs between Numba's own CUDA target and the numba-cuda package
        return f"Numba compiles no CUDA code here: {type(error).__name__}"
    return None


def launched(owner: Any, work: Callable[[], Any]) -> tuple[Any, tuple]:
    """The one kernel that ``work`` launches through the module ``owner``, and its arguments."""
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(owner, "launch", lambda *arguments: calls.append(arguments))
        work()
    ((kernel, _, _, tensors, *scalars),) = calls
    return kernel, (*tensors, *scalars)


def ptx(kernel: Any, arguments: Sequence[Any]) -> str:
    """The kernel's PTX for arguments of these types."""
    signature = tuple(typeof(value.numpy() if isinstance(value, Tensor) else value) for value in arguments)
    here = SimpleNamespace(compute_capability=ARCHITECTURE)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(numba.cuda.dispatcher, "get_current_device", lambda: here)
        return cuda.compile_ptx(kernel.py_func, signature, cc=ARCHITECTURE)[0]


def fuses(code: str) -> bool:
    """Tell whether a product and a sum are rounded once, or may be by the assembler."""
    return bool(_FUSED.search(code) or re.search(r"\bmul\.f(32|64)", code))


def assembled(code: str, folder: Path, most_registers: int | None = None) -> dict[str, int]:
    """What ``ptxas`` says of PTX."""
    if shutil.which("ptxas") is None:
        pytest.skip("no ptxas of a CUDA toolkit in PATH")
    source = folder / "kernel.ptx"
    source.write_text(code)
    limit = [f"-maxrregcount={most_registers}"] if most_registers else []
    command = ["ptxas", "-v", "-arch=sm_90", *limit, "-o", str(folder / "kernel.cubin"), str(source)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stderr
    found = {
        "registers": re.search(r"Used (\d+) registers", said),
        "shared": re.search(r"(\d+) bytes smem", said),
        "stack": re.search(r"(\d+) bytes stack frame", said),
        "spills": re.search(r"(\d+) bytes spill stores", said),
    }
    return {name: int(match[1]) if match else 0 for name, match in found.items()}
