import json

import pytest

from softgm_bench.storage import files


def test_a_write_that_fails_leaves_the_old_content_and_no_litter(tmp_path, monkeypatch):
    path = tmp_path / "summary.json"
    files.write_atomically(path, b"old")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(files.os, "fsync", full)
    with pytest.raises(OSError, match="No space"):
        files.write_atomically(path, b"new")

    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]


def test_json_is_valid_where_numbers_are_not():
    text = files.to_json({"a": float("nan"), "b": [1.5, float("inf")], "c": {"d": True}})

    assert json.loads(text) == {"a": None, "b": [1.5, None], "c": {"d": True}}
