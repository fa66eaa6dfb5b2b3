"""A run's time: with ``experiment.minutes``, training stops while what is left covers the final evaluation."""

import math
import time
from collections.abc import Callable

MARGIN = 1.3  # of the estimate: an evaluation of a policy that touches more takes longer, so do shared machines
WRITING = 1.0  # seconds for the checkpoint and the files at the end


class Budget:
    """What is left of a process's minutes, and what an iteration and a step of the final evaluation take.

    Without minutes nothing is ever short.
    """

    def __init__(self, minutes: float | None, clock: Callable[[], float] = time.perf_counter) -> None:
        """Begin to count."""
        self.limited = minutes is not None
        self._clock = clock
        self._end = clock() + (math.inf if minutes is None else 60.0 * minutes)
        self._step = 0.0
        self._last: float | None = None
        self._longest = 0.0

    @property
    def left(self) -> float:
        """Seconds."""
        return self._end - self._clock()

    def measured(self, seconds: float, steps: int) -> None:
        """An evaluation as large as the final one took so long for so many control steps; the slowest one counts."""
        self._step = max(self._step, seconds / max(1, steps))

    def lap(self) -> None:
        """An iteration has ended.

        The time between two ends has everything in it that may come between them. The first iteration compiles and
        does not count.
        """
        now = self._clock()
        if self._last is not None:
            self._longest = max(self._longest, now - self._last)
        self._last = now

    def is_short(self, final_steps: int) -> bool:
        """Tell whether another iteration might leave too little for a final evaluation of so many control steps."""
        return self.limited and self.left < self._longest + MARGIN * final_steps * self._step + WRITING
