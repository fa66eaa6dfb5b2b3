"""The files of a data set: archives of tensordict's (``.tdz``); the same content always makes the same bytes.

A ``.tdz`` file is a zip archive that holds what ``TensorDict.memmap`` writes into a folder, uncompressed and aligned,
so ``TensorDict.load_memmap(file)`` maps it into memory. tensordict writes the time into it, which is taken out here.
"""

import hashlib
import os
import shutil
import struct
import zipfile
from pathlib import Path

from tensordict import TensorDict, TensorDictBase

from softgm_bench.errors import UserError
from softgm_bench.storage.files import wait_for_disk

NEVER = struct.pack("<HH", 0, (1 << 5) | 1)  # the first time that a zip archive knows: midnight, 1 January 1980
# Where the time stands in the headers, and the sizes of what follows in a header of the directory (PKZIP's APPNOTE).
_LOCAL_TIME, _DIRECTORY_TIME, _DIRECTORY_LENGTHS, _DIRECTORY_HEADER = 10, 12, 28, 46


def path(folder: Path, number: int) -> Path:
    """Give the file of a chunk."""
    return folder / f"chunk-{number:05d}.tdz"


def write(content: TensorDictBase, target: Path) -> None:
    """Write a chunk so that ``target`` is whole wherever it exists.

    Raises:
        OSError: it cannot be written, because the disk is full for example.
    """
    temporary = target.with_name(f".{target.name}.tmp.tdz")
    try:
        content.memmap(str(temporary))
        _forget_times(temporary)
        wait_for_disk(temporary)
        os.replace(temporary, target)
    finally:
        temporary.unlink(missing_ok=True)
    wait_for_disk(target.parent)


def sweep(folder: Path) -> None:
    """Remove what a process that was killed in the middle of a chunk has left."""
    for left in folder.glob(".chunk-*"):
        if left.is_dir():
            shutil.rmtree(left)
        else:
            left.unlink()


def read(file: Path, part: str) -> TensorDict:
    """Map a part of a chunk into memory.

    Raises:
        UserError: the file is missing, cut short or no chunk.
    """
    try:
        return TensorDict.load_memmap(file, subpath=(part,), allow_pickle=False)
    except OSError as error:
        raise UserError(f"{file}: {error.strerror or error}") from error
    except Exception as error:  # damage shows as a ValueError, KeyError, BadZipFile, RuntimeError and more
        raise UserError(f"{file}: damaged or no chunk of a data set; remove it and write it again") from error


def has(file: Path, part: str) -> bool:
    """Tell whether a chunk has a part."""
    with zipfile.ZipFile(file) as archive:
        return f"{part}/meta.json" in archive.namelist()


def checksum(file: Path) -> str:
    """Give a file's SHA-256, in hexadecimal digits.

    Raises:
        UserError: it cannot be read.
    """
    try:
        with file.open("rb") as content:
            return hashlib.file_digest(content, "sha256").hexdigest()
    except OSError as error:
        raise UserError(f"{file}: {error.strerror}") from error


def _forget_times(file: Path) -> None:
    """Set every time in a zip archive, of each entry twice, to ``NEVER``."""
    with zipfile.ZipFile(file) as archive:
        headers, at = [info.header_offset for info in archive.infolist()], archive.start_dir
    with file.open("r+b") as content:
        for offset in headers:
            content.seek(offset + _LOCAL_TIME)
            content.write(NEVER)
        for _ in headers:
            content.seek(at + _DIRECTORY_LENGTHS)
            lengths = struct.unpack("<HHH", content.read(6))
            content.seek(at + _DIRECTORY_TIME)
            content.write(NEVER)
            at += _DIRECTORY_HEADER + sum(lengths)
