"""Paths of a run's files."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class RunFolder:
    """Paths of a run's files under ``path``."""

    path: Path

    @property
    def config(self) -> Path:
        """Every setting, as YAML."""
        return self.path / "config.yaml"

    @property
    def metrics(self) -> Path:
        """One row an iteration."""
        return self.path / "metrics.csv"

    @property
    def evaluations(self) -> Path:
        """One JSON object an evaluation during training."""
        return self.path / "evaluations.jsonl"

    @property
    def episodes(self) -> Path:
        """One row an episode of the final evaluation."""
        return self.path / "episodes.csv"

    @property
    def summary(self) -> Path:
        """The final evaluation; there when the run has finished."""
        return self.path / "summary.json"

    @property
    def failure(self) -> Path:
        """Why the last attempt came to nothing; gone when another begins."""
        return self.path / "failure.json"

    @property
    def checkpoints(self) -> Path:
        """Folder of the newest checkpoints."""
        return self.path / "checkpoints"

    def in_order(self) -> list[Path]:
        """Give the checkpoints, oldest first."""
        return sorted(self.checkpoints.glob("frames-*.pt"))

    def newest(self) -> Path | None:
        """Give the newest checkpoint; None if there is none."""
        return max(self.in_order(), default=None)
