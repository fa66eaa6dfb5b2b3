"""The interface of a logger: what a run tells it."""

from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

Row = Mapping[str, float | int]


class Logger(Protocol):
    """Hears of a run."""

    def log(self, frames: int, values: Row) -> None:
        """Take values by name after so many frames."""

    def finish(self, frames: int, metrics: Row, episodes: Sequence[Row], video: Callable[[], bytes | None]) -> None:
        """Take the final evaluation: metrics by name, one row an episode, and a function that draws an MP4 of one."""

    def close(self, failed: bool) -> None:
        """Expect nothing more."""
