"""Progress of a run: a bar in a terminal, now and then a plain line anywhere else."""

import math
import sys
import time
from types import TracebackType
from typing import Any, Self

from tqdm import tqdm

SECONDS_BETWEEN_LINES = 10.0


class Progress:
    """Frames, frames/s, success rate and time left, on stderr."""

    def __init__(self, total_frames: int, frames: int = 0) -> None:
        """Begin after ``frames`` frames."""
        self._total = total_frames
        self._first = self._frames = frames
        self._success = "-"
        self._started = self._printed = time.perf_counter()
        style: dict[str, Any] = {"unit": " frames", "unit_scale": True, "dynamic_ncols": True, "disable": None}
        self._bar = tqdm(total=total_frames, initial=frames, **style)

    def advance(self, frames: int, success_rate: float) -> None:
        """``frames`` more have been learnt from; the success rate is theirs, NaN if no episode ended."""
        self._frames += frames
        if not math.isnan(success_rate):
            self._success = f"{success_rate:.2f}"
        self._bar.set_postfix_str(f"success {self._success}", refresh=False)
        self._bar.update(frames)
        now = time.perf_counter()
        if self._bar.disable and (now - self._printed > SECONDS_BETWEEN_LINES or self._frames >= self._total):
            self._printed = now
            rate = (self._frames - self._first) / (now - self._started)
            left = tqdm.format_interval((self._total - self._frames) / rate)
            share = self._frames / self._total
            self.say(f"{share:4.0%}  {self._frames} frames  {rate:.0f} frames/s  success {self._success}  {left} left")

    def say(self, line: str) -> None:
        """Print a line without breaking the bar."""
        tqdm.write(line, file=sys.stderr)

    def __enter__(self) -> Self:
        """The progress itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Leave the bar as it stands."""
        self._bar.close()
