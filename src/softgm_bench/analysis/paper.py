"""The paper's Tables I and II; the figures stand in ``paper.yaml``."""

from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import OmegaConf

# As the paper's tables order them.
ALGORITHMS = ("iddpg", "ippo", "isac", "maddpg", "mappo", "masac", "softgm")
TASKS = ("basic", "structured", "wall")
PERTURBATIONS = ("noise", "section_failure", "disturbance")
ABLATIONS = ("softgm", "softgm_no_stage1", "softgm_no_stage2")

MeanStd = tuple[float, float]


class Row(NamedTuple):
    """Four columns of a table: means and standard deviations, None where the paper has a dash.

    Attributes:
        episode_length: control steps.
        tip_travel_distance: m.
        torque: in the table's unit; see ``torque_joint`` in the evaluation's records.
        success_rate: per cent.
    """

    episode_length: MeanStd
    tip_travel_distance: MeanStd | None
    torque: MeanStd | None
    success_rate: float


@cache
def _tables() -> Mapping[str, Mapping[str, Row]]:
    tables: Any = OmegaConf.to_container(OmegaConf.load(Path(__file__).with_name("paper.yaml")))
    return {name: {label: Row(**_pairs(row)) for label, row in rows.items()} for name, rows in tables.items()}


def _pairs(row: Mapping[str, Any]) -> dict[str, Any]:
    return {key: tuple(value) if isinstance(value, list) else value for key, value in row.items()}


def table_one(task: str, label: str) -> Row | None:
    """Look up the paper's result of an algorithm on a task; None for what it does not have."""
    return _tables().get(task, {}).get(label) if task in TASKS else None


def table_two(task: str, label: str, perturbation: str) -> Row | None:
    """Look up the paper's result under a perturbation; it has SoftGM on the wall only."""
    if (task, label) != ("wall", "softgm"):
        return None
    return table_one(task, label) if perturbation == "none" else _tables()["robustness"].get(perturbation)
