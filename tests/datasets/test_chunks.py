import errno
import zipfile

import pytest
import torch
from tensordict import TensorDict

from softgm_bench.datasets import chunks
from softgm_bench.errors import UserError


def content():
    inner = TensorDict({"a": torch.arange(6, dtype=torch.float32).view(3, 2), "b": torch.zeros(3, 0)}, [3])
    return TensorDict({"frames": inner, "obstacles": TensorDict({"descriptor": torch.zeros(0, 9)}, [0])})


def test_a_chunk_is_mapped_by_tensordict_itself_and_unzipped_too(tmp_path):
    chunks.write(content(), tmp_path / "x.tdz")
    with zipfile.ZipFile(tmp_path / "x.tdz") as archive:
        assert archive.testzip() is None
        archive.extractall(tmp_path / "unzipped")
    for found in (tmp_path / "x.tdz", tmp_path / "unzipped"):
        assert (TensorDict.load_memmap(found) == content()).all()
    assert chunks.has(tmp_path / "x.tdz", "obstacles")
    assert not chunks.has(tmp_path / "x.tdz", "episodes")


def test_the_same_content_makes_the_same_bytes_at_any_time(tmp_path, monkeypatch):
    chunks.write(content(), tmp_path / "x.tdz")
    monkeypatch.setattr("time.localtime", lambda *_: (2031, 2, 3, 4, 5, 6, 0, 0, 0))
    chunks.write(content(), tmp_path / "y.tdz")
    assert (tmp_path / "x.tdz").read_bytes() == (tmp_path / "y.tdz").read_bytes()
    assert chunks.checksum(tmp_path / "x.tdz") == chunks.checksum(tmp_path / "y.tdz")
    with zipfile.ZipFile(tmp_path / "x.tdz") as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_a_chunk_that_cannot_be_written_leaves_nothing(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(chunks, "wait_for_disk", full)
    with pytest.raises(OSError, match="No space left"):
        chunks.write(content(), tmp_path / "x.tdz")
    assert not list(tmp_path.iterdir())


def test_what_a_killed_process_left_is_swept(tmp_path):
    (tmp_path / ".chunk-00001.tdz.tmp.tdz.abc").mkdir()
    (tmp_path / ".chunk-00001.tdz.tmp.tdz").touch()
    (tmp_path / "chunk-00000.tdz").touch()
    chunks.sweep(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["chunk-00000.tdz"]


def test_damage_is_told_in_one_line(tmp_path):
    file = tmp_path / "x.tdz"
    chunks.write(content(), file)
    whole = file.read_bytes()
    for damaged in (b"", whole[: len(whole) // 2]):
        file.write_bytes(damaged)
        with pytest.raises(UserError, match="damaged or no chunk of a data set"):
            chunks.read(file, "frames")
    with pytest.raises(UserError, match=r"damaged|No such file"):
        chunks.read(tmp_path / "y.tdz", "frames")
