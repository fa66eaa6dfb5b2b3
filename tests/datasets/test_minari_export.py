"""Minari gives back what was handed to it; skipped where it is not installed."""

import numpy as np
import pytest
import torch
from small import POLICY, Asked, write

from softgm_bench.datasets import minari as exported
from softgm_bench.datasets.reading import load

minari = pytest.importorskip("minari")
pytest.importorskip("h5py")


def test_minari_reads_the_episodes_that_were_written(tmp_path, monkeypatch):
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    write(tmp_path / "x", Asked(["random", POLICY.format(task="wall")], horizon=12))
    data = load(tmp_path / "x")
    exported.export(data, "softgm/wall-v0")
    theirs, whole = minari.load_dataset("softgm/wall-v0"), data.storage()[:]
    assert theirs.total_steps == data.transitions
    ends = np.cumsum(data.episodes["length"])
    for episode, end, length in zip(theirs.iterate_episodes(), ends, data.episodes["length"], strict=True):
        own = whole[int(end - length) : int(end)]
        assert np.array_equal(episode.actions, own["agents", "action"])
        assert np.array_equal(episode.rewards, own["next", "reward"].squeeze(-1))
        assert np.array_equal(episode.terminations, own["next", "terminated"].squeeze(-1))
        assert np.array_equal(episode.truncations, own["next", "truncated"].squeeze(-1))
        for key in (("tip",), ("agents", "velocity"), ("slots", "descriptor"), ("agents", "edge")):
            told = torch.from_numpy(episode.observations["_".join(key)])
            assert torch.equal(told[:-1], own[key].to(told.dtype))
            assert torch.equal(told[1:], own["next", *key].to(told.dtype))
