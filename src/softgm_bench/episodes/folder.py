"""The folder of an evaluation of a trained policy: ``episodes.csv``, one row an episode, and ``summary.json``."""

import csv
import io
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from softgm_bench.config import GROUPS, plain
from softgm_bench.episodes import policy
from softgm_bench.episodes.evaluation import EpisodeRecords
from softgm_bench.episodes.policy import TrainedPolicy
from softgm_bench.episodes.summary import summarise
from softgm_bench.errors import UserError
from softgm_bench.storage.files import to_json, write_atomically
from softgm_bench.storage.run_folder import RunFolder
from softgm_bench.storage.versions import versions


def default_folder(
    source: Path, trained: TrainedPolicy, overrides: Sequence[str], seed: int, unusual: Mapping[str, Any]
) -> Path:
    """Choose an evaluation's folder: inside the run that the policy was read from, if it was one.

    Args:
        source: run folder, checkpoint or policy's file.
        trained: what was read there.
        overrides: settings on top of the run's; those that are no group's name become part of the folder's name.
        seed: of the evaluation.
        unusual: what else is to be named, unless it is None or False.
    """
    named = [override.partition("=") for override in overrides]
    changes = [f"{key.rpartition('.')[2]}-{value}" for key, _, value in named if key not in GROUPS]
    changes += [key if value is True else f"{key}-{value}" for key, value in unusual.items() if value]
    config = trained.config
    bodies = [] if config.randomise.name == "none" else [f"randomised-{config.randomise.name}"]
    name = "_".join([config.task.name, *changes, config.perturbation.name, *bodies, f"seed{seed}"])
    name = re.sub(r"[^\w.-]+", "-", name)
    if source.is_dir():
        return source / "evaluations" / name
    if source.parent.name == RunFolder(Path()).checkpoints.name:
        return source.parents[1] / "evaluations" / f"{name}_frames{trained.frames}"
    return Path("outputs") / "evaluations" / source.stem / name


def same(folder: Path, trained: TrainedPolicy, episodes: int, settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read the summary of an evaluation of the same policy with the same settings, if ``folder`` holds it.

    Threads may differ, which changes no more than rounding. An evaluation that does not tell its policy's parameters,
    of an earlier version, is none. One that does not tell its backend had the one that its settings mean; one that
    does not tell its policy's recipe is known by the parameters.
    """
    try:
        held = json.loads(RunFolder(folder).summary.read_text())
        wanted = {"randomise": None} | json.loads(to_json(_about(trained, settings)))
        untold = {key: held.get(key, wanted[key]) for key in ("backend", "recipe")}
        known = {key: held.get(key) for key in wanted} | untold
        alike = known | {"threads": None} == wanted | {"threads": None} and held["metrics"]["episodes"] == episodes
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return None
    return held if alike else None


def check(folder: Path, overwrite: bool) -> None:
    """Refuse a folder that holds something already, before hours are spent on what would not be written.

    Raises:
        UserError: saying what it holds and what can be done.
    """
    run = RunFolder(folder)
    if run.config.exists() or run.metrics.exists():
        raise UserError(f"out={folder} holds a training run: choose another folder")
    if run.summary.exists() and not overwrite:
        raise UserError(f"out={folder} holds an evaluation: add overwrite=true to replace it or choose another out")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"out={folder}: {error.strerror}; choose a folder that can be written") from error


def describe(trained: TrainedPolicy, records: EpisodeRecords, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Fill ``summary.json``: the policy, what it acted in, ``settings`` of the evaluation, and the metrics."""
    return {**_about(trained, settings), "metrics": summarise(records), "versions": versions()}


def _about(trained: TrainedPolicy, settings: Mapping[str, Any]) -> dict[str, Any]:
    run, config = trained.run, trained.config
    return {
        "task": config.task.name,
        "algo": trained.label,
        "model": plain(run)["model"]["name"],
        "observation": run.observation,
        "recipe": run.recipe,
        "seed": run.seed,
        "frames": trained.frames,
        "policy": policy.fingerprint(trained),
        "perturbation": asdict(config.perturbation),
        **({} if config.randomise.nothing else {"randomise": asdict(config.randomise)}),
        **settings,
    }


def write(folder: Path, records: EpisodeRecords, summary: Mapping[str, Any]) -> None:
    """Write both files, the summary last: where it is, the evaluation is whole.

    Raises:
        OSError: a full disk, or a folder taken away.
    """
    files = RunFolder(folder)
    files.summary.unlink(missing_ok=True)
    rows = records.rows()
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_atomically(files.episodes, text.getvalue().encode())
    write_atomically(files.summary, (to_json(summary, indent=2) + "\n").encode())
