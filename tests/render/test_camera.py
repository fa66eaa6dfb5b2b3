import numpy as np
import pytest

from softgm_bench.render.camera import MARGIN, fit, look_at

CENTRE = np.array([0.3, -0.2, 0.5])


def test_the_centre_is_in_the_middle_up_is_up_and_the_basis_is_a_rotation():
    camera = look_at(CENTRE, 35.0, 20.0, 3.0, 320, 240)
    pixel, depth = camera.project(np.stack([CENTRE, CENTRE + np.array([0.0, 0.0, 0.1])]))
    np.testing.assert_allclose(pixel[0], [160.0, 120.0], atol=1e-9)
    assert depth[0] == pytest.approx(3.0)
    assert pixel[1, 0] == pytest.approx(160.0)
    assert pixel[1, 1] < 120.0
    np.testing.assert_allclose(camera.basis @ camera.basis.T, np.eye(3), atol=1e-12)


def test_from_minus_y_plus_x_is_on_the_right():
    camera = look_at(np.zeros(3), -90.0, 0.0, 3.0, 320, 240)
    np.testing.assert_allclose(camera.position, [0.0, -3.0, 0.0], atol=1e-12)
    assert camera.project(np.array([0.1, 0.0, 0.0]))[0][0] > 160.0


@pytest.mark.parametrize("size", [(320, 240), (120, 400)])
def test_everything_fits_touches_a_margin_and_is_centred(size):
    points = np.random.default_rng(1).uniform(-1.0, 1.0, (50, 3)) * [0.5, 1.0, 2.0]
    pixel, _ = fit(points, 40.0, 15.0, *size).project(points)
    part = pixel / size
    low, high = part.min(axis=0), part.max(axis=0)
    assert low.min() >= MARGIN - 1e-9
    assert high.max() <= 1.0 - MARGIN + 1e-9
    assert min(low.min(), 1.0 - high.max()) == pytest.approx(MARGIN, abs=5e-3)
    np.testing.assert_allclose(low + high, 1.0, atol=0.02)


def test_a_chosen_distance_is_kept():
    points = np.array([[-0.1, 0.0, 0.0], [0.1, 0.0, 0.0]])
    camera = fit(points, 90.0, 0.0, 320, 240, distance=7.0)
    np.testing.assert_allclose(np.linalg.norm(camera.position), 7.0, rtol=1e-6)
