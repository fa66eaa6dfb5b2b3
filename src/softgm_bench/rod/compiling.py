"""Numba's compiler, with machine code kept on disk wherever there is a place for it."""

from collections.abc import Callable
from typing import Any

import numba

from softgm_bench import compilation

_told = False


def njit(**options: Any) -> Callable[[Callable[..., Any]], Any]:
    """``numba.njit(cache=True, **options)``, and without a cache where none can be written.

    A package that only root may write to, in a container without a home, is such a place: everything then compiles anew
    in each process, after one line on stderr that names the remedy.
    """

    compilation.watch()

    def compiled(function: Callable[..., Any]) -> Any:
        try:
            return numba.njit(cache=True, **options)(function)
        except RuntimeError as error:
            if "cannot cache" not in str(error):
                raise
            _tell()
            return numba.njit(**options)(function)

    return compiled


def _tell() -> None:
    global _told
    if not _told:
        _told = True
        compilation.say(
            "compiled code cannot be kept, every process compiles anew: "
            "set NUMBA_CACHE_DIR to a folder that can be written"
        )
