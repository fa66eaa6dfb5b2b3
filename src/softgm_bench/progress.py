"""Progress of long work: a bar in a terminal, now and then a plain line anywhere else; on standard error.

Rates and the time left do not count what kernels took to compile. Nothing here can end the work: where nobody reads,
nothing is written.
"""

import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import suppress
from types import TracebackType
from typing import Any, Self, TypeVar

from tqdm import tqdm

from softgm_bench import compilation

SECONDS_BETWEEN_LINES = 10.0
DELAY = 1.0  # seconds until a bar of work that may be short is shown

Item = TypeVar("Item")


class Progress:
    """So many units of work, of which some are done; the rate is that since the beginning."""

    def __init__(
        self, label: str, total: int | None, unit: str, done: int = 0, *, keep: bool = False, at_most: bool = False
    ) -> None:
        """Begin.

        Args:
            label: of the work; may be empty.
            total: units of work; None: nobody knows.
            unit: its plural.
            done: how many are done already.
            keep: show a bar from the first moment on and leave it, and say in plain lines too when all is done.
            at_most: the work may end before all units are done, so what is left is at most so much.
        """
        self._label, self._total, self._unit, self._keep, self._at_most = label, total, unit, keep, at_most
        self._first = self._done = done
        self._compiled = compilation.seconds()
        self._started = self._printed = time.perf_counter()
        style: dict[str, Any] = {"dynamic_ncols": True, "leave": keep, "delay": 0.0 if keep else DELAY}
        style["unit_scale"] = total is not None and total >= 10_000
        self._bar = tqdm(disable=True)
        if sys.stderr is not None:
            with suppress(OSError, ValueError):  # disable=None: unless it is a terminal
                self._bar = tqdm(desc=label, total=total, initial=done, unit=f" {unit}", disable=None, **style)

    def advance(self, count: int = 1, note: str = "") -> None:
        """``count`` more units are done; ``note`` says what else is worth knowing now."""
        self._done += count
        self._leave_out_compilation()
        with suppress(OSError, ValueError):
            self._bar.set_postfix_str(note, refresh=False)
            self._bar.update(count)
        if self._bar.disable and (self._is_due() or (self._keep and self._done == self._total)):
            self.say(self._line(note))

    def note(self, text: str) -> None:
        """Say what goes on meanwhile, when no unit of the work is done."""
        with suppress(OSError, ValueError):
            self._bar.set_postfix_str(text)
        if self._bar.disable and self._is_due():
            self.say(text)

    def say(self, line: str) -> None:
        """Print a line without breaking the bar."""
        self._printed = time.perf_counter()
        if sys.stderr is not None:
            with suppress(OSError, ValueError):
                tqdm.write(line, file=sys.stderr)

    def _is_due(self) -> bool:
        return time.perf_counter() - self._printed > SECONDS_BETWEEN_LINES

    def _line(self, note: str) -> str:
        rate = (self._done - self._first) / max(time.perf_counter() - self._started, 1e-9)
        label = f"{self._label}: " if self._label else ""
        parts = [f"{self._done} {self._unit}", f"{_three_digits(rate)} {self._unit}/s", *([note] if note else [])]
        if self._total:
            left = tqdm.format_interval((self._total - self._done) / rate) if rate else "?"
            bound = "at most " if self._at_most else ""
            parts = [f"{self._done / self._total:4.0%}", *parts, f"{bound}{left} left"]
        return label + "  ".join(parts)

    def _leave_out_compilation(self) -> None:
        """Set the clocks back by what has been compiled since they were looked at."""
        lost, self._compiled = compilation.seconds() - self._compiled, compilation.seconds()
        self._started += lost
        if not self._bar.disable:
            self._bar.start_t += lost
            self._bar.last_print_t += lost

    def __enter__(self) -> Self:
        """The progress itself."""
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        """Close the bar."""
        with suppress(OSError, ValueError):
            self._bar.close()


def tracked(items: Iterable[Item], label: str, total: int, unit: str) -> Iterator[Item]:
    """The items, and progress of what is done with them."""
    with Progress(label, total, unit) as progress:
        for item in items:
            yield item
            progress.advance()


def _three_digits(rate: float) -> str:
    return f"{rate:.0f}" if rate >= 100.0 else f"{rate:.3g}"
