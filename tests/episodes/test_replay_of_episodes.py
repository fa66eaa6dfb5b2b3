"""Replays: the same bits by the same kernel, rounding by the reference and by PyElastica."""

import dataclasses
import sys

import numpy as np
import pytest
from recorded import WALL, recorded

from softgm_bench.episodes import trajectory
from softgm_bench.episodes.replay import compare, replay
from softgm_bench.errors import UserError
from softgm_bench.rod.randomise import FACTORS

pytestmark = pytest.mark.usefixtures("one_thread")
SLIDING = ("task=wall_sliding", "task.wall_x=0.2", "task.slide_speed=0.2")  # the wall that the arm leans on soon


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("task", [("task=basic",), ("task=structured",), WALL], ids=lambda overrides: overrides[0])
def test_a_replay_from_the_file_has_the_recordings_bits(task, dtype, tmp_path):
    one = recorded(*task, f"dtype={dtype}")
    trajectory.save(one, tmp_path / "episode.npz")
    loaded = trajectory.load(tmp_path / "episode.npz")
    again = replay(loaded, "numba")
    assert again.position.dtype == one.position.dtype == np.dtype(dtype)
    for quantity in trajectory.ROD:
        assert np.array_equal(getattr(again, quantity), getattr(one, quantity)), quantity
    result = compare(one, again)
    assert result["identical"]
    assert result["replayed"] == result["recorded"]


@pytest.mark.parametrize("task", [SLIDING, ("task=swinging_posts",)], ids=lambda overrides: overrides[0])
def test_obstacles_move_in_a_replay_as_they_did(task, tmp_path):
    one = recorded(*task, horizon=15)
    trajectory.save(one, tmp_path / "episode.npz")
    loaded = trajectory.load(tmp_path / "episode.npz")
    path = loaded.cylinders[trajectory.PATH]
    assert path.shape == (16, len(loaded.cylinders["length"]), 3)
    assert (np.abs(np.diff(path, axis=0)).max(axis=(1, 2)) > 0.0).all()
    assert np.array_equal(loaded.starts(0), loaded.cylinders["start"])
    assert np.allclose(loaded.starts(3.25), 0.75 * path[3] + 0.25 * path[4], rtol=0.0, atol=1e-15)
    assert np.array_equal(loaded.starts(15), path[15])
    assert one.contact.any() == (task is SLIDING)
    assert compare(one, replay(loaded, "numba"))["identical"]
    in_pyelastica = replay(loaded, "pyelastica")
    assert np.abs(in_pyelastica.position - one.position).max() < 1e-10
    still = dataclasses.replace(one, cylinders={k: v for k, v in one.cylinders.items() if k != trajectory.PATH})
    assert compare(one, replay(still, "numba"))["identical"] == (task is not SLIDING)


def test_the_wall_is_touched_in_what_is_replayed():
    assert recorded(*WALL, "dtype=float64").contact.any()


@pytest.mark.parametrize(
    "perturbation",
    [
        ("perturbation=disturbance", "perturbation.first_step=3"),
        ("perturbation=section_failure",),
        ("perturbation=noise",),
    ],
    ids=lambda overrides: overrides[0],
)
def test_a_perturbed_episode_has_its_bits_too(perturbation):
    one = recorded(*WALL, *perturbation)
    assert one.tip_force.any() == ("disturbance" in perturbation[0])
    assert (one.action == 0).all(axis=(0, 2)).any() == ("failure" in perturbation[0])
    assert compare(one, replay(one, "numba"))["identical"]


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_an_episode_with_a_body_of_its_own_has_its_bits_too(dtype, tmp_path):
    one = recorded(*WALL, "randomise=wide", f"dtype={dtype}")
    trajectory.save(one, tmp_path / "episode.npz")
    loaded = trajectory.load(tmp_path / "episode.npz")
    assert set(loaded.body) == set(FACTORS)
    assert loaded.body != recorded(*WALL, "randomise=moderate").body
    assert loaded.arm.density == loaded.body["density"] * 1000.0
    assert loaded.rod.density == 1000.0
    np.testing.assert_allclose(loaded.radius()[0], 0.05 * loaded.body["base_radius"], rtol=1e-5)
    assert one.contact.any()
    assert compare(one, replay(loaded, "numba"))["identical"]
    nominal = dataclasses.replace(loaded, info={key: value for key, value in loaded.info.items() if key != "body"})
    assert nominal.body == {}
    assert not compare(one, replay(nominal, "numba"))["identical"]
    if dtype == "float64":
        assert np.abs(replay(loaded, "pyelastica").position - one.position).max() < 1e-10


def test_a_diverged_episode_has_its_bits_too():
    one = recorded("task=basic", "task.max_dilatation=1.001")
    assert one.diverged
    assert np.array_equal(one.position[-1], one.position[-2])
    assert compare(one, replay(one, "numba"))["identical"]
    in_pyelastica = replay(one, "pyelastica")
    assert np.array_equal(in_pyelastica.position[-1], in_pyelastica.position[-2])


def test_an_episode_that_was_played_in_pyelastica_has_its_bits_there():
    one = recorded(*WALL, "backend=pyelastica", "perturbation=disturbance", horizon=20)
    assert one.info["backend"] == "pyelastica"
    assert one.contact.any()
    assert compare(one, replay(one, "pyelastica"))["identical"]
    assert not compare(one, replay(one, "numba"))["identical"]


def test_another_action_is_noticed():
    one = recorded(*WALL)
    action = one.action.copy()
    action[5, 0, 0] = np.nextafter(action[5, 0, 0], np.float32(0))
    result = compare(one, replay(dataclasses.replace(one, action=action), "numba"))
    assert not result["identical"]
    assert max(result["position"][:6]) == 0.0
    assert max(result["position"][6:]) > 0.0
    assert max(result["position"]) == result["largest"]["position"]


def test_another_wall_is_noticed():
    one = recorded(*WALL)
    moved = one.cylinders | {"start": one.cylinders["start"] + 0.05}
    assert compare(one, replay(dataclasses.replace(one, cylinders=moved), "numba"))["largest"]["position"] > 1e-3


@pytest.mark.parametrize("backend", ["torch", "pyelastica"])
def test_other_simulators_agree_to_rounding(backend):
    if backend == "pyelastica":
        pytest.importorskip("elastica")
    one = recorded(*WALL, "perturbation=disturbance", "perturbation.first_step=3", horizon=20)
    assert one.contact.any()
    assert one.tip_force.any()
    result = compare(one, replay(one, backend))
    # measured: 1e-14 and 1e-14; contact amplifies rounding
    assert result["largest"]["position"] < 1e-11
    assert result["largest"]["velocity"] < 1e-8
    assert result["replayed"]["final_distance"] == pytest.approx(result["recorded"]["final_distance"], abs=1e-11)


def test_pyelastica_agrees_on_a_success():
    pytest.importorskip("elastica")
    one = recorded("task=structured", "task.success_radius=0.35")
    assert one.success
    again = replay(one, "pyelastica", pruning=True)
    result = compare(one, again)
    assert result["recorded"]["reached"] == result["replayed"]["reached"] == one.steps
    assert again.missed is not None
    assert again.contact_force.shape == (one.steps,)


def test_without_pyelastica_one_line_says_how_to_get_it(monkeypatch):
    monkeypatch.delitem(sys.modules, "softgm_bench.rod.pyelastica_oracle", raising=False)
    monkeypatch.setitem(sys.modules, "elastica", None)
    with pytest.raises(UserError, match="needs PyElastica: pip install"):
        replay(recorded("task=basic"), "pyelastica")


def test_what_no_simulator_can_do_is_refused():
    one = recorded(*WALL)
    with pytest.raises(UserError, match="backend=gpu: choose one of numba, torch, pyelastica"):
        replay(one, "gpu")
    with pytest.raises(UserError, match="pruning=true"):
        replay(one, "numba", pruning=True)
    exact = one.config | {"rod": one.config["rod"] | {"contact_model": "exact"}}
    with pytest.raises(UserError, match=r"rod\.contact_model=exact"):
        replay(dataclasses.replace(one, config=exact), "pyelastica")
