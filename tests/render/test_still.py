import io

import numpy as np
import pytest
from arms import STEPS, bending_arm
from PIL import Image

from softgm_bench.render.camera import BESIDE_POSTS, BESIDE_THE_MOTION, direction
from softgm_bench.render.still import PictureSettings, Studio, png

SMALL = {"width": 160, "height": 120}


def at(studio, picture, place):
    x, y = studio.camera.project(np.asarray(place))[0].astype(int)
    return picture[y, x].astype(int)


def test_the_arm_is_where_its_nodes_are_projected_to_and_its_tip_turns_green():
    episode = bending_arm(posts=False)
    studio = Studio(episode, PictureSettings(**SMALL))
    for step in (0, 3):
        picture = studio.picture(float(step))
        for node in range(5, 55, 10):
            red, green, blue = at(studio, picture, episode.position[step, :, node])
            assert red > 1.25 * max(green, blue) or min(red, green) > 180  # skin, or a pale ring
        assert at(studio, picture, episode.position[step, :, -1]).min() > 150  # the pale tip
    red, green, blue = at(studio, studio.picture(float(STEPS)), episode.position[STEPS, :, -1])
    assert green > 1.2 * red
    assert green > 1.2 * blue


def test_the_same_moment_gives_the_same_file():
    one, two = (png(Studio(bending_arm(), PictureSettings(**SMALL)).picture(2.5)) for _ in range(2))
    assert one == two
    with Image.open(io.BytesIO(one)) as image:
        assert (image.format, image.size, image.mode) == ("PNG", (160, 120), "RGB")


def test_text_stays_at_the_lower_border():
    episode = bending_arm()
    bare = Studio(episode, PictureSettings(**SMALL)).picture(3.0)
    written = Studio(episode, PictureSettings(**SMALL, text=True)).picture(3.0)
    rows = np.flatnonzero((bare != written).any(axis=(1, 2)))
    assert len(rows)
    assert rows.min() > 100


def test_the_camera_is_the_tasks_unless_it_is_chosen():
    assert direction(bending_arm()) == BESIDE_POSTS
    azimuth, elevation = direction(bending_arm(posts=False))  # the target is towards +x
    assert (azimuth, elevation) == pytest.approx(BESIDE_THE_MOTION)
    assert direction(bending_arm(), azimuth=10.0) == (10.0, BESIDE_POSTS[1])
    far = Studio(bending_arm(), PictureSettings(**SMALL, distance=20.0)).camera
    assert np.linalg.norm(far.position) > 15.0
