"""How far the fused kernel is from what a core can do.

``python benchmarks/roofline.py`` counts the floating-point operations of one substep by running the kernel's own
functions on numbers that count, measures the rate of the kernel and the largest rate of fused multiply-adds that one
core reaches with the same compiler, and compares. Operations are counted as written: an addition, multiplication,
division, square root or comparison is one each.
"""

import argparse
import math
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
import numpy as np
import record
import torch
from timing import best_rate, kernel_rate

from softgm_bench.rod.numba_kernel import make_kernel
from softgm_bench.rod.numba_layout import constant_rows, make_layout
from softgm_bench.rod.parameters import RodParameters, rod_constants

ARM = RodParameters()
COUNTS: Counter[str] = Counter()  # operations since the last clear
FMA_CHAINS = 12  # independent accumulators that hide the latency of a multiply-add


class Counted:
    """A number that counts what is done with it."""

    __array_ufunc__ = None  # numpy's scalars leave the operation to this class

    def __init__(self, value: float) -> None:
        self.value = float(value)

    def __float__(self) -> float:
        return self.value

    def __neg__(self) -> "Counted":
        return Counted(-self.value)

    def __abs__(self) -> "Counted":
        return Counted(abs(self.value))


def _operation(name: str, kind: str) -> Callable[..., Any]:
    plain = getattr(float, name)

    def counted(self: Counted, other: Any) -> Any:
        COUNTS[kind] += 1
        result = plain(self.value, float(other))
        return result if isinstance(result, bool) else Counted(result)

    return counted


KINDS = {"add": "add", "radd": "add", "sub": "add", "rsub": "add", "mul": "mul", "rmul": "mul", "truediv": "div"}
KINDS |= {"rtruediv": "div", "gt": "compare", "lt": "compare"}
for short, kind_of in KINDS.items():
    setattr(Counted, f"__{short}__", _operation(f"__{short}__", kind_of))


class _CountingMath:
    @staticmethod
    def sqrt(x: Counted) -> Counted:
        COUNTS["sqrt"] += 1
        return Counted(math.sqrt(x.value))


def _larger(a: Any, b: Any) -> Any:
    COUNTS["compare"] += 1
    return a if float(a) > float(b) else b


def operations() -> dict[str, dict[str, int]]:
    """Operations of each function of one substep in float64, without the padding's."""
    real = np.float64
    layout, kernel, constants = make_layout(ARM.n_elements, real), make_kernel(ARM.n_elements, real), rod_constants(ARM)
    row = constant_rows(ARM, layout, np.dtype(real))
    n = ARM.n_elements
    row[layout.pz : layout.pz + n + 1] = constants.position[2]
    for name in ("q00", "q01", "q02", "q10", "q11", "q12", "q20", "q21", "q22"):
        start = getattr(layout, name)
        row[start : start + n] = constants.director[int(name[1]), int(name[2])]
    numbers = [Counted(value) for value in row]
    arguments = {
        "stresses": (),
        "couples": (),
        "spin": (),
        "push": (0.9999,),
        "rotate": (ARM.dt,),
        "move": (ARM.dt,),
    }
    # Loops run over whole vectors; what the padding computes is no work that anyone asked for.
    useful = {"stresses": n, "couples": n - 1, "spin": n, "push": n + 1, "rotate": n, "move": n + 1}
    padded = dict.fromkeys(useful, layout.elements) | {"push": layout.nodes, "move": layout.nodes}
    counts = {}
    for name, extra in arguments.items():
        COUNTS.clear()
        code = getattr(kernel, name).py_func
        names = code.__globals__ | {"np": _CountingMath, "larger": _larger, "abs": abs}
        plain = FunctionType(code.__code__, names, code.__name__, None, code.__closure__)
        plain(numbers, *(Counted(value) for value in extra))
        share = useful[name] / padded[name]
        counts[name] = {kind: round(count * share) for kind, count in COUNTS.items()}
    return counts


def peak(dtype: type) -> float:
    """Fused multiply-adds that one core reaches, in operations per second (two each), best of several runs."""
    width = 64 // np.dtype(dtype).itemsize
    size, count = FMA_CHAINS * width, 1_000_000
    half, small = dtype(0.5), dtype(1e-3)

    @numba.njit(fastmath={"contract"})
    def chains(x):
        for _ in range(count):
            for i in range(size):
                x[i] = x[i] * half + small

    x = np.zeros(size, dtype)
    chains(x)
    return best_rate(lambda: chains(x), 2.0 * size * count, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/roofline.json"))
    options = parser.parse_args()
    numba.set_num_threads(1)
    torch.set_num_threads(1)

    counts = operations()
    total = sum(sum(kinds.values()) for kinds in counts.values())
    print(f"operations of one substep, {ARM.n_elements} elements: {total}")
    for name, kinds in counts.items():
        print(f"  {name:<10}{sum(kinds.values()):>7}  " + ", ".join(f"{kind} {n}" for kind, n in kinds.items()))
    rows = []
    for dtype in (torch.float64, torch.float32):
        real = torch.empty(0, dtype=dtype).numpy().dtype.type
        rate, most = kernel_rate(ARM, dtype, num_envs=16), peak(real)
        rows.append(
            {
                "dtype": real.__name__,
                "substeps_per_s": rate,
                "flops": rate * total,
                "peak_flops": most,
                "share": rate * total / most,
            }
        )
        print(
            f"{real.__name__}: {1e6 / rate:.3f} us a substep = {rate * total / 1e9:.1f} Gflop/s, "
            f"{rate * total / most:.0%} of the {most / 1e9:.0f} Gflop/s that one core reaches with multiply-adds"
        )
    record.write(options.output, {"elements": ARM.n_elements, "operations": counts, "total": total, "rows": rows})


if __name__ == "__main__":
    main()
