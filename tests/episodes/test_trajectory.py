"""Recorded episodes: the very ones that evaluation counts, and the same after a file."""

import dataclasses
import json

import numpy as np
import pytest
from recorded import SEEN, WALL, leaning, recorded, untrained, watched

from softgm_bench.assembly import build_env
from softgm_bench.envs import entries
from softgm_bench.episodes import recording, trajectory
from softgm_bench.episodes.evaluation import evaluate_in_parts, evaluation_seed
from softgm_bench.errors import UserError

pytestmark = pytest.mark.usefixtures("one_thread")
EPISODES = 3


@pytest.mark.parametrize("deterministic", [True, False])
@pytest.mark.parametrize("overrides", [(), ("perturbation=noise",)], ids=["plain", "noise"])
def test_a_recorded_episode_is_the_one_that_evaluation_counts(deterministic, overrides):
    policy = untrained("task=wall", *overrides)
    records = evaluate_in_parts(
        policy.policy,
        lambda count, seed: build_env(policy.config, count, seed, 40),
        EPISODES,
        deterministic=deterministic,
        seed=4,
    )
    for episode in range(EPISODES):
        one = recording.record(policy, 4, episode, 40, deterministic, episodes=EPISODES)
        assert (one.success, one.diverged, one.steps) == (
            records["success"][episode],
            records["diverged"][episode],
            records["length"][episode],
        )
        assert one.reward.astype(np.float64).sum() == records["undiscounted_return"][episode]
        assert one.contact[1:].any(axis=1).sum() == records["contact_steps"][episode]


def test_arrays_tell_the_same_as_observations_and_each_other():
    one = recorded(*WALL)
    assert one.contact.any()
    seen = one.observation
    agents = one.position[:, :, one.agent_nodes].transpose(0, 2, 1)
    assert np.array_equal(seen["agents/position"], agents.astype(np.float32))
    assert np.array_equal(seen["tip"], one.position[:, :, -1].astype(np.float32))
    assert np.array_equal(seen["agents/previous_action"][1:], one.action)
    assert np.array_equal(seen["target"], np.tile(one.target.astype(np.float32), (one.steps + 1, 1)))
    assert set(one.reward_terms) == set(entries.REWARD_TERM_NAMES)
    assert np.allclose(sum(one.reward_terms.values()), one.reward, atol=1e-5)
    length = np.linalg.norm(np.diff(one.position, axis=-1), axis=1)
    volume = np.pi * one.rod.base_radius**2 * one.rod.base_length / one.rod.n_elements
    assert np.allclose(np.pi * one.radius() ** 2 * length, volume, rtol=1e-12)


def test_the_scene_is_evaluations_and_only_existing_cylinders_are_kept():
    env = build_env(leaning(*WALL).config, 2, evaluation_seed(0))
    env.set_seed(evaluation_seed(0))
    env.reset()
    scene, one = env.scene[1], recorded(*WALL)
    assert not scene.cylinders.mask.all()  # of the wall's, the last is padding
    for name, values in one.cylinders.items():
        assert np.array_equal(values, getattr(scene.cylinders, name)[scene.cylinders.mask].numpy())
    assert np.array_equal(one.target, scene.target.numpy())


def test_attention_is_recorded_if_there_is_any():
    one = watched(*SEEN)
    layers, heads, n, slots = 2, 4, one.n_agents, one.observation["slots/active"].shape[1]
    assert one.attention["stage1"].shape == (one.steps, layers, heads, n, n + slots)
    assert one.attention["stage2"].shape == (one.steps, layers, heads, n, n)
    for weights in one.attention.values():
        assert np.allclose(weights.sum(axis=-1), 1.0, atol=1e-6)
    assert watched("task=basic", "algo=mappo").attention == {}


def test_recording_attention_changes_nothing():
    looks, does_not = (recording.record(untrained(*SEEN), 0, horizon=10, attention=look) for look in (True, False))
    assert looks.attention
    assert np.array_equal(looks.position, does_not.position)


def test_a_file_gives_back_every_bit(tmp_path):
    for one in (watched(*SEEN), recorded("task=basic", "dtype=float32")):
        path = tmp_path / "some folder" / "episode.npz"
        trajectory.save(one, path)
        again = recording.record_or_load(path)
        for name in trajectory.ARRAYS:
            left, right = getattr(one, name), getattr(again, name)
            assert left.dtype == right.dtype
            assert np.array_equal(left, right)
        for group in trajectory.GROUPS:
            left, right = getattr(one, group), getattr(again, group)
            assert left.keys() == right.keys()
            assert all(np.array_equal(left[name], right[name]) for name in left)
        assert all(getattr(one, name) == getattr(again, name) for name in trajectory.PLAIN)


def broken(content: bytes, kind: str) -> bytes:
    if kind == "cut":
        return content[: len(content) // 2]
    if kind == "flipped":
        middle = len(content) // 2
        return content[:middle] + bytes([content[middle] ^ 255]) + content[middle + 1 :]
    return b"not an archive"


@pytest.mark.parametrize("kind", ["cut", "flipped", "text"])
def test_a_damaged_file_is_one_line(tmp_path, kind):
    path = tmp_path / "episode.npz"
    trajectory.save(recorded("task=basic"), path)
    path.write_bytes(broken(path.read_bytes(), kind))
    with pytest.raises(UserError, match=r"episode\.npz: damaged or no trajectory; record it again") as caught:
        trajectory.load(path)
    assert "\n" not in str(caught.value)


def rewrite(path, **changes):
    with np.load(path) as members:
        arrays = {name: members[name] for name in members.files}
    metadata = json.loads(str(arrays.pop("metadata")))
    metadata |= changes.pop("metadata", {})
    np.savez(path, metadata=np.array(json.dumps(metadata)), **(arrays | changes))


def test_files_that_do_not_fit_are_refused(tmp_path):
    path = tmp_path / "episode.npz"
    changes = {
        "damaged": {"action": np.zeros((1, 6, 2), np.float32)},
        "another version": {"metadata": {"format": 0}},
        "no trajectory": {"position": np.array([{}], dtype=object)},  # a pickle, which could run anything
    }
    for says, change in changes.items():
        trajectory.save(recorded("task=basic"), path)
        rewrite(path, **change)
        with pytest.raises(UserError, match=says):
            trajectory.load(path)


def test_arrays_that_do_not_belong_together_are_refused():
    one = recorded("task=basic")
    with pytest.raises(ValueError, match="reward has shape"):
        dataclasses.replace(one, reward=one.reward[:-1])
    with pytest.raises(ValueError, match="cylinders/axis has shape"):
        dataclasses.replace(one, cylinders=one.cylinders | {"axis": np.zeros((2, 3))})


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"episode": -1}, "episode=-1"),
        ({"episode": 3, "episodes": 3}, "episode=3: of 3 episodes, choose 0 to 2"),
        ({"horizon": 0}, "horizon=0"),
        ({"seed": -1}, "seed=-1"),
    ],
)
def test_arguments_that_make_no_sense_are_one_line(arguments, says):
    with pytest.raises(UserError, match=says):
        recording.record(leaning("task=basic"), **({"seed": 0} | arguments))


def test_what_cannot_be_read_or_written_is_one_line(tmp_path):
    with pytest.raises(UserError, match=r"absent\.npz: No such file"):
        recording.record_or_load(tmp_path / "absent.npz")
    with pytest.raises(UserError, match="takes no settings"):
        recording.record_or_load(tmp_path / "absent.npz", overrides=["task=wall"])
    with pytest.raises(UserError, match=r"ends in \.npz"):
        trajectory.save(recorded("task=basic"), tmp_path / "episode.zip")
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="choose a file that can be written"):
        trajectory.save(recorded("task=basic"), tmp_path / "file" / "episode.npz")
