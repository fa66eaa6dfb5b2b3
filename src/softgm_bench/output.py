"""Printing that cannot end a run: whoever reads it may have gone, its disk may be full, or nobody ever listened."""

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Any

STREAMS = {1: "stdout", 2: "stderr"}


class _Unbreakable:
    """A text stream whose writes never fail. What cannot be written is dropped, and nothing waits in a buffer."""

    def __init__(self, stream: Any) -> None:
        """Write in place of ``stream``, to its file itself where it has one."""
        self._stream = stream
        self._file: int | None = None
        with contextlib.suppress(OSError, ValueError, AttributeError):
            stream.flush()
            self._file = stream.fileno()

    def write(self, text: str) -> int:
        """Write all of ``text``, or what the file takes of it."""
        with contextlib.suppress(OSError, ValueError):
            if self._file is None:
                self._stream.write(text)
            else:
                rest = memoryview(text.encode(self._stream.encoding or "utf-8", "replace"))
                while rest:
                    rest = rest[os.write(self._file, rest) :]
        return len(text)

    def flush(self) -> None:
        """Nothing waits here."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()

    def __getattr__(self, name: str) -> Any:
        """Be the stream in all else."""
        return getattr(self._stream, name)


@contextlib.contextmanager
def unbreakable() -> Iterator[None]:
    """Within, whatever is printed to ``sys.stdout`` and ``sys.stderr`` may be lost and raises nothing."""
    before = {name: getattr(sys, name) for name in STREAMS.values()}
    _open_closed()
    try:
        for name in before:
            stream = getattr(sys, name)
            setattr(sys, name, stream if isinstance(stream, _Unbreakable) else _Unbreakable(stream))
        yield
    finally:
        for name, stream in before.items():
            setattr(sys, name, stream)


def _open_closed() -> None:
    """Put the null device where a stream was closed (``2>&-``), or the next file that is opened would be printed to."""
    for number, name in STREAMS.items():
        try:
            os.fstat(number)
        except OSError:
            null = os.open(os.devnull, os.O_WRONLY)
            if null != number:
                os.dup2(null, number)
                os.close(null)
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, "w"))  # noqa: SIM115 -- for as long as the process lives
