"""Progress of a run: frames, frames/s, success rate and time left, on standard error."""

import math
from types import TracebackType
from typing import Self

from softgm_bench import progress
from softgm_bench.episodes.evaluation import Watch, watched


class Progress:
    """What a run has learnt from, and between iterations what an evaluation has come to."""

    def __init__(self, total_frames: int, frames: int = 0) -> None:
        """Begin after ``frames`` frames."""
        self._success = "-"
        self._progress = progress.Progress("", total_frames, "frames", frames, keep=True)
        self.say = self._progress.say

    def advance(self, frames: int, success_rate: float) -> None:
        """``frames`` more have been learnt from; the success rate is theirs, NaN if no episode ended."""
        if not math.isnan(success_rate):
            self._success = f"{success_rate:.2f}"
        self._progress.advance(frames, f"success {self._success}")

    def evaluation(self, episodes: int) -> Watch:
        """What an evaluation of so many episodes is to be watched by."""
        return watched(episodes, lambda steps, told: self._progress.note(f"evaluating: {told}"))

    def __enter__(self) -> Self:
        """The progress itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Leave the bar as it stands."""
        self._progress.__exit__(kind, error, at)
