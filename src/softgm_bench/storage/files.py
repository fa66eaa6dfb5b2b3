"""Files that are written whole or not at all, and read with one line about what is wrong."""

import json
import math
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from softgm_bench.errors import UserError


def read_where_asked(path: Path) -> bytes:
    """Read a file that the user named.

    Raises:
        UserError: it cannot be read.
    """
    try:
        return path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from error


def write_where_asked(path: Path, content: bytes) -> None:
    """``write_atomically`` to a file that the user named, whose folder is made.

    Raises:
        UserError: it cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(path, content)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}; choose a file that can be written") from error


def write_atomically(path: Path, content: bytes) -> None:
    """Write or replace a file so that, whatever happens, ``path`` holds all of the old content or all of the new."""
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise
    wait_for_disk(path.parent)


def to_json(value: Mapping[str, Any], indent: int | None = None) -> str:
    """JSON text; numbers that are not finite become null, which JSON has a word for."""
    return json.dumps(_finite(value), indent=indent, allow_nan=False)


def wait_for_disk(path: Path) -> None:
    """Wait until what was written to a file or folder would survive a power failure."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _finite(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
