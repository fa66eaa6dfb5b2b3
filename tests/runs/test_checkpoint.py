import pytest
import torch

from softgm_bench.errors import UserError
from softgm_bench.runs import checkpoint
from softgm_bench.storage.run_folder import RunFolder


def a_state():
    network = torch.nn.Linear(3, 2)
    optimiser = torch.optim.Adam(network.parameters())
    network(torch.ones(1, 3)).sum().backward()
    optimiser.step()
    return {
        "algorithm": {"network": network.state_dict(), "optimiser": optimiser.state_dict()},
        "random": checkpoint.random_state(),
        "config": {"seed": 1, "threads": None, "range": [0.1, 0.2]},
    }


def folder(path):
    (path / "checkpoints").mkdir(exist_ok=True)
    return RunFolder(path)


def test_what_is_saved_is_loaded_bit_for_bit(tmp_path):
    state = a_state()

    loaded = checkpoint.load(checkpoint.save(folder(tmp_path), 640, state, keep=2))

    assert loaded["frames"] == 640
    assert loaded["config"] == state["config"]
    assert torch.equal(loaded["random"]["cpu"], state["random"]["cpu"])
    for name, value in state["algorithm"]["network"].items():
        assert torch.equal(loaded["algorithm"]["network"][name], value)
    moments = [saved["algorithm"]["optimiser"]["state"][0]["exp_avg"] for saved in (loaded, state)]
    assert torch.equal(*moments)


def test_only_the_newest_are_kept_in_the_order_of_frames(tmp_path):
    paths = [checkpoint.save(folder(tmp_path), frames, {}, keep=2) for frames in (900, 1000, 20000)]

    assert sorted(folder(tmp_path).checkpoints.iterdir()) == paths[1:]


def test_damaged_and_foreign_files_are_refused_in_one_line(tmp_path):
    """Which damage there can be is a matter of ``storage.archive``."""
    path = checkpoint.save(folder(tmp_path), 1, a_state(), keep=1)
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    with pytest.raises(UserError, match=r"^\S+: damaged or no checkpoint[^\n]*$"):
        checkpoint.load(path)
    for foreign in ({"weights": torch.ones(2)}, {"format": 99, "algorithm": {}}, {"format": 2, "policy": {}}):
        torch.save(foreign, path)
        with pytest.raises(UserError, match=r"^\S+: no checkpoint of this program[^\n]*$"):
            checkpoint.load(path)
