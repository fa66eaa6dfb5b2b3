"""Mark committed evaluations anew after more scenes were certified: ``python experiments/recertify.py``.

What ``softgm-bench certify`` finds makes the share of the certified scenes of every earlier evaluation another one.
This rewrites, in the evaluations below ``experiments`` that have played certified scenes, the column ``certified`` of
``episodes.csv`` and ``success_certified`` of ``summary.json`` as the evaluation would write them today. No episode is
played, and nothing else changes. An evaluation of a run whose settings let an arm touch more, or less, than the scenes
were certified for keeps what it has.
"""

import csv
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
from omegaconf import DictConfig, OmegaConf

from softgm_bench.config import typed
from softgm_bench.episodes import certified
from softgm_bench.episodes.evaluation import CERTIFIED, EpisodeRecords
from softgm_bench.episodes.summary import summarise
from softgm_bench.storage.files import to_json, write_atomically

EXPERIMENTS = Path(__file__).parent
RULES = ("max_contact_steps", "contact_counts")


def marked(folder: Path) -> tuple[list[dict[str, str]], dict[str, Any]]:
    """Give an evaluation's rows and summary with today's certified scenes.

    Raises:
        SystemExit: the evaluation's episodes are not those of the task's file of scenes.
    """
    summary = json.loads((folder / "summary.json").read_text())
    with (folder / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    known = certified.of_task(summary["task"])
    if known is None or (known.scenes, known.seed) != (len(rows), summary["evaluation_seed"]) or summary["batch"]:
        raise SystemExit(f"{folder}: its episodes are not the scenes of {summary['task']}'s file; evaluate again")
    mask = (known.length > 0) & (known.length <= summary["horizon"])
    success = np.array([row["success"] == "True" for row in rows])
    summary["metrics"]["success_certified"] = summarise(
        EpisodeRecords({"length": np.array([int(row["length"]) for row in rows]), "success": success, CERTIFIED: mask})
    )["success_certified"]
    return [row | {CERTIFIED: str(one)} for row, one in zip(rows, mask.tolist(), strict=True)], summary


def evaluations() -> Iterator[Path]:
    """Go through the folders of all evaluations that have played certified scenes by the rules of the task."""
    for path in sorted(EXPERIMENTS.rglob("summary.json")):
        summary = json.loads(path.read_text())
        if "success_certified" in summary.get("metrics", {}) and by_its_rules(path.parent, summary["task"]):
            yield path.parent


def by_its_rules(folder: Path, task: str) -> bool:
    """Tell whether the run that an evaluation lies in, if it lies in one, limited contact as the task's scenes do."""
    runs = [parent / "config.yaml" for parent in folder.parents if (parent / "config.yaml").exists()]
    known = certified.of_task(task)
    if not runs or known is None:
        return True
    held = typed(cast(DictConfig, OmegaConf.load(runs[0]))).task
    return all(getattr(held, name) == known.physics["task"][name] for name in RULES)


def main() -> None:
    """Rewrite them all."""
    for folder in evaluations():
        rows, summary = marked(folder)
        lines = [",".join(rows[0]), *(",".join(row.values()) for row in rows)]
        write_atomically(folder / "episodes.csv", ("\n".join(lines) + "\n").encode())
        write_atomically(folder / "summary.json", (to_json(summary, indent=2) + "\n").encode())
        share = summary["metrics"]["success_certified"]
        print(f"{folder.relative_to(EXPERIMENTS)}: {share['mean']:.3f} of {share['episodes']} certified scenes")


if __name__ == "__main__":
    main()
