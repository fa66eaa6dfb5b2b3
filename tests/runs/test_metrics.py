import csv
import math

import pytest
import torch
from tensordict import TensorDict

from softgm_bench.envs import entries
from softgm_bench.runs.metrics import CsvWriter, EpisodeTracker, step_metrics


def batch(reward, done, success):
    reward, done, success = (torch.tensor(values).unsqueeze(-1) for values in (reward, done, success))
    after = TensorDict({entries.REWARD: reward.float(), entries.DONE: done.bool()}, reward.shape[:2])
    after[entries.SUCCESS], after[entries.DIVERGED] = success.bool(), (done.bool() & ~success.bool())
    return TensorDict({"next": after}, after.batch_size)


def test_an_episode_is_followed_across_batches():
    tracker = EpisodeTracker(2, "cpu")

    first = tracker.update(batch([[1, 2, 4], [1, 1, 1]], [[0, 1, 0], [0, 0, 0]], [[0, 1, 0], [0, 0, 0]]))
    second = tracker.update(batch([[8, 0], [1, 1]], [[1, 0], [0, 1]], [[0, 0], [0, 1]]))

    assert first == {"episodes": 1, "episode_return": 3.0, "episode_length": 2.0, "success_rate": 1.0, "diverged": 0}
    # 4 + 8 in 2 steps without success, 1 + 1 + 1 + 1 + 1 in 5 with it
    assert second == {"episodes": 2, "episode_return": 8.5, "episode_length": 3.5, "success_rate": 0.5, "diverged": 1}


def test_without_a_finished_episode_the_means_are_nan():
    row = EpisodeTracker(1, "cpu").update(batch([[1, 1]], [[0, 0]], [[0, 0]]))

    assert row["episodes"] == 0
    assert all(math.isnan(row[name]) for name in ("episode_return", "episode_length", "success_rate"))


def test_every_reward_term_has_a_column():
    after = TensorDict({}, [2, 3])
    for index, name in enumerate(entries.REWARD_TERM_NAMES):
        after[entries.REWARD_TERMS, name] = torch.full((2, 3, 1), float(index))
    infos = (
        entries.DISTANCE,
        entries.CONTACT_NODES,
        entries.DISCOVERED,
        entries.TORQUE_PER_AGENT,
        entries.TORQUE_JOINT,
        entries.DROPPED,
    )
    for key in infos:
        after[key] = torch.arange(6.0).view(2, 3, 1)

    row = step_metrics(TensorDict({"next": after}, [2, 3]))

    assert [row[f"reward_{name}"] for name in entries.REWARD_TERM_NAMES] == list(range(8))
    assert row["discovered_bins"] == 2.5
    assert row["dropped_bins"] == 5.0
    assert "difficulty" not in row


def test_difficulty_has_a_column_where_there_is_a_curriculum():
    after = TensorDict({}, [2, 3])
    for name in entries.REWARD_TERM_NAMES:
        after[entries.REWARD_TERMS, name] = torch.zeros(2, 3, 1)
    infos = (
        entries.DISTANCE,
        entries.CONTACT_NODES,
        entries.DISCOVERED,
        entries.TORQUE_PER_AGENT,
        entries.TORQUE_JOINT,
        entries.DROPPED,
    )
    for key in infos:
        after[key] = torch.zeros(2, 3, 1)
    after[entries.DIFFICULTY] = torch.linspace(0.0, 1.0, 6).view(2, 3, 1)
    assert step_metrics(TensorDict({"next": after}, [2, 3]))["difficulty"] == pytest.approx(0.5)


def test_rows_are_on_disk_at_once_and_read_back_exactly(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("left over\n")
    with CsvWriter(path) as writer:
        writer.write({"frames": 10, "loss": 0.1 + 0.2})
        assert path.read_text() == "frames,loss\n10,0.30000000000000004\n"
        writer.write({"loss": float("nan"), "frames": 20})
        with pytest.raises(ValueError, match="columns changed"):
            writer.write({"frames": 30})

    with path.open() as file:
        rows = list(csv.DictReader(file))
    assert [row["frames"] for row in rows] == ["10", "20"]
    assert math.isnan(float(rows[1]["loss"]))


def test_a_file_of_an_earlier_version_keeps_its_columns(tmp_path):
    path = tmp_path / "metrics.csv"
    path.write_text("frames,loss\n10,0.5\n")
    with CsvWriter(path, append=True) as writer:
        writer.write({"frames": 20, "loss": 0.25, "measured_today": 1.0})
        with pytest.raises(ValueError, match=r"columns changed: \['loss'\]"):
            writer.write({"frames": 30})
    assert path.read_text() == "frames,loss\n10,0.5\n20,0.25\n"
