import numpy as np
import pytest
from arms import bending_arm

from softgm_bench.render import raycast
from softgm_bench.render.camera import look_at
from softgm_bench.render.scene import Parts, Stage, round_cone
from softgm_bench.render.shading import MARK, OTHER

RED, BLUE = np.array([0.6, 0.05, 0.05]), np.array([0.05, 0.05, 0.6])
CAMERA = look_at(np.zeros(3), 0.0, 0.0, 3.0, 96, 64)


def draw(*spheres, camera=CAMERA):
    """Spheres (centre, radius, colour, opacity, owner) above a floor that is out of sight."""
    stage = Stage(bending_arm())
    parts = Parts()
    for centre, radius, colour, opacity, owner in spheres:
        parts.add(round_cone(centre, radius, centre, radius), parts.paint(colour, opacity), owner)
    parts.block(round_cone(np.full(3, 50.0), 0.1, np.full(3, 50.0), 0.1))
    drawing = parts.drawing(stage.light, stage.floor, stage.base_length)
    return raycast.render(drawing._replace(floor=-100.0), camera).astype(int)


def reddish(image):
    return image[..., 0] > image[..., 2] + 60


def bluish(image):
    return image[..., 2] > image[..., 0] + 60


def test_a_sphere_covers_its_disc():
    image = draw(((0, 0, 0), 0.3, RED, 1.0, OTHER))
    radius = CAMERA.focal * 0.3 / np.sqrt(3.0**2 - 0.3**2)
    assert reddish(image).sum() == pytest.approx(np.pi * radius**2, rel=0.04)
    assert reddish(image)[32, 48]
    assert not reddish(image)[2, 2]


def test_the_nearer_sphere_hides_the_further_one():
    near, far = ((1, 0, 0), 0.2, RED, 1.0, OTHER), ((-1, 0, 0), 0.2, BLUE, 1.0, OTHER)
    for order in ((near, far), (far, near)):
        image = draw(*order)
        assert reddish(image)[32, 48]
        assert not bluish(image).any()


def test_glass_shows_what_is_behind_it_and_not_what_is_hidden_from_it():
    glass = ((1, 0, 0), 0.3, BLUE, 0.3, OTHER)
    behind = draw(glass, ((0, 0, 0), 0.2, RED, 1.0, OTHER))[32, 48]
    alone = draw(((0, 0, 0), 0.2, RED, 1.0, OTHER))[32, 48]
    assert alone[2] < behind[2]
    assert behind[0] > behind[2]
    np.testing.assert_array_equal(
        draw(((-1, 0, 0), 0.1, BLUE, 0.3, OTHER), ((0, 0, 0), 0.2, RED, 1.0, OTHER))[32, 48], alone
    )


def test_a_mark_is_seen_through_what_hides_it_but_fainter():
    mark, front = ((-1, 0, 0), 0.1, BLUE, 1.0, MARK), ((0, 0, 0), 0.2, RED, 1.0, OTHER)
    free, through, without = (draw(*s)[32, 48] for s in ((mark,), (mark, front), (front,)))
    assert without[2] < through[2] < free[2]


def test_tiles_leave_nothing_out(monkeypatch):
    rng = np.random.default_rng(0)
    spheres = [(rng.uniform(-0.5, 0.5, 3), rng.uniform(0.02, 0.2), rng.uniform(0, 1, 3), 1.0, OTHER) for _ in range(30)]
    in_tiles = draw(*spheres)
    monkeypatch.setattr(raycast, "TILE", 1000.0)
    np.testing.assert_array_equal(draw(*spheres), in_tiles)


def test_an_edge_is_between_its_two_colours():
    image = draw(((0, 0, 0), 0.3, RED, 1.0, OTHER))
    row = image[32, :, 1]
    inside, outside = row[48], row[2]
    partly = (row > inside + 0.2 * (outside - inside)) & (row < inside + 0.8 * (outside - inside))
    assert 1 <= partly.sum() <= 4


def test_a_sphere_at_the_lens_is_not_lost():
    camera = look_at(np.zeros(3), 0.0, 0.0, 0.35, 96, 64)
    assert reddish(draw(((0, 0, 0), 0.3, RED, 1.0, OTHER), camera=camera))[20:44, 36:60].all()


def test_srgb_is_the_standards():
    linear = np.array([[[0.0, 0.0031308, 0.214041]], [[0.5, 1.0, 7.0]]])
    np.testing.assert_allclose(raycast._to_srgb(linear), [[[0, 10, 127]], [[188, 255, 255]]], atol=1)
