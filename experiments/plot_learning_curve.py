"""Learning curve of one run folder: ``python experiments/plot_learning_curve.py RUN_FOLDER PICTURE``."""

import csv
import json
import sys
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def main(run: Path, picture: Path) -> None:
    """Success in training (running mean over iterations) and in evaluations, and episodes' lengths, against frames."""
    with (run / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    evaluations = [json.loads(line) for line in (run / "evaluations.jsonl").read_text().splitlines()]
    summary = json.loads((run / "summary.json").read_text())

    frames = [int(row["frames"]) / 1e3 for row in rows]
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.2), layout="constrained")
    left.plot(frames, running([float(row["success_rate"]) for row in rows], 10), color="0.6", label="training, sampled")
    left.plot(
        [entry["frames"] / 1e3 for entry in evaluations],
        [entry["success_rate"]["mean"] for entry in evaluations],
        "o-",
        color="C0",
        label="evaluation, deterministic",
    )
    final = summary["final_evaluation"]["success_rate"]
    left.errorbar(
        [summary["frames"] / 1e3],
        [final["mean"]],
        [[final["mean"] - final["low"]], [final["high"] - final["mean"]]],
        fmt="s",
        color="C1",
        label="final evaluation, 95 % interval",
    )
    left.set(xlabel="frames / 1000", ylabel="success rate", ylim=(-0.02, 1.02))
    left.legend(frameon=False, fontsize=8)
    right.plot(frames, running([float(row["episode_length"]) for row in rows], 10), color="0.6")
    right.set(xlabel="frames / 1000", ylabel="control steps of a training episode", ylim=(0, None))
    for axes in (left, right):
        axes.spines[["top", "right"]].set_visible(False)
    figure.suptitle(f"{summary['algo']} on {summary['task']}, seed {summary['seed']}", fontsize=10)
    picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(picture, dpi=150)


def running(values: list[float], width: int) -> list[float]:
    """Mean of the last ``width`` values that are numbers."""
    means = []
    for end in range(1, len(values) + 1):
        known = [value for value in values[max(0, end - width) : end] if value == value]
        means.append(sum(known) / len(known) if known else float("nan"))
    return means


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
