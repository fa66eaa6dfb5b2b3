"""The parity table: both CPU backends against PyElastica over every case of ``tests/rod/parity_cases.py``, float64.

``python benchmarks/parity.py`` takes about half a minute once the kernels are compiled. Differences are the largest
over all control steps, nodes and components. The last two columns concern PyElastica's bounding-box pruning, which is
switched off for the comparison: in how many substeps it would have skipped a cylinder that touches (counted for each
cylinder), and how far the trajectory with the pruning as shipped is from ours.
"""

import argparse
import sys
from pathlib import Path
from typing import Any

import numpy as np
import torch

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "rod"))
import record
import validation_figures
from parity_cases import (
    CASES,
    CPU_BACKENDS,
    QUANTITIES,
    Case,
    largest_difference,
    our_trajectories,
    pyelastica_trajectory,
    together,
)

from softgm_bench.rod.pyelastica_oracle import Array

HEADER = (
    f"{'case':<28}{'s':>5}{'elements':>9}{'cylinders':>10}{'tip, m':>8}{'force, N':>9}"
    f"{'torch, m':>10}{'numba, m':>10}{'missed':>8}{'pruned, m':>11}"
)


def measure(name: str, case: Case, ours: dict[str, dict[str, Array]]) -> dict[str, Any]:
    """One row; ``ours`` holds the trajectory of each backend."""
    theirs = pyelastica_trajectory(case)
    row = {
        "case": name,
        "seconds": case.seconds,
        "elements": case.parameters.n_elements,
        "cylinders": len(case.posts),
        "tip_range_m": float(np.ptp(theirs.position[:, :, -1], axis=0).max()),
        "largest_contact_force_N": float(theirs.contact_force.max()),
        "difference": {
            backend: {quantity: largest_difference(ours[backend], theirs, quantity) for quantity in QUANTITIES}
            for backend in CPU_BACKENDS
        },
    }
    if case.posts:
        as_shipped = pyelastica_trajectory(case, pruning=True)
        row["contacts_missed_by_pruning"] = theirs.missed
        row["difference_to_pruned"] = {
            backend: {quantity: largest_difference(ours[backend], as_shipped, quantity) for quantity in QUANTITIES}
            for backend in CPU_BACKENDS
        }
    return row


def line(row: dict[str, Any]) -> str:
    text = (
        f"{row['case']:<28}{row['seconds']:>5.2f}{row['elements']:>9}{row['cylinders']:>10}"
        f"{row['tip_range_m']:>8.2f}{row['largest_contact_force_N']:>9.1f}"
    )
    text += "".join(f"{row['difference'][backend]['position']:>10.1e}" for backend in CPU_BACKENDS)
    if "difference_to_pruned" in row:
        pruned = max(row["difference_to_pruned"][backend]["position"] for backend in CPU_BACKENDS)
        text += f"{row['contacts_missed_by_pruning']:>8}{pruned:>11.1e}"
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/parity.json"))
    parser.add_argument("--figure", type=Path, default=Path("docs/parity.png"))
    options = parser.parse_args()
    torch.set_num_threads(1)

    rows = []
    print(HEADER)
    for cases in together(CASES):
        ours = {backend: our_trajectories(backend, cases) for backend in CPU_BACKENDS}
        for name, case in cases.items():
            rows.append(measure(name, case, {backend: ours[backend][name] for backend in CPU_BACKENDS}))
            print(line(rows[-1]), flush=True)
    worst = {backend: max(row["difference"][backend]["position"] for row in rows) for backend in CPU_BACKENDS}
    print("largest difference of a position, m: " + ", ".join(f"{name} {value:.1e}" for name, value in worst.items()))
    result = {"largest_position_difference_m": worst, "rows": rows}
    record.write(options.output, result)
    validation_figures.draw("parity", result, options.figure)


if __name__ == "__main__":
    main()
