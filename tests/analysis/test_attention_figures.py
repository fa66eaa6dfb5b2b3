"""What the attention figures show, read back from their axes."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "episodes"))
from recorded import SEEN, watched

from softgm_bench.analysis import attention

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def episode():
    return watched(*SEEN)


def meshes(canvas):
    """Axes of the matrices, without the colour bar's."""
    return [axes for axes in canvas.axes if axes.get_title(loc="left")]


@pytest.mark.parametrize("overrides", [SEEN, ("task=basic",)], ids=["wall", "basic"])
def test_cells_that_are_left_pale_have_weight_zero_and_rows_sum_to_one(overrides):
    one = watched(*overrides)
    for stage, weights in one.attention.items():
        for step in range(one.steps):
            allowed = attention._allowed(one, step, stage)
            assert not weights[step][..., ~allowed].any()
            assert np.allclose(weights[step].sum(axis=-1), 1.0, atol=1e-6)


def test_every_layer_and_head_is_drawn(episode):
    layers, heads = episode.attention["stage1"].shape[1:3]
    for separately, count in ((False, layers), (True, layers * heads)):
        titles = [axes.get_title(loc="left") for axes in meshes(attention.draw_step(episode, 3, separately))]
        assert len(titles) == 2 * count
        assert titles[-1] == (f"layer {layers - 1}, head {heads - 1}" if separately else f"layer {layers - 1}")


def test_a_matrix_shows_the_weights_of_agents_and_bins(episode):
    step, n = 5, episode.n_agents
    columns = attention.columns_at(episode, step)
    canvas = attention.draw_step(episode, step)
    first = meshes(canvas)[0].collections[0].get_array()
    shown = np.concatenate([np.arange(n), n + columns.slots])
    expected = episode.attention["stage1"][step, 0].mean(axis=0)[:, shown]
    drawn = ~np.ma.getmaskarray(first)
    assert np.array_equal(first.data[drawn], expected[drawn])
    assert drawn[:, :n].sum() == n  # of agents, stage 1 hears only itself
    assert drawn[:, n:].sum() == episode.observation["agents/edge"][step].sum()
    labels = [label.get_text() for label in meshes(canvas)[-2].get_xticklabels()]
    assert labels == [f"agent {i}" for i in range(n)] + columns.labels


def test_bins_are_labelled_by_slot_and_place(episode):
    columns = attention.columns_at(episode, 0)
    assert len(columns.slots)
    for slot, label in zip(columns.slots, columns.labels, strict=True):
        _, y, z = episode.observation["slots/descriptor"][0, slot, :3]
        assert label == f"bin {slot} ({y:.2f}, {z:.2f})".replace("-0.00", "0.00")


def test_too_many_bins_leave_those_with_an_edge(episode, monkeypatch):
    monkeypatch.setattr(attention, "MOST_BINS", 1)
    columns = attention.columns_at(episode, 10)
    assert columns.discovered == episode.observation["slots/active"][10].sum()
    assert np.array_equal(columns.slots, np.flatnonzero(episode.observation["agents/edge"][10].any(axis=0)))


def test_the_busiest_step_of_each_quarter_is_chosen(episode):
    edges = episode.observation["agents/edge"][:-1].sum(axis=(1, 2))
    chosen = attention.busiest_steps(episode)
    assert len(chosen) == 4
    for step, part in zip(chosen, np.array_split(np.arange(episode.steps), 4), strict=True):
        assert step in part
        assert edges[step] == edges[part].max()


def test_the_overview_has_a_strip_of_every_kind(episode):
    with_obstacles = [axes.get_title(loc="left") for axes in meshes(attention.draw_overview(episode))]
    assert [title.partition(":")[0] for title in with_obstacles[1:]] == ["stage 1"] * 2 + ["stage 2"] * 3
    without = [axes.get_title(loc="left") for axes in meshes(attention.draw_overview(watched("task=basic")))]
    assert [title.partition(":")[0] for title in without[1:]] == ["stage 2"] * 3


def test_strips_of_an_agent_add_up_to_one(episode):
    to_obstacles, _, own, before, after = (strip.values for strip in attention._strips(episode))
    assert np.allclose(np.nansum([own, before, after], axis=0), 1.0, atol=1e-6)
    n = episode.n_agents
    own_share = np.diagonal(episode.attention["stage1"].mean(axis=(1, 2))[:, :, :n], 0, 1, 2).T
    assert np.allclose(np.nan_to_num(to_obstacles) + own_share, 1.0, atol=1e-6)


@pytest.mark.parametrize("model", ["softgm_no_stage1", "softgm_no_stage2"])
def test_an_ablation_draws_the_stage_that_it_has(model):
    one = watched(*SEEN, f"model={model}", horizon=4)
    assert set(one.attention) == {"stage2" if model.endswith("1") else "stage1"}
    assert len(meshes(attention.draw_step(one, 1))) == 2
    assert attention.draw_overview(one).axes


@pytest.mark.parametrize("heads", [False, True])
def test_labels_stay_inside_the_picture(episode, heads):
    for step in (2, 20):
        canvas = attention.draw_step(episode, step, heads)
        boxes = [axes.get_tightbbox() for axes in canvas.axes]
        boxes += [text.get_window_extent(dpi=canvas.dpi) for text in canvas.texts]
        for box in boxes:
            assert 0 <= box.x0 < box.x1 <= canvas.bbox.width
            assert 0 <= box.y0 < box.y1 <= canvas.bbox.height


def test_a_picture_has_the_same_bytes_again(episode):
    first, second = (attention.png(attention.draw_step(episode, 2)) for _ in range(2))
    assert first == second
