from functools import partial

import numpy as np
import pytest
import scipy.stats

from softgm_bench.analysis import statistics
from softgm_bench.analysis.statistics import Bootstrap

# rliable draws from numpy's global generator; 4000 resamples leave about 0.005 of noise on a bound.
RESAMPLES = 4000
TOLERANCE = 0.015


@pytest.fixture
def scores():
    generator = np.random.default_rng(0)
    return {name: generator.beta(2.0 + k, 2.0, size=(6, 3)) for k, name in enumerate("xy")}


@pytest.fixture(scope="module")
def rliable():
    from rliable import library, metrics  # brings pandas and seaborn along

    np.random.seed(0)  # noqa: NPY002
    return library, metrics


def tasks(matrix):
    """Scores by task from rliable's (runs, tasks)."""
    return list(matrix.T)


def test_the_interquartile_mean_is_scipys_trimmed_mean():
    generator = np.random.default_rng(1)
    for count in range(1, 30):
        values = generator.normal(size=count)
        assert statistics.iqm([values]) == pytest.approx(scipy.stats.trim_mean(values, 0.25), rel=1e-12)


def test_the_interquartile_mean_ignores_outliers_on_both_sides():
    assert statistics.iqm([np.array([-1e9, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 1e9])]) == 3.5


def test_improvement_is_the_mann_whitney_statistic_over_its_largest_value():
    generator = np.random.default_rng(2)
    ours, theirs = generator.integers(0, 4, 7) / 4, generator.integers(0, 4, 5) / 4  # with ties
    expected = scipy.stats.mannwhitneyu(ours, theirs).statistic / (7 * 5)
    assert statistics.probability_of_improvement([ours], [theirs]) == pytest.approx(expected, rel=1e-12)


def test_improvement_by_hand():
    ours, theirs = np.array([1.0, 3.0]), np.array([1.0, 2.0])
    assert statistics.probability_of_improvement([ours], [theirs]) == (0.5 + 0.0 + 1.0 + 1.0) / 4


def test_of_two_algorithms_one_improves_or_the_other():
    generator = np.random.default_rng(3)
    ours, theirs = [generator.random(4), generator.random(3)], [generator.random(5), generator.random(2)]
    there = statistics.probability_of_improvement(ours, theirs)
    assert there + statistics.probability_of_improvement(theirs, ours) == pytest.approx(1.0)


def test_a_profile_by_hand():
    share = statistics.performance_profile([np.array([0.2, 0.5, 0.5, 1.0])], np.array([0.0, 0.2, 0.4, 0.5, 1.0]))
    np.testing.assert_allclose(share, [1.0, 0.75, 0.75, 0.25, 0.0])


def test_resampling_stays_within_a_task():
    scores = [np.array([1.0, 2.0]), np.array([3.0, 3.0])]
    drawn = []
    Bootstrap(50, 0).interval("", lambda tasks: drawn.extend(tasks) or statistics.mean(tasks), scores)
    assert drawn[0].shape == (50, 2)
    assert set(drawn[0].ravel()) == {1.0, 2.0}
    assert set(drawn[1].ravel()) == {3.0}


def test_a_single_run_on_a_task_gives_no_interval():
    assert Bootstrap(50, 0).interval("", statistics.mean, [np.array([1.0, 2.0]), np.array([3.0])]) is None


def test_the_interval_of_a_mean_is_scipys_bootstrap():
    values = np.random.default_rng(5).random(8)
    expected = scipy.stats.bootstrap(
        (values,), np.mean, n_resamples=RESAMPLES, method="percentile", rng=np.random.default_rng(0)
    ).confidence_interval
    interval = Bootstrap(RESAMPLES, 1).interval("", statistics.mean, [values])
    np.testing.assert_allclose(interval, expected, atol=TOLERANCE)


def test_the_interval_of_the_interquartile_mean_is_rliables(scores, rliable):
    library, metrics = rliable
    _, expected = library.get_interval_estimates(
        scores, lambda matrix: np.array([metrics.aggregate_iqm(matrix)]), reps=RESAMPLES
    )
    for name, matrix in scores.items():
        assert statistics.iqm(tasks(matrix)) == pytest.approx(metrics.aggregate_iqm(matrix))
        interval = Bootstrap(RESAMPLES, 0).interval("", statistics.iqm, tasks(matrix))
        np.testing.assert_allclose(interval, expected[name][:, 0], atol=TOLERANCE)


def test_the_interval_of_the_mean_over_tasks_is_rliables(scores, rliable):
    library, metrics = rliable
    _, expected = library.get_interval_estimates(
        scores, lambda matrix: np.array([metrics.aggregate_mean(matrix)]), reps=RESAMPLES
    )
    for name, matrix in scores.items():
        interval = Bootstrap(RESAMPLES, 0).interval("", statistics.mean, tasks(matrix))
        np.testing.assert_allclose(interval, expected[name][:, 0], atol=TOLERANCE)


def test_improvement_and_its_interval_are_rliables(scores, rliable):
    library, metrics = rliable
    x, y = scores["x"], scores["y"]
    point, expected = library.get_interval_estimates(
        {"x,y": (x, y)}, lambda a, b: np.array([metrics.probability_of_improvement(a, b)]), reps=500
    )
    assert statistics.probability_of_improvement(tasks(x), tasks(y)) == pytest.approx(point["x,y"][0])
    interval = Bootstrap(RESAMPLES, 0).interval("", statistics.probability_of_improvement, tasks(x), tasks(y))
    np.testing.assert_allclose(interval, expected["x,y"][:, 0], atol=0.04)  # 500 resamples


def test_profiles_and_their_intervals_are_rliables(scores, rliable):
    library, _ = rliable
    thresholds = np.linspace(0.1, 0.9, 5)
    profile = partial(statistics.performance_profile, thresholds=thresholds)
    points, expected = library.create_performance_profile(scores, thresholds, reps=RESAMPLES)
    for name, matrix in scores.items():
        np.testing.assert_allclose(profile(tasks(matrix)), points[name])
        interval = Bootstrap(RESAMPLES, 0).interval("", profile, tasks(matrix))
        step = 1 / matrix.size  # a profile's values are multiples of it
        np.testing.assert_allclose(interval, expected[name], atol=1.01 * step)


def test_the_bootstrap_repeats_for_a_seed_and_changes_with_it():
    values = [np.random.default_rng(6).random(7)]
    first, again, other = (Bootstrap(500, seed).interval("", statistics.iqm, values) for seed in (0, 0, 1))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


@pytest.mark.parametrize(
    ("lost", "won", "p"), [(0, 0, 1.0), (5, 5, 1.0), (1, 0, 1.0), (6, 0, 2 / 2**6), (1, 8, 20 / 2**9)]
)
def test_mcnemars_exact_p_is_the_binomials_two_tails(lost, won, p):
    """Worked by hand: 2 (C(9, 0) + C(9, 1)) / 2^9 for one against eight."""
    first = np.array([1.0] * lost + [0.0] * won + [1.0, 0.0, 1.0])
    second = np.array([0.0] * lost + [1.0] * won + [1.0, 0.0, 1.0])
    assert statistics.mcnemar(first, second) == (lost, won, pytest.approx(p))
