"""Cost of a substep against the number of elements, environments and cylinders, as a table and a figure.

``python benchmarks/bench_scaling.py`` runs the fused kernel on one thread. Cylinders stand in a row behind the arm: it
is in free space, or it leans on them. ``--plot-only`` draws the figure from the committed figures.
"""

import argparse
import json
import math
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numba
import record
import torch
from timing import kernel_rate, sideways

from softgm_bench.envs.tasks.base import upright_cylinders
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders

ELEMENTS = (15, 30, 60, 120, 240)
ENVIRONMENTS = (1, 4, 16, 64, 256, 1024)
CYLINDERS = (2, 4, 8, 16, 32, 64)
PRECISIONS = (torch.float64, torch.float32)
LEAN = 16.0  # N m per m towards the cylinders


def row_of_posts(count: int, num_envs: int, dtype: torch.dtype) -> Cylinders:
    """Touching columns in the plane x = 0.3, the middle ones first; the arm reaches those beside y = 0."""
    order = torch.arange(count)
    y = 0.08 * ((order + 1) // 2) * (1 - 2 * (order % 2))
    xy = torch.stack([torch.full_like(y, 0.3), y], dim=-1).to(torch.float64).expand(num_envs, count, 2)
    bottom = torch.full((num_envs, count), -0.2, dtype=torch.float64)
    mask = torch.ones(num_envs, count, dtype=torch.bool)
    cylinders = upright_cylinders(xy, bottom, bottom + 1.4, 0.04, mask)
    return cylinders.apply(lambda value: value.to(dtype) if value.is_floating_point() else value)


def measure() -> list[dict[str, Any]]:
    rows = []

    def add(what: str, x: int, dtype: torch.dtype, parameters: RodParameters, num_envs: int, **options: Any) -> None:
        rate = kernel_rate(parameters, dtype, num_envs, **options)
        precision = str(dtype).removeprefix("torch.")
        rows.append({"what": what, "x": x, "dtype": precision, "us_per_substep": 1e6 / rate})
        print(f"{what:<28}{x:>6}  {precision:<8}{1e6 / rate:>9.4f} us", flush=True)

    arm = RodParameters()
    for dtype in PRECISIONS:
        for n in ELEMENTS:
            # a shorter element needs a shorter step: both in proportion, as the speed of sound demands
            dt = min(arm.dt, arm.dt * 60 / n)
            add("elements", n, dtype, RodParameters(n_elements=n, dt=dt), 16)
        for num_envs in ENVIRONMENTS:
            add("environments", num_envs, dtype, arm, num_envs)
        for count in CYLINDERS:
            cylinders = row_of_posts(count, 16, dtype)
            add("cylinders, free space", count, dtype, arm, 16, cylinders=cylinders)
            lean = torch.zeros_like(sideways(arm, 16, dtype))
            lean[:, 0] = LEAN / arm.n_elements
            add("cylinders, leaning", count, dtype, arm, 16, cylinders=cylinders, couple=lean, warm_up=25)
    return rows


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.4), constrained_layout=True)
    panels = (
        ("elements", ("elements",)),
        ("environments in the batch", ("environments",)),
        ("cylinders", ("cylinders, free space", "cylinders, leaning")),
    )
    for axis, (label, series) in zip(axes, panels, strict=True):
        for style, what in zip(("-", "--"), series, strict=False):
            for colour, precision in (("#1b6ca8", "float64"), ("#d1495b", "float32")):
                points = [
                    (row["x"], row["us_per_substep"])
                    for row in rows
                    if row["what"] == what and row["dtype"] == precision
                ]
                suffix = what.partition(",")[2]
                axis.plot(*zip(*points, strict=True), style, color=colour, marker="o", ms=3.5, label=precision + suffix)
        axis.set_xlabel(label)
        axis.set_ylim(bottom=0.0)
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    axes[1].set_xscale("log", base=2)
    axes[0].set_ylabel("µs per substep and rod, one core")
    axes[0].legend(frameon=False)
    axes[2].legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=150)
    print(f"written to {path}")


def slope(rows: list[dict[str, Any]], what: str, precision: str) -> float:
    """Exponent of the cost against x between the two largest sizes: 1 is linear."""
    points = [(row["x"], row["us_per_substep"]) for row in rows if row["what"] == what and row["dtype"] == precision]
    (x0, y0), (x1, y1) = points[-2:]
    return math.log(y1 / y0) / math.log(x1 / x0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/scaling.json"))
    parser.add_argument("--figure", type=Path, default=Path("docs/scaling.png"))
    parser.add_argument("--plot-only", action="store_true")
    options = parser.parse_args()
    if options.plot_only:
        rows = json.loads(options.output.read_text())["rows"]
    else:
        numba.set_num_threads(1)
        torch.set_num_threads(1)
        rows = measure()
        record.write(options.output, {"threads": 1, "rows": rows})
    for precision in ("float64", "float32"):
        print(f"cost against elements, 120 to 240, {precision}: exponent {slope(rows, 'elements', precision):.2f}")
    plot(rows, options.figure)


if __name__ == "__main__":
    main()
