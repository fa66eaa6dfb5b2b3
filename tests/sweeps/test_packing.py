"""Archives that are whole at any moment, in few files of limited size."""

import os
import tarfile

import numpy as np
import pytest

from softgm_bench.storage import files
from softgm_bench.sweeps.packing import Pack, piece


def noise(seed, size):
    """Bytes that cannot be compressed."""
    return np.random.default_rng(seed).bytes(size)


def unpacked(folder):
    """Content by name of all archives in a folder."""
    found = {}
    for path in sorted(folder.glob("pack-*.tar.gz")):
        with tarfile.open(path) as archive:
            for entry in archive.getmembers():
                assert entry.name not in found
                found[entry.name] = archive.extractfile(entry).read()
    return found


def test_what_was_packed_piece_by_piece_is_unpacked_as_one(tmp_path):
    pack = Pack(tmp_path)
    contents = {f"runs/{k}/metrics.csv": noise(k, 5_000 + k) for k in range(5)}
    for name, content in contents.items():
        pack.add(name, piece({name: content}))
    pack.put(piece({"log.txt": b"first"}))
    pack.put(piece({"log.txt": b"second"}))
    assert unpacked(tmp_path) == contents | {"log.txt": b"second"}
    assert len(list(tmp_path.iterdir())) == 2


def test_files_on_disk_are_packed_and_missing_ones_left_out(tmp_path):
    (tmp_path / "here").write_bytes(b"content")
    Pack(tmp_path / "out").put(piece({"a/here": tmp_path / "here", "a/gone": tmp_path / "gone"}))
    assert unpacked(tmp_path / "out") == {"a/here": b"content"}


def test_no_file_exceeds_its_size_nor_their_number_and_what_has_no_room_is_named(tmp_path):
    pack = Pack(tmp_path, files=3, file_bytes=25_000)
    for k in range(6):
        pack.add(f"{k}", piece({f"{k}": noise(k, 10_000)}))
    pack.put(piece({"log.txt": b"text"}))
    assert pack.left_out == ["4", "5"]
    assert set(unpacked(tmp_path)) == {"0", "1", "2", "3", "log.txt"}
    assert len(list(tmp_path.iterdir())) == 3
    assert all(path.stat().st_size <= 25_000 for path in tmp_path.iterdir())


def test_a_small_piece_fills_the_room_that_a_large_one_left(tmp_path):
    pack = Pack(tmp_path, files=3, file_bytes=25_000)
    for k, size in enumerate((20_000, 10_000, 3_000)):
        pack.add(f"{k}", piece({f"{k}": noise(k, size)}))
    with tarfile.open(tmp_path / "pack-1.tar.gz") as archive:
        assert archive.getnames() == ["0", "2"]


@pytest.mark.parametrize("moment", ["fsync", "replace"])
def test_a_death_while_writing_leaves_everything_from_before(tmp_path, monkeypatch, moment):
    class Death(BaseException):
        pass

    def die(*_):
        raise Death

    pack = Pack(tmp_path)
    pack.add("0", piece({"0": b"zero"}))
    with monkeypatch.context() as patch:
        patch.setattr(files.os, moment, die)
        with pytest.raises(Death):
            pack.add("1", piece({"1": b"one"}))
    assert unpacked(tmp_path) == {"0": b"zero"}
    assert os.listdir(tmp_path) == ["pack-1.tar.gz"]


def test_a_piece_is_the_same_bytes_again():
    assert piece({"a": b"1", "b": b"2"}) == piece({"a": b"1", "b": b"2"})
