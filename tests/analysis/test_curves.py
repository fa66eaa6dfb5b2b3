from types import SimpleNamespace

import numpy as np

from softgm_bench.analysis.figures import curve


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


def test_there_is_no_curve_of_what_was_not_recorded():
    assert curve([run([1, 2], [0.0, 1.0])], "episode_length") is None
    assert curve([run([1, 2], [0.0, None])], "success_rate") is None
    assert curve([run([], [])], "success_rate") is None
    assert curve([run([1, 2], [0, 1]), run([3, 4], [0, 1])], "success_rate") is None
    assert curve([], "success_rate") is None
