"""Folders of runs as training writes them, with made-up numbers."""

import csv
import json
from pathlib import Path

import numpy as np

from softgm_bench.episodes.summary import wilson_interval


def episodes(generator: np.random.Generator, count: int, success: float, horizon: int = 2000) -> dict[str, np.ndarray]:
    """Columns of ``episodes.csv``: about ``success`` of them end early."""
    reached = generator.random(count) < success
    length = np.where(reached, generator.integers(10, 200, count), horizon)
    return {
        "discounted_return": generator.normal(20.0, 5.0, count),
        "undiscounted_return": generator.normal(10.0, 50.0, count),
        "length": length,
        "success": reached,
        "diverged": np.zeros(count, dtype=bool),
        "tip_travel_distance": length * 0.01,
        "final_distance": generator.random(count),
        "torque_per_agent": generator.normal(28.0, 1.0, count),
        "torque_joint": generator.normal(70.0, 2.0, count),
    }


def metrics(columns: dict[str, np.ndarray]) -> dict:
    """What ``experiment.summary.summarise`` says of them."""
    count, successes = len(columns["length"]), int(columns["success"].sum())
    low, high = wilson_interval(successes, count)
    averaged = {name: values for name, values in columns.items() if name not in ("success", "diverged", "length")}
    return {
        "episodes": count,
        "success_rate": {"mean": successes / count, "low": low, "high": high},
        "diverged": 0,
        "episode_length": {"mean": float(columns["length"].mean()), "std": float(columns["length"].std())},
    } | {name: {"mean": float(values.mean()), "std": float(values.std())} for name, values in averaged.items()}


def write_run(
    root: Path,
    task: str,
    label: str,
    seed: int,
    success: float = 0.8,
    count: int = 100,
    points: int = 10,
    frames: int = 2_000_000,
    observation: str = "standard",
    curriculum: bool = False,
    perturbation: str = "none",
    recipe: str = "tuned",
    start: str | None = None,
) -> Path:
    """A finished run; its evaluations during training rise to ``success``."""
    folder = root / task / label / f"seed{seed}"
    folder.mkdir(parents=True)
    generator = np.random.default_rng([seed, *f"{task}{label}".encode()])
    columns = episodes(generator, count, success)
    evaluations = [
        {"evaluation": k, "iteration": k, "frames": frames * k // points, "wall_time": 60.0 * k}
        | metrics(episodes(generator, 50, success * (1 - np.exp(-3 * k / points)), 200))
        for k in range(1, points + 1)
    ]
    _write_episodes(folder, columns)
    (folder / "evaluations.jsonl").write_text("".join(json.dumps(entry) + "\n" for entry in evaluations))
    (folder / "metrics.csv").write_text(f"iteration,frames\n1,{frames}\n")
    config = {
        "recipe": recipe,
        "task": {"name": task, "horizon": 2000, "curriculum": {"enabled": curriculum}},
        "perturbation": {"name": perturbation},
        "start": {"policy": start},
        "experiment": {"evaluation": {"horizon": 200, "final_horizon": None}},
    }
    (folder / "config.yaml").write_text(json.dumps(config))
    summary = {
        "task": task,
        "algo": label,
        "model": "mlp",
        "observation": observation,
        "seed": seed,
        "frames": frames,
        "wall_time": 600.0,
        "threads": 1,
        "deterministic": True,
        "final_evaluation": metrics(columns),
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


def write_evaluation(
    folder: Path,
    task: str,
    label: str,
    seed: int,
    perturbation: dict,
    success: float = 0.6,
    overrides: tuple = (),
    **further: object,
) -> Path:
    """An evaluation beside training."""
    folder.mkdir(parents=True)
    columns = episodes(np.random.default_rng([seed, *str(folder.name).encode()]), 100, success)
    _write_episodes(folder, columns)
    summary = {
        "task": task,
        "algo": label,
        "seed": seed,
        "frames": 2_000_000,
        "perturbation": perturbation,
        "evaluation_seed": 1,
        "deterministic": True,
        "overrides": list(overrides),
        "metrics": metrics(columns),
    }
    (folder / "summary.json").write_text(json.dumps(summary | further))
    return folder


def _write_episodes(folder: Path, columns: dict[str, np.ndarray]) -> None:
    with (folder / "episodes.csv").open("w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["episode", *columns])
        rows = zip(*(values.tolist() for values in columns.values()), strict=True)
        writer.writerows([index, *row] for index, row in enumerate(rows))
