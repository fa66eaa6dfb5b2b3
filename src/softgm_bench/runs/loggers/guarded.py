"""The loggers of a run. They only listen: none can change a run, and none can end it."""

import math
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from tqdm import tqdm

from softgm_bench.config import Config
from softgm_bench.errors import UserError
from softgm_bench.runs.loggers.interface import Logger, Row

# Means over an iteration's finished episodes: NaN says that there was none, and is left out.
EPISODE_MEANS = ("episode_return", "episode_length", "success_rate")

PACKAGES = {"wandb": "wandb", "tensorboard": "tensorboard"}  # that loggers need, by the logger's name


class Loggers:
    """Those that a configuration chooses. One that fails is told no more, which costs one line on stderr.

    Attributes:
        active: loggers by name that have not failed.
    """

    def __init__(self, config: Config, folder: Path, frames: int = 0) -> None:
        """Open them.

        Args:
            config: the run's.
            folder: the run's, in which each keeps its files.
            frames: from which a run is resumed.
        """
        self.active: dict[str, Logger] = {}
        for name, settings in asdict(config.logger).items():
            if name != "csv" and settings is not None:  # the run itself writes its folder
                self._guarded(name, partial(self._add, name, config, folder, frames))

    def metrics(self, row: Row) -> None:
        """An iteration's row of ``metrics.csv``."""
        values = {
            f"train/{name}": value
            for name, value in row.items()
            if name != "frames" and not (name in EPISODE_MEANS and math.isnan(value))
        }
        self._tell(lambda logger: logger.log(int(row["frames"]), values))

    def evaluation(self, frames: int, metrics: Mapping[str, Any]) -> None:
        """Pass on what ``summarise`` made of an evaluation during training."""
        values = {f"evaluation/{name}": value for name, value in flattened(metrics).items()}
        self._tell(lambda logger: logger.log(frames, values))

    def finish(
        self, frames: int, metrics: Mapping[str, Any], episodes: Sequence[Row], video: Callable[[], bytes | None]
    ) -> None:
        """The final evaluation; see ``Logger.finish``."""
        values = {f"final/{name}": value for name, value in flattened(metrics).items()}
        self._tell(lambda logger: logger.finish(frames, values, episodes, video))

    def __enter__(self) -> Self:
        """The loggers themselves."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close them."""
        self._tell(lambda logger: logger.close(failed=kind is not None))

    def _add(self, name: str, config: Config, folder: Path, frames: int) -> None:
        self.active[name] = _open(name, config, folder, frames)

    def _tell(self, message: Callable[[Logger], None]) -> None:
        for name, logger in list(self.active.items()):
            self._guarded(name, partial(message, logger))

    def _guarded(self, name: str, call: Callable[[], Any]) -> None:
        try:
            call()
        except Exception as error:  # whatever a library, its server or the disk comes up with
            self.active.pop(name, None)
            warn(f"logger {name} stopped ({_reason(error)}); the run goes on, its folder has everything")


def refuse_missing(config: Config) -> None:
    """Refuse a run whose loggers are not installed, before anything is written.

    Raises:
        UserError: naming the first of them and how it is installed.
    """
    for name, settings in asdict(config.logger).items():
        if settings is not None and name in PACKAGES and not _is_there(PACKAGES[name]):
            package = PACKAGES[name]
            raise UserError(f"logger={name}: {package} is not installed: pip install {package}, or choose logger=csv")


def _is_there(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ValueError:  # it was kept out of ``sys.modules``
        return False


def flattened(metrics: Mapping[str, Any]) -> dict[str, float]:
    """Numbers of nested mappings under joined names, a mean under its quantity's own; what is no number is left out."""
    flat: dict[str, float] = {}
    for name, value in metrics.items():
        if isinstance(value, Mapping):
            flat |= {
                name if inner == "mean" else f"{name}_{inner}": number for inner, number in flattened(value).items()
            }
        elif isinstance(value, int | float):
            flat[name] = value
    return flat


def warn(line: str) -> None:
    """Print a line on stderr without breaking a progress bar."""
    tqdm.write(f"softgm_bench: {line}", file=sys.stderr)


def _open(name: str, config: Config, folder: Path, frames: int) -> Logger:
    if name == "wandb":
        from softgm_bench.runs.loggers.wandb import WandbLogger  # late: an extra

        return WandbLogger(config, folder, frames)
    from softgm_bench.runs.loggers.tensorboard import TensorboardLogger

    return TensorboardLogger(config, folder, frames)


def _reason(error: Exception) -> str:
    if isinstance(error, ModuleNotFoundError):
        return f"{error.name} is not installed: pip install 'softgm-bench[wandb,tensorboard]'"
    if isinstance(error, OSError) and error.errno is not None:
        return f"{error.filename}: {os.strerror(error.errno)}" if error.filename else os.strerror(error.errno)
    lines = str(error).strip().splitlines()
    return f"{type(error).__name__}: {lines[0]}" if lines else type(error).__name__
