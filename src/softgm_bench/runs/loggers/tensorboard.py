"""TensorBoard: scalars by frames, in the run folder's ``tensorboard/``."""

import threading
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from torch.utils.tensorboard import SummaryWriter

from softgm_bench.config import Config, plain
from softgm_bench.runs.loggers.interface import Row


def _unless_writing(otherwise: Callable[[Any], Any], failure: threading.ExceptHookArgs) -> None:
    """No traceback of the thread that writes events: what it met is raised again by the next call."""
    if not type(failure.thread).__module__.startswith("tensorboard."):
        otherwise(failure)


threading.excepthook = partial(_unless_writing, threading.excepthook)


class TensorboardLogger:
    """An event file a process; what a resumed run repeats replaces what was written before the interruption."""

    def __init__(self, config: Config, folder: Path, frames: int) -> None:
        """Open an event file and note the configuration."""
        assert config.logger.tensorboard is not None
        events = folder / "tensorboard"
        if not frames:  # a run that this one replaces
            for old in events.glob("events.out.tfevents.*"):
                old.unlink()
        self._writer = SummaryWriter(
            str(events),
            purge_step=frames + 1 if frames else None,
            flush_secs=config.logger.tensorboard.flush_seconds,
        )
        text = OmegaConf.to_yaml(OmegaConf.create(plain(config)))
        self._writer.add_text("config", "".join(f"    {line}\n" for line in text.splitlines()), frames)

    def log(self, frames: int, values: Row) -> None:
        """A scalar each."""
        for name, value in values.items():
            self._writer.add_scalar(name, value, frames)

    def finish(self, frames: int, metrics: Row, episodes: Sequence[Row], video: Callable[[], bytes | None]) -> None:
        """A scalar for each metric, and how the episodes' returns and lengths are distributed."""
        self.log(frames, metrics)
        for name in ("undiscounted_return", "length"):
            self._writer.add_histogram(f"final/episodes/{name}", np.array([row[name] for row in episodes]), frames)

    def close(self, failed: bool) -> None:
        """Write what is still waiting."""
        self._writer.close()
