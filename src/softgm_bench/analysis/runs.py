"""Finds finished runs and evaluations below a folder, and says what else lies there and why it is not one.

A run's folder holds ``config.yaml``, ``metrics.csv``, ``episodes.csv`` and ``summary.json``, the last one only when it
has finished, and ``evaluations.jsonl`` if it was evaluated before. An evaluation's folder holds ``summary.json`` with a
perturbation, and ``episodes.csv``.
"""

import csv
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from softgm_bench.config import UserError
from softgm_bench.storage.run_folder import RunFolder

Columns = Mapping[str, NDArray[np.float64]]
TRUTH = {"True": 1.0, "False": 0.0, "": float("nan")}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Episodes of one trained policy.

    Attributes:
        folder: the source, below the folder that was searched, whose name comes first.
        task: that the episodes are of.
        label: the algorithm, with what makes its results another kind's.
        seed: of the training.
        frames: that it was trained with.
        episodes: by column of ``episodes.csv``, ``(episodes,)``; truth values are 0 and 1.
        deterministic: whether the policy's mean was taken instead of a sample.
        horizon: most control steps of an episode; None if neither settings nor episodes say it.
        perturbation: its name and parameters; ``{"name": "none"}`` without.
        overrides: settings other than those that were trained with, the perturbation apart.
    """

    folder: str
    task: str
    label: str
    seed: int
    frames: int
    episodes: Columns
    deterministic: bool
    horizon: int | None = None
    perturbation: Mapping[str, Any] = field(default_factory=lambda: {"name": "none"})
    overrides: Sequence[str] = ()


@dataclass(frozen=True, eq=False)
class Run:
    """A finished training run: its final evaluation, and what was written on the way.

    Attributes:
        final: the evaluation at its end.
        summary: ``summary.json``.
        config: ``config.yaml``.
        progress: one mapping for each evaluation during training.
    """

    final: Evaluation
    summary: Mapping[str, Any]
    config: Mapping[str, Any]
    progress: Sequence[Mapping[str, Any]]

    @property
    def oracle(self) -> bool:
        """Whether actors were told what they would have to discover."""
        return self.summary["observation"] == "oracle"

    @property
    def curriculum(self) -> bool:
        """Whether training began with easier scenes."""
        return bool(self.config["task"].get("curriculum", {}).get("enabled", False))

    @property
    def trained_with(self) -> str:
        """Perturbation during training, ``none`` without."""
        return (self.config.get("perturbation") or {}).get("name", "none")

    @property
    def progress_horizon(self) -> int:
        """Most control steps of an episode in the evaluations during training."""
        return self.config["experiment"]["evaluation"]["horizon"] or self.config["task"]["horizon"]


@dataclass(frozen=True)
class Problem:
    """A folder that looks like a run or an evaluation and cannot be used."""

    folder: str
    reason: str


@dataclass(frozen=True, eq=False)
class Found:
    """What lies below a folder, each sorted by folder."""

    runs: list[Run] = field(default_factory=list)
    evaluations: list[Evaluation] = field(default_factory=list)
    problems: list[Problem] = field(default_factory=list)

    def __add__(self, other: "Found") -> "Found":
        """Both together."""
        return Found(self.runs + other.runs, self.evaluations + other.evaluations, self.problems + other.problems)


def find(root: Path) -> Found:
    """Everything below ``root``.

    Raises:
        UserError: there is no such folder.
    """
    if not root.is_dir():
        raise UserError(f"{root}: no such folder")
    found, base = Found(), root.resolve().parent
    for path, folders, files in os.walk(root.resolve()):
        folders[:] = sorted(name for name in folders if name != "checkpoints")
        if not {"summary.json", "config.yaml", "metrics.csv", "episodes.csv"} & set(files):
            continue
        folder, name = RunFolder(Path(path)), Path(path).relative_to(base).as_posix()
        try:
            source = _read(folder, name)
        except _Unusable as unusable:
            found.problems.append(Problem(name, str(unusable)))
        else:
            (found.runs if isinstance(source, Run) else found.evaluations).append(source)  # type: ignore[arg-type]
    return found


class _Unusable(Exception):
    """Why a folder is left out."""


def _read(folder: RunFolder, name: str) -> Run | Evaluation:
    if not folder.summary.exists():
        raise _Unusable(_how_far(folder))
    try:
        summary = json.loads(folder.summary.read_text())
        episodes = _columns(folder.episodes)
        if "final_evaluation" not in summary and "perturbation" in summary:
            return _evaluation(name, summary, episodes)
        _compare(episodes, summary["final_evaluation"])
        return _run(folder, name, summary, episodes)
    except FileNotFoundError as error:
        raise _Unusable(f"damaged: {Path(error.filename).name} is missing") from error
    except (KeyError, TypeError, AttributeError) as error:
        raise _Unusable(f"damaged: a file lacks an entry ({error})") from error
    except (ValueError, OSError, YAMLError, OmegaConfBaseException) as error:
        raise _Unusable(f"damaged: {str(error).splitlines()[0]}") from error


def _how_far(folder: RunFolder) -> str:
    """What is known of a run that has no summary."""
    try:
        frames = max(int(row["frames"]) for row in csv.DictReader(folder.metrics.open()))
    except (OSError, KeyError, ValueError, TypeError):
        return "unfinished: summary.json is missing"
    return f"unfinished: summary.json is missing; {frames:,} frames so far"


def _run(folder: RunFolder, name: str, summary: Mapping[str, Any], episodes: Columns) -> Run:
    config: Any = OmegaConf.to_container(OmegaConf.create(folder.config.read_text()))
    if not isinstance(config, dict):
        raise ValueError("config.yaml holds no settings")
    settings, horizon = config["experiment"]["evaluation"], config["task"]["horizon"]
    final = Evaluation(
        **_who_acted(name, summary),
        episodes=episodes,
        horizon=settings["final_horizon"] or horizon,
    )
    # a run that is shorter than the interval of its evaluations has no such file
    lines = folder.evaluations.read_text().splitlines() if folder.evaluations.exists() else []
    progress = [json.loads(line) for line in lines]
    for entry in progress:
        if {"frames", "discounted_return", "episode_length"} - entry.keys():
            raise ValueError("a line of evaluations.jsonl lacks an entry")
    return Run(final, summary, config, progress)


def _evaluation(name: str, summary: Mapping[str, Any], episodes: Columns) -> Evaluation:
    _compare(episodes, summary["metrics"])
    perturbation = summary["perturbation"]
    return Evaluation(
        **_who_acted(name, summary),
        episodes=episodes,
        horizon=summary.get("horizon") or _horizon(episodes),
        perturbation={"name": perturbation} if isinstance(perturbation, str) else perturbation,
        overrides=tuple(one for one in summary.get("overrides", ()) if not one.startswith("perturbation")),
    )


def _who_acted(name: str, summary: Mapping[str, Any]) -> dict[str, Any]:
    """What the summaries of a run and of an evaluation say alike."""
    same = {field: summary[field] for field in ("task", "seed", "frames", "deterministic")}
    return {"folder": name, "label": summary["algo"], **same}


def _horizon(episodes: Columns) -> int | None:
    """Length of an episode that ended with neither success nor divergence: only the time limit ends it so."""
    timed_out = (episodes["success"] == 0) & (episodes["diverged"] == 0)
    return int(episodes["length"][timed_out].max()) if timed_out.any() else None


def _columns(path: Path) -> Columns:
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    if len(rows) < 2 or any(len(row) != len(rows[0]) for row in rows):
        raise ValueError(f"{path.name} is empty or has an incomplete row")
    values = [[TRUTH[text] if text in TRUTH else float(text) for text in row] for row in rows[1:]]
    return dict(zip(rows[0], np.array(values).T, strict=True))


def _compare(episodes: Columns, metrics: Mapping[str, Any]) -> None:
    """Refuse a summary and episodes that are not of the same evaluation."""
    count = len(episodes["length"])
    if count != metrics["episodes"]:
        raise ValueError(f"episodes.csv has {count} episodes, summary.json {metrics['episodes']}")
    mean = float(episodes["length"].mean())
    if not np.isclose(mean, metrics["episode_length"]["mean"], rtol=1e-9):
        raise ValueError("episodes.csv and summary.json differ in their mean episode length")
