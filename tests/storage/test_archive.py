import pytest
import torch

from softgm_bench.errors import UserError
from softgm_bench.storage import archive


def test_what_is_packed_is_loaded_bit_for_bit(tmp_path):
    state = {"weights": torch.rand(5, 3), "plain": {"seed": 1, "threads": None, "range": [0.1, 0.2]}}
    path = tmp_path / "state.pt"
    path.write_bytes(archive.packed(state))

    loaded = archive.load(path)

    assert torch.equal(loaded["weights"], state["weights"])
    assert loaded["plain"] == state["plain"]


def test_damaged_and_missing_files_are_refused_in_one_line(tmp_path):
    path, values = tmp_path / "state.pt", torch.rand(1000)
    whole = archive.packed({"values": values})
    flipped = bytearray(whole)
    flipped[whole.index(values[100:200].numpy().tobytes())] ^= 1
    for content in (bytes(flipped), whole[: len(whole) // 2], whole[:10], b"", b"not a checkpoint"):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"^\S+: damaged or no checkpoint[^\n]*$"):
            archive.load(path)
    torch.save(torch.ones(2), path)
    with pytest.raises(UserError, match=r"^\S+: no checkpoint of this program[^\n]*$"):
        archive.load(path)
    with pytest.raises(UserError, match=r"^\S+: No such file[^\n]*$"):
        archive.load(tmp_path / "missing.pt")


class Bomb:
    def __reduce__(self):
        return print, ("boom",)


def test_loading_runs_no_code_from_the_file(tmp_path, capsys):
    path = tmp_path / "bomb.pt"
    torch.save({"bomb": Bomb()}, path)

    with pytest.raises(UserError):
        archive.load(path)
    assert "boom" not in capsys.readouterr().out
