from types import SimpleNamespace

import numpy as np
import scipy.stats
from matplotlib.figure import Figure

from softgm_bench.analysis.figures import curve, draw_curve


def run(frames, values):
    return SimpleNamespace(
        progress=[{"frames": at, "success_rate": {"mean": value}} for at, value in zip(frames, values, strict=True)]
    )


def test_seeds_at_the_same_frames_keep_them():
    frames, seeds = curve([run([10, 20], [0.0, 1.0]), run([10, 20], [0.5, 0.5])], "success_rate")
    np.testing.assert_array_equal(frames, [10, 20])
    np.testing.assert_array_equal(seeds, [[0.0, 1.0], [0.5, 0.5]])


def test_seeds_at_other_frames_are_interpolated_where_all_have_values():
    frames, seeds = curve([run([0, 10, 20], [0.0, 1.0, 2.0]), run([5, 15], [0.0, 1.0])], "success_rate")
    np.testing.assert_array_equal(frames, [5, 10, 15])
    np.testing.assert_allclose(seeds, [[0.5, 1.0, 1.5], [0.0, 0.5, 1.0]])


def test_the_band_of_several_seeds_is_scipys_standard_error_about_their_mean():
    frames, seeds = np.array([1.0, 2.0, 3.0]), np.random.default_rng(4).random((5, 3))
    axes = Figure().subplots()
    draw_curve(axes, (frames, seeds), "softgm")

    (band,) = axes.collections
    outline = band.get_paths()[0].vertices
    error = scipy.stats.sem(seeds, axis=0)
    for at, low, high in zip(frames, seeds.mean(0) - error, seeds.mean(0) + error, strict=True):
        heights = outline[outline[:, 0] == at, 1]
        np.testing.assert_allclose([heights.min(), heights.max()], [low, high])


def test_one_seed_has_no_band():
    axes = Figure().subplots()
    draw_curve(axes, (np.array([1.0, 2.0]), np.array([[0.0, 1.0]])), "softgm")

    assert not axes.collections
    assert len(axes.lines) == 1


def test_there_is_no_curve_of_what_was_not_recorded():
    assert curve([run([1, 2], [0.0, 1.0])], "episode_length") is None
    assert curve([run([1, 2], [0.0, None])], "success_rate") is None
    assert curve([run([], [])], "success_rate") is None
    assert curve([run([1, 2], [0, 1]), run([3, 4], [0, 1])], "success_rate") is None
    assert curve([], "success_rate") is None
