"""Weights & Biases: curves by frames, the final episodes as a table, a video; in the run folder's ``wandb/``."""

import os
import secrets
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import wandb

from softgm_bench.config import Config, plain
from softgm_bench.runs.loggers.interface import Row

INIT_SECONDS, FINISH_SECONDS = 30.0, 120.0  # that a server may take


class WandbLogger:
    """A W&B run. Without a network nothing is lost: ``wandb sync`` uploads the folder later.

    What is logged has its frames as W&B's step, so that parts of a run fit together whichever is uploaded first.
    """

    def __init__(self, config: Config, folder: Path, frames: int) -> None:
        """Start it: online under the id that an earlier part of this run had, offline under one of its own."""
        settings = config.logger.wandb
        assert settings is not None
        mode: Any = settings.mode or os.environ.get("WANDB_MODE", "offline")
        known = folder / "wandb" / "run_id"
        known.parent.mkdir(parents=True, exist_ok=True)  # W&B would go elsewhere if it could not write here
        resumed = bool(frames and known.exists())
        if not resumed:
            known.write_text(secrets.token_hex(4))
        # Of two folders with one id, ``wandb sync`` would upload one over the other.
        apart = resumed and mode == "offline"
        name = f"{config.task.name} {config.label} seed{config.seed}"
        self._video = settings.video
        self._run = wandb.init(
            project=settings.project,
            entity=settings.entity,
            mode=mode,
            dir=folder,
            id=f"{known.read_text()}-{frames}" if apart else known.read_text(),
            resume="allow" if resumed and not apart else None,
            name=f"{name} from {frames} frames" if apart else name,
            group=f"{config.task.name} {config.label}",
            config=plain(config),
            settings=wandb.Settings(
                console="off",
                silent=True,
                reinit="finish_previous",  # of a sweep's earlier run that has failed
                init_timeout=INIT_SECONDS,
                finish_timeout=FINISH_SECONDS,
            ),
        )
        self._run.define_metric("frames")
        self._run.define_metric("*", step_metric="frames")

    def log(self, frames: int, values: Row) -> None:
        """A row of the run's history."""
        self._run.log({"frames": frames, **values}, step=frames)

    def finish(self, frames: int, metrics: Row, episodes: Sequence[Row], video: Callable[[], bytes | None]) -> None:
        """The metrics as the run's summary; table and video."""
        self._run.summary.update(dict(metrics))
        columns: list[Any] = list(episodes[0])
        table = wandb.Table(columns=columns, data=[[row[name] for name in columns] for row in episodes])
        self._run.log({"frames": frames, "episodes": table}, step=frames)
        content = video() if self._video else None
        if content is not None:
            with tempfile.TemporaryDirectory() as folder:  # W&B keeps a copy of its own
                path = Path(folder) / "episode.mp4"
                path.write_bytes(content)
                self._run.log({"frames": frames, "episode": wandb.Video(str(path), format="mp4")}, step=frames)

    def close(self, failed: bool) -> None:
        """Hand over what is still waiting."""
        self._run.finish(exit_code=int(failed))
