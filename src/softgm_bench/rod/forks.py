"""Processes that were forked after threads had begun to work: OpenMP's never answer there, and a step would hang."""

import os

_threads_of: int | None = None  # the process that started them


def note_threads() -> None:
    """Note that compiled code has used this process's threads."""
    global _threads_of
    if _threads_of is None:
        _threads_of = os.getpid()


def check() -> None:
    """Refuse to step in a process that was forked from one with threads.

    Raises:
        RuntimeError: saying how workers are to be started.
    """
    if _threads_of is not None and _threads_of != os.getpid():
        raise RuntimeError(
            "this process was forked after an arm had moved in its parent, whose threads it has not: start workers "
            "by spawn or forkserver, or before the first step"
        )
