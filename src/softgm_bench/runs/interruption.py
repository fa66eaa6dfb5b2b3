"""Ctrl-C, SIGTERM and the like end a run where its state is whole: it can be resumed from the checkpoint written then.

A terminal that is closed sends SIGHUP, a queue warns with SIGUSR1 or SIGUSR2. What the parent process has set to be
ignored stays ignored, as under ``nohup``.
"""

import os
import signal
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from types import FrameType
from typing import Any, Self

STOPPING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP", "SIGUSR1", "SIGUSR2") if hasattr(signal, name))


def heeded(numbers: Iterable[int]) -> list[int]:
    """Give those of the signals that this process does not ignore."""
    return [number for number in numbers if signal.getsignal(number) != signal.SIG_IGN]


class Interrupted(KeyboardInterrupt):
    """The run was told to stop; the message says where its checkpoint is."""

    def __init__(self, signal_number: int) -> None:
        """Remember the signal for the exit code."""
        super().__init__()
        self.exit_code = 128 + signal_number


class Interruption:
    """While entered, a first SIGINT or ``STOPPING`` waits for ``check`` or ``at_once``; a second stops anywhere."""

    def __init__(self) -> None:
        """Nothing has arrived yet."""
        self._received: int | None = None
        self._at_once = False
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Begin to listen."""
        for number in heeded((signal.SIGINT, *STOPPING)):
            self._previous[number] = signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        """Put the previous handlers back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)

    def check(self) -> None:
        """Stop here if a signal has arrived."""
        if self._received is not None:
            raise Interrupted(self._received)

    @contextmanager
    def at_once(self) -> Iterator[None]:
        """Let a signal interrupt the work inside anywhere, such as an evaluation."""
        self._at_once = True
        try:
            self.check()
            yield
        finally:
            self._at_once = False

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self._at_once:
            raise Interrupted(number)
        if self._received is not None:
            raise KeyboardInterrupt("stopped at once; only earlier checkpoints are left")
        self._received = number
        with suppress(OSError, ValueError, AttributeError):  # nobody may be left to read it
            os.write(
                sys.stderr.fileno(), b"\nstopping after this iteration; once more to stop at once\n"
            )  # print may be under way itself
