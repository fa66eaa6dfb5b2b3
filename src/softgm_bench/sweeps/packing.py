"""A few archives that hold what is finished, each written whole, so that a machine may go away at any moment.

A gzip file may consist of several, and so may a tar file's content: every finished folder is packed once, and an
archive is those pieces one after another.
"""

import gzip
import io
import tarfile
from collections.abc import Iterable, Mapping
from pathlib import Path

from softgm_bench.storage.files import write_atomically

FILES = 6
FILE_BYTES = 15_000_000 - 1_000  # of an archive, with its end
_END = gzip.compress(bytes(2 * tarfile.BLOCKSIZE), mtime=0)


def piece(files: Mapping[str, Path | bytes]) -> bytes:
    """Pack files by the names that they are to have; paths that do not exist are left out."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        for name, source in files.items():
            if isinstance(source, Path) and not source.exists():
                continue
            content = source.read_bytes() if isinstance(source, Path) else source
            entry = tarfile.TarInfo(name)
            entry.size, entry.mode = len(content), 0o644
            entry.mtime = int(source.stat().st_mtime) if isinstance(source, Path) else 0
            archive.addfile(entry, io.BytesIO(content))
        end = archive.offset
    return gzip.compress(buffer.getvalue()[:end], mtime=0)


class Pack:
    """Archives ``pack-<number>.tar.gz`` in a folder, in the order in which their pieces came.

    Number 0 holds what changes, such as a log; a piece that was added elsewhere stays where it is.

    Attributes:
        names: of the pieces that have come.
        left_out: names of those for which there was no room.
    """

    def __init__(self, folder: Path, files: int = FILES, file_bytes: int = FILE_BYTES) -> None:
        """Make the folder; archives in it are replaced as pieces come."""
        folder.mkdir(parents=True, exist_ok=True)
        self.names: list[str] = []
        self.left_out: list[str] = []
        self._folder, self._most = folder, file_bytes
        self._parts: list[list[bytes]] = [[] for _ in range(files - 1)]

    def add(self, name: str, content: bytes) -> None:
        """Put a piece where there is room, in an archive that is then written whole.

        Raises:
            OSError: the folder cannot be written.
        """
        for number, part in enumerate(self._parts, 1):
            if _size(part) + len(content) <= self._most:
                part.append(content)
                self._write(number, part)
                break
        else:
            self.left_out.append(name)
        self.names.append(name)

    def put(self, content: bytes) -> None:
        """Replace what changes.

        Raises:
            OSError: the folder cannot be written.
        """
        self._write(0, [content])

    def _write(self, number: int, pieces: Iterable[bytes]) -> None:
        write_atomically(self._folder / f"pack-{number}.tar.gz", b"".join([*pieces, _END]))


def _size(pieces: Iterable[bytes]) -> int:
    return sum(map(len, pieces)) + len(_END)
