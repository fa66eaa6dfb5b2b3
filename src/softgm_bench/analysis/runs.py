"""Finds finished runs and evaluations below a folder, and says what else lies there and why it is not one.

A run's folder holds ``config.yaml``, ``metrics.csv``, ``episodes.csv`` and ``summary.json``, the last one only when it
has finished, and ``evaluations.jsonl`` if it was evaluated before. An evaluation's folder holds ``summary.json`` with a
perturbation, and ``episodes.csv``.
"""

import csv
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from softgm_bench.errors import UserError
from softgm_bench.storage.run_folder import RunFolder

Columns = Mapping[str, NDArray[np.float64]]
SMOKE_FRAMES = 10_000  # a smoke run has 384
TUNED = "tuned"  # the recipe that labels do not name
TRUTH = {"True": 1.0, "False": 0.0, "": float("nan")}


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Episodes of one trained policy.

    Attributes:
        folder: the source, below the folder that was searched, whose name comes first.
        task: that the episodes are of.
        label: the algorithm, with what makes its results another kind's, a recipe other than the tuned one too.
        seed: of the training.
        frames: that it was trained with.
        episodes: by column of ``episodes.csv``, ``(episodes,)``; truth values are 0 and 1.
        deterministic: whether the policy's mean was taken instead of a sample.
        horizon: most control steps of an episode; None if neither settings nor episodes say it.
        perturbation: its name and parameters; ``{"name": "none"}`` without.
        overrides: settings other than those that were trained with, the perturbation apart.
        intervention: what the policy was shown in place of what its agents saw; ``none``.
        scenes: what decides which scene each episode has: evaluations that agree in it can be compared by episodes.
    """

    folder: str
    task: str
    label: str
    seed: int
    frames: int
    episodes: Columns
    deterministic: bool
    horizon: int | None
    perturbation: Mapping[str, Any]
    overrides: Sequence[str]
    intervention: str
    scenes: Mapping[str, Any]

    @property
    def intervened(self) -> bool:
        """Tell whether the policy was shown something else than what its agents saw."""
        return self.intervention != "none"


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
        """Tell whether actors were told what they would have to discover."""
        return self.summary["observation"] == "oracle"

    @property
    def curriculum(self) -> bool:
        """Tell whether training began with easier scenes."""
        return bool(self.config["task"].get("curriculum", {}).get("enabled", False))

    @property
    def smoke(self) -> bool:
        """Tell whether training was too short to learn anything, whatever its experiment is called."""
        return self.config["experiment"].get("name") == "smoke" or self.final.frames < SMOKE_FRAMES

    @property
    def trained_with(self) -> str:
        """Perturbation during training, ``none`` without."""
        return (self.config.get("perturbation") or {}).get("name", "none")

    @property
    def randomised(self) -> bool:
        """Tell whether training drew a body for every episode."""
        return (self.config.get("randomise") or {}).get("name", "none") != "none"

    @property
    def started(self) -> bool:
        """Tell whether training began with a trained policy."""
        return (self.config.get("start") or {}).get("policy") is not None

    @property
    def recipe(self) -> str:
        """Name of the hyperparameters."""
        return _recipe(self.config)

    @property
    def minutes(self) -> float:
        """That the training took."""
        return self.summary["wall_time"] / 60

    @property
    def progress_horizon(self) -> int:
        """Most control steps of an episode in the evaluations during training."""
        return self.config["experiment"]["evaluation"]["horizon"] or self.config["task"]["horizon"]


class Problem(NamedTuple):
    """A folder that looks like a run or an evaluation and cannot be used."""

    folder: str
    reason: str


class Found(NamedTuple):
    """Everything usable below some folders, and what is not, in the order of the folders' names."""

    runs: list[Run]
    evaluations: list[Evaluation]
    problems: list[Problem]


def find(*roots: Path) -> Found:
    """Read everything below the folders.

    Raises:
        UserError: there is no such folder.
    """
    found = Found([], [], [])
    lists: dict[type, list] = {Run: found.runs, Evaluation: found.evaluations, Problem: found.problems}
    for root in roots:
        if not root.is_dir():
            raise UserError(f"{root}: no such folder")
        for path, folders, files in os.walk(root.resolve()):
            folders[:] = sorted(name for name in folders if name != "checkpoints" and not name.startswith("."))
            if {"summary.json", "config.yaml", "metrics.csv", "episodes.csv", "failure.json"} & set(files):
                source = _read(RunFolder(Path(path)), Path(path).relative_to(root.resolve().parent).as_posix())
                lists[type(source)].append(source)
    return found


def _read(folder: RunFolder, name: str) -> Run | Evaluation | Problem:
    if not folder.summary.exists() and folder.failure.exists():
        return Problem(name, f"failed: {_failure(folder)}")
    if not folder.summary.exists():
        return Problem(name, f"unfinished: summary.json is missing{_how_far(folder)}")
    try:
        return _source(folder, name)
    except FileNotFoundError as error:
        reason = f"{Path(error.filename).name} is missing"
    except (KeyError, TypeError, AttributeError) as error:
        reason = f"a file lacks an entry ({error})"
    except (ValueError, OSError, YAMLError, OmegaConfBaseException) as error:
        reason = str(error).splitlines()[0]
    return Problem(name, f"damaged: {reason}")


def _failure(folder: RunFolder) -> str:
    """Say why a run came to nothing, as far as it is known."""
    try:
        return " ".join(str(json.loads(folder.failure.read_text())["error"]).split())
    except (OSError, ValueError, KeyError, TypeError):
        return "failure.json is damaged"


def _how_far(folder: RunFolder) -> str:
    """Say how far a run came that has no summary, as far as it is known."""
    try:
        frames = max(int(row["frames"]) for row in csv.DictReader(folder.metrics.open()))
    except (OSError, KeyError, ValueError, TypeError):
        return ""
    return f"; {frames:,} frames so far"


def _source(folder: RunFolder, name: str) -> Run | Evaluation:
    summary = json.loads(folder.summary.read_text())
    episodes = _columns(folder.episodes)
    trained = "final_evaluation" in summary or "perturbation" not in summary
    _compare(episodes, summary["final_evaluation" if trained else "metrics"])
    config: Any = OmegaConf.to_container(OmegaConf.load(folder.config)) if trained else None
    recipe = _recipe(summary if config is None else config)
    perturbation = summary.get("perturbation", "none")
    horizon = _final_horizon(config) if trained else summary.get("horizon") or _longest_failure(episodes)
    evaluation = Evaluation(
        folder=name,
        task=summary["task"],
        label=summary["algo"] + ("" if recipe == TUNED else f"_{recipe}"),
        seed=summary["seed"],
        frames=summary["frames"],
        episodes=episodes,
        deterministic=summary["deterministic"],
        horizon=horizon,
        perturbation={"name": perturbation} if isinstance(perturbation, str) else perturbation,
        overrides=tuple(one for one in summary.get("overrides", ()) if not one.startswith("perturbation")),
        intervention=summary.get("intervention", "none"),
        scenes={
            "seed": summary.get("evaluation_seed"),
            "episodes": len(episodes["length"]),
            "horizon": horizon,
            "batch": summary.get("batch"),
            "device": summary.get("device", "cpu"),  # generators of others draw other numbers
        },
    )
    return Run(evaluation, summary, config, _progress(folder)) if trained else evaluation


def _recipe(told: Mapping[str, Any]) -> str:
    """The recipe that a config or a summary tells; earlier ones do not, or call the tuned one open."""
    recipe = told.get("recipe") or TUNED
    return TUNED if recipe == "open" else recipe


def _final_horizon(config: Mapping[str, Any]) -> int:
    return config["experiment"]["evaluation"]["final_horizon"] or config["task"]["horizon"]


def _longest_failure(episodes: Columns) -> int | None:
    """Length of an episode that ended with neither success nor a failure of its own: only the time limit ends it so."""
    timed_out = (episodes["success"] == 0) & (episodes["diverged"] == 0)
    if "contact_failure" in episodes:
        timed_out &= episodes["contact_failure"] == 0
    return int(episodes["length"][timed_out].max()) if timed_out.any() else None


def _progress(folder: RunFolder) -> list[Mapping[str, Any]]:
    if not folder.evaluations.exists():  # the run is shorter than the interval of its evaluations
        return []
    progress = [json.loads(line) for line in folder.evaluations.read_text().splitlines()]
    if any({"frames", "discounted_return", "episode_length"} - entry.keys() for entry in progress):
        raise ValueError("a line of evaluations.jsonl lacks an entry")
    return progress


def _columns(path: Path) -> Columns:
    rows = list(csv.reader(path.read_text().splitlines()))
    if len(rows) < 2 or len({len(row) for row in rows}) > 1:
        raise ValueError(f"{path.name} is empty or has an incomplete row")
    values = [[float(TRUTH.get(text, text)) for text in row] for row in rows[1:]]
    return dict(zip(rows[0], np.array(values).T, strict=True))


def _compare(episodes: Columns, metrics: Mapping[str, Any]) -> None:
    """Refuse a summary and episodes that are not of the same evaluation."""
    count = len(episodes["length"])
    if count != metrics["episodes"]:
        raise ValueError(f"episodes.csv has {count} episodes, summary.json {metrics['episodes']}")
    if not np.isfinite(episodes["undiscounted_return"]).all():
        raise ValueError("the returns are no numbers: the policy had diverged")
    mean = float(episodes["length"].mean())
    if not np.isclose(mean, metrics["episode_length"]["mean"], rtol=1e-9):
        raise ValueError("episodes.csv and summary.json differ in their mean episode length")
