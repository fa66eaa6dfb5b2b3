"""The figure and the table of ``docs/peers.md``, from ``results/*.csv``; nothing is trained here."""

import argparse
import csv
import re
from collections import defaultdict
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from cells import ALGORITHMS, FRAMEWORKS, HERE, RESULTS, TASKS

PAGE = HERE.parents[1] / "docs" / "peers.md"
PICTURE = PAGE.with_suffix(".png")
LABELS = {"benchmarl": "BenchMARL 1.5.2", "softgm_bench": "softgm_bench"}
COLOURS = {"benchmarl": "#b35806", "softgm_bench": "#2166ac"}
Curve = tuple[np.ndarray, np.ndarray]  # frames (points,), returns (seeds, points)


def read() -> tuple[dict[tuple[str, str, str], Curve], dict[tuple[str, str, str], np.ndarray]]:
    """Curves, and frames/s of every seed, by framework, task and algorithm."""
    runs = defaultdict(list)
    for path in sorted(RESULTS.glob("*.csv")):
        with path.open() as file:
            rows = list(csv.DictReader(file))
        runs[rows[0]["framework"], rows[0]["task"], rows[0]["algo"]].append(rows)
    curves, rates = {}, {}
    for key, of_seeds in runs.items():
        frames = np.array([int(row["frames"]) for row in of_seeds[0]])
        curves[key] = frames, np.array([[float(row["return_mean"]) for row in rows] for rows in of_seeds])
        rates[key] = np.array([float(rows[-1]["frames_per_second"]) for rows in of_seeds])
    return curves, rates


def figure(curves: dict[tuple[str, str, str], Curve], path: Path) -> None:
    """Return against frames: the mean over the seeds, and their range shaded."""
    columns = len(ALGORITHMS)
    fig, axes = plt.subplots(len(TASKS), columns, figsize=(2.3 * columns, 2.2 * len(TASKS)), squeeze=False)
    for of_task, task in zip(axes, TASKS, strict=True):
        for axis, algo in zip(of_task, ALGORITHMS, strict=True):
            for framework in FRAMEWORKS:
                if (framework, task, algo) not in curves:
                    continue
                frames, returns = curves[framework, task, algo]
                colour = COLOURS[framework]
                axis.plot(frames / 1000, returns.mean(0), color=colour, label=LABELS[framework])
                axis.fill_between(frames / 1000, returns.min(0), returns.max(0), color=colour, alpha=0.2, lw=0)
            axis.set_title(f"{algo.upper()}, {task}", fontsize=9)
            axis.tick_params(labelsize=7)
        of_task[0].set_ylabel("return", fontsize=8)
    for axis in axes[-1]:
        axis.set_xlabel("thousand frames", fontsize=8)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    fig.legend(handles, labels, loc="lower center", ncol=2, frameon=False, fontsize=8)
    fig.tight_layout(rect=(0, 0.05, 1, 1))
    fig.savefig(path, dpi=130)


def table(curves: dict[tuple[str, str, str], Curve], rates: dict[tuple[str, str, str], np.ndarray]) -> str:
    """Markdown: mean return over the second half of training, mean [range] over seeds, and frames/s."""
    lines = [
        "| task | algorithm | seeds | BenchMARL's return | ours | ranges meet | BenchMARL's frames/s | ours | ratio |",
        "|---|---|---|---|---|---|---|---|---|",
    ]
    for task in TASKS:
        for algo in ALGORITHMS:
            theirs, ours = ((framework, task, algo) for framework in FRAMEWORKS)
            if theirs not in curves or ours not in curves:
                continue
            late = [curves[key][1][:, curves[key][1].shape[1] // 2 :].mean(1) for key in (theirs, ours)]
            said = [f"{one.mean():.1f} [{one.min():.1f}, {one.max():.1f}]" for one in late]
            meet = late[0].max() >= late[1].min() and late[1].max() >= late[0].min()
            speed = [rates[key].mean() for key in (theirs, ours)]
            seeds = min(len(one) for one in late)
            lines.append(
                f"| {task} | {algo.upper()} | {seeds} | {said[0]} | {said[1]} | {'yes' if meet else 'no'} | "
                f"{speed[0]:.0f} | {speed[1]:.0f} | {speed[1] / speed[0]:.2f} |"
            )
    return "\n".join(lines)


def page(text: str, made: str) -> str:
    """``docs/peers.md`` with another table between its two marks."""
    text, count = re.subn(
        r"<!-- table -->.*?<!-- end -->", lambda _: f"<!-- table -->\n\n{made}\n\n<!-- end -->", text, flags=re.DOTALL
    )
    if count != 1:
        raise SystemExit(f"{PAGE}: one place for the table expected, found {count}")
    return text


def main() -> None:
    argparse.ArgumentParser(description=__doc__).parse_args()
    curves, rates = read()
    figure(curves, PICTURE)
    made = table(curves, rates)
    PAGE.write_text(page(PAGE.read_text(), made))
    print(made)


if __name__ == "__main__":
    main()
