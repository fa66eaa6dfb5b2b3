"""Says when a kernel is being compiled, which is long and happens once on a machine, and knows how long that took.

Numba tells of every compilation, but not of machine code that it finds on disk.
"""

import sys
import time
from contextlib import suppress
from functools import cache

from numba.core import event

LINE = "compiling kernels, once on this machine: up to a minute"


class _Compilations(event.Listener):
    """Adds up compilations; one that another asks for is part of it."""

    def __init__(self) -> None:
        self.seconds = 0.0
        self.told = False
        self._depth, self._began = 0, 0.0

    def on_start(self, event: event.Event) -> None:
        """Say so, the first time."""
        if self._depth == 0:
            self._began = time.perf_counter()
            if not self.told:
                self.told = True
                say(LINE)
        self._depth += 1

    def on_end(self, event: event.Event) -> None:
        """Stop the clock with the outermost one."""
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.perf_counter() - self._began


_LISTENER = _Compilations()


@cache
def watch() -> None:
    """Listen from now on; modules that compile call it."""
    event.register("numba:compile", _LISTENER)


def told() -> None:
    """Say nothing about compilations any more."""
    _LISTENER.told = True


def seconds() -> float:
    """How long this process has compiled; for clocks that are not to count it."""
    return _LISTENER.seconds


def say(line: str) -> None:
    """Print a line about compiling to standard error, where somebody reads it."""
    if sys.stderr is not None:
        with suppress(OSError, ValueError):  # nobody reads it any more
            print(f"softgm_bench: {line}", file=sys.stderr, flush=True)
