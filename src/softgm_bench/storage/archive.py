"""Files of tensors and plain values, read without running any code in them."""

import io
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from softgm_bench.errors import UserError
from softgm_bench.storage.files import read_where_asked


def packed(state: Mapping[str, Any]) -> bytes:
    """Give the content of a file that ``load`` reads; ``state`` holds tensors and plain Python values only."""
    buffer = io.BytesIO()  # a full disk then shows as an OSError, which torch's own file writing hides
    torch.save(dict(state), buffer)
    return buffer.getvalue()


def load(path: Path, device: str = "cpu") -> dict[str, Any]:
    """Read what ``packed`` gave.

    Raises:
        UserError: the file is missing, damaged or something else.
    """
    content = read_where_asked(path)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            if archive.testzip() is not None:  # torch itself does not look at the checksums
                raise ValueError("a checksum is wrong")
        state = torch.load(io.BytesIO(content), map_location=device, weights_only=True)
    except Exception as error:  # damage shows as a BadZipFile, RuntimeError, EOFError, UnpicklingError and more
        raise UserError(f"{path}: damaged or no checkpoint; use an older one") from error
    if not isinstance(state, dict):
        raise UserError(f"{path}: no checkpoint of this program, or of another version of it")
    return state
