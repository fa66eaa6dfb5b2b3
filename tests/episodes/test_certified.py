"""Scenes with actions that are known to succeed in them."""

import dataclasses

import numpy as np
import pytest
import torch

from softgm_bench.assembly import configure
from softgm_bench.certification import Bench, Search
from softgm_bench.certification.bench import way_left
from softgm_bench.certification.search import run
from softgm_bench.episodes import certified
from softgm_bench.errors import UserError
from softgm_bench.rod.randomise import RandomiseConfig

FILES = sorted(certified.FOLDER.glob("*.npz"))
SAMPLE = 20  # scenes of each file that are replayed in the quick tests


def config(task):
    return configure([f"task={task}", "recipe=paper"])


def replayed(path, rows):
    known = certified.load(path)
    return certified.replay(known, config(known.task), rows)


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_committed_sequences_succeed(path):
    rows = np.flatnonzero(certified.load(path).length)
    chosen = rows[np.linspace(0, len(rows) - 1, SAMPLE).astype(int)]
    assert replayed(path, chosen).all()


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_all_committed_sequences_succeed(path):
    assert replayed(path, np.flatnonzero(certified.load(path).length)).all()


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_committed_files_are_of_the_tasks_as_they_are(path):
    known = certified.load(path)
    mask = certified.mask(config(path.stem), known.scenes, known.seed, None, None)
    np.testing.assert_array_equal(mask, known.length > 0)
    assert known.task == path.stem


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_committed_sequences_succeed_in_pyelastica_whose_evaluations_count_them_too(path):
    known, theirs = certified.load(path), dataclasses.replace(config(path.stem), backend="pyelastica")
    short = np.flatnonzero(known.length)[np.argsort(known.length[known.length > 0], kind="stable")][:3]
    assert certified.replay(known, theirs, short).all()
    mask = certified.mask(theirs, known.scenes, known.seed, None, None)
    np.testing.assert_array_equal(mask, known.length > 0)


def test_other_actions_do_not_succeed():
    path = FILES[0]
    known = certified.load(path)
    rows = np.flatnonzero(known.length)[:SAMPLE]
    wrong = dataclasses.replace(known, action=np.zeros_like(known.action))
    assert not certified.replay(wrong, config(known.task), rows).any()


def test_no_scene_is_certified_where_the_physics_are_others():
    settings = config("wall")
    assert certified.mask(settings, 500, 0, None, None) is not None
    assert certified.mask(settings, 500, 1, None, None) is None
    assert certified.mask(config("basic"), 500, 0, None, None) is None
    task = dataclasses.replace(settings.task, success_radius=0.04)
    assert certified.mask(dataclasses.replace(settings, task=task), 500, 0, None, None) is None
    drawn = dataclasses.replace(settings, randomise=RandomiseConfig("x", density=(0.9, 1.1)))
    assert certified.mask(drawn, 500, 0, None, None) is None


def test_a_horizon_that_is_too_short_certifies_less():
    known, settings = certified.of_task("wall"), config("wall")
    mask = certified.mask(settings, 500, 0, None, 20)
    assert 0 < mask.sum() == ((known.length > 0) & (known.length <= 20)).sum() < (known.length > 0).sum()


def test_actions_are_kept_to_half_a_level():
    action = 2.0 * torch.rand(100, 6, 2) - 1.0
    kept = certified.dequantised(certified.quantised(action))
    assert (kept - action).abs().max() <= 0.5 / certified.LEVELS + 1e-6
    assert torch.equal(certified.quantised(kept), certified.quantised(action))


@pytest.fixture(scope="module")
def easy():
    """``basic`` with large targets, which a search certifies in moments."""
    return configure(["task=basic", "recipe=paper", "task.success_radius=0.3", "rod.n_elements=20"])


def searched(settings, known=None):
    benches = [Bench(settings, 12, 3, dtype, at_once=16) for dtype in ("float32", "float64")]
    search = Search(*benches, steps=40)
    if known is not None:
        search.take(known)
    return search


def test_a_search_finds_what_succeeds_and_what_it_finds_is_replayed(easy, tmp_path):
    search = searched(easy)
    rounds = []
    run(search, lambda: len(rounds) >= 12, 4, lambda: rounds.append(int((search.length > 0).sum())))
    assert rounds == sorted(rounds)
    assert rounds[-1] >= 6
    known = search.found("basic", 3)
    certified.save(known, tmp_path / "basic.npz")
    again = certified.load(tmp_path / "basic.npz")
    rows = np.flatnonzero(again.length)
    assert certified.replay(again, easy, rows).all()
    # a search goes on from it
    resumed = searched(easy, again)
    np.testing.assert_array_equal(resumed.length > 0, again.length > 0)
    np.testing.assert_array_equal(resumed.tried, again.tried)


def test_scenes_are_those_of_an_evaluation(easy):
    env = certified.first_frame(easy, 12, certified.evaluation_seed(3))
    target, _ = certified.scenes(easy, 12, 3)
    np.testing.assert_array_equal(env.scene.target.float().numpy(), target)


def test_the_way_left_leads_through_the_opening():
    privileged = torch.tensor([[0.4, 0.0, 0.5, 0.3]]).expand(3, 4)
    target = torch.tensor([[0.6, 0.0, 0.5]]).expand(3, 3)
    tip = torch.tensor([[0.3, 0.0, 0.5], [0.45, 0.0, 0.5], [0.4, 0.3, 0.5]])
    assert torch.allclose(way_left(tip, target, privileged), torch.tensor([0.3, 0.15, 0.5]))
    turned = torch.tensor([[0.4, 0.0, 0.5, 0.3, torch.pi / 2]])  # faces +y
    assert torch.allclose(way_left(tip[2:], target[2:], turned), (target[2:] - tip[2:]).norm(dim=-1))
    assert torch.allclose(way_left(tip, target, privileged[:, :0]), (target - tip).norm(dim=-1))


def test_a_file_that_is_none_is_refused(tmp_path):
    (tmp_path / "wall.npz").write_text("no archive")
    for path in (tmp_path / "wall.npz", tmp_path / "gone.npz"):
        with pytest.raises(UserError, match="no file of certified scenes"):
            certified.load(path)
