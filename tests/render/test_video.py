import io

import numpy as np
import pytest
from arms import STEPS, bending_arm
from PIL import Image

from softgm_bench.render.still import PictureSettings, Studio
from softgm_bench.render.video import LONGEST, animated, moments, mp4, natural_speed, pictures

av = pytest.importorskip("av")


@pytest.fixture(scope="module")
def frames():
    studio = Studio(bending_arm(), PictureSettings(width=80, height=60, text=True))
    return list(pictures(studio, np.array([0.0, 2.0, 4.0, 6.0, 6.0]), 1.0, threads=2))


@pytest.mark.parametrize("duration", [0.04, 0.64, 3.0, 9.9, 10.0, 10.1, 80.0])
def test_the_natural_speed_is_the_slowest_power_of_two_that_is_short_enough(duration):
    speed = natural_speed(duration)
    assert np.log2(speed) == round(np.log2(speed))
    assert duration / speed <= LONGEST < duration / (0.5 * speed)


def test_frames_follow_the_clock_and_the_last_one_stays():
    times = moments(steps=100, control_dt=0.04, fps=25, speed=2.0)
    np.testing.assert_allclose(times[:51], 2.0 * np.arange(51))
    np.testing.assert_array_equal(times[51:], np.full(25, 100.0))
    slow = moments(steps=STEPS, control_dt=0.04, fps=30, speed=0.25)
    np.testing.assert_allclose(np.diff(slow[:28]), 0.25 / (30 * 0.04))
    assert slow.max() == STEPS


def test_an_mp4_has_the_frames_in_order_with_their_size_and_rate(frames):
    content = mp4(iter(frames), 20)
    with av.open(io.BytesIO(content)) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert stream.average_rate == 20
        decoded = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
    assert len(decoded) == len(frames)
    for found, drawn in zip(decoded, frames, strict=True):
        assert found.shape == (60, 80, 3)
        distance = [np.abs(found.astype(int) - other.astype(int)).mean() for other in frames[:4]]
        assert min(distance) < 6.0
        assert np.array_equal(frames[int(np.argmin(distance))], drawn)
    assert content.index(b"moov") < content.index(b"mdat")


@pytest.mark.parametrize("kind", ["webp", "gif"])
def test_an_animated_picture_has_the_frames_and_repeats(frames, kind):
    with Image.open(io.BytesIO(animated(iter(frames[:4]), 20, kind))) as image:
        assert (image.format, image.size, image.n_frames) == (kind.upper(), (80, 60), 4)
        assert image.info["loop"] == 0


def test_threads_and_company_change_no_pixel(frames):
    studio = Studio(bending_arm(), PictureSettings(width=80, height=60, text=True))
    np.testing.assert_array_equal(frames[2], studio.picture(4.0))
    np.testing.assert_array_equal(frames[4], frames[3])
    (alone,) = pictures(studio, np.array([2.0]), 1.0, threads=1)
    np.testing.assert_array_equal(alone, frames[1])
