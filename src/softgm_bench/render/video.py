"""Moving pictures of an episode: MP4 (H.264 by PyAV, which brings its encoder), animated WebP and GIF (Pillow)."""

import io
import os
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from softgm_bench.render.still import Picture, Studio

LONGEST = 10.0  # s, of a video whose speed nobody chose
HOLD = 1.0  # s, the last moment stays
QUALITY = 19  # constant rate factor of x264: lower is better
BT709 = 1  # as numbered by H.264: primaries, transfer and matrix
NARROW = 1  # range of the numbers: 16 to 235


def natural_speed(duration: float) -> float:
    """The slowest power of two at which ``duration`` seconds of simulation last at most ``LONGEST``."""
    return float(2.0 ** np.ceil(np.log2(max(duration, 1e-3) / LONGEST)))


def moments(steps: int, control_dt: float, fps: int, speed: float) -> NDArray[np.float64]:
    """The frames' times in control steps: from 0 to ``steps``, then the last moment for ``HOLD`` seconds."""
    frames = int(np.floor(steps * control_dt * fps / speed + 1e-9))
    moving = np.arange(frames + 1) * (speed / (fps * control_dt))
    return np.concatenate([np.minimum(moving, steps), np.full(round(HOLD * fps), float(steps))])


def pictures(studio: Studio, times: NDArray[np.float64], speed: float, threads: int | None = None) -> Iterator[Picture]:
    """Frames in order, drawn side by side by ``threads`` threads; a moment that is repeated is drawn once."""
    distinct, which = np.unique(times, return_inverse=True)
    count = threads or len(os.sched_getaffinity(0))
    with ThreadPoolExecutor(count) as pool:
        drawn = pool.map(lambda step: studio.picture(float(step), speed), distinct)
        current, last = -1, None
        for index in which:
            while current < index:
                last, current = next(drawn), current + 1
            assert last is not None
            yield last


def mp4(frames: Iterator[Picture], fps: int) -> bytes:
    """The content of an MP4 file that browsers play: H.264, 4:2:0, even width and height, index in front."""
    import av
    from av.video.reformatter import ColorRange, Colorspace

    with tempfile.TemporaryDirectory() as folder:  # the index is moved to the front by reading the file again
        path = Path(folder) / "video.mp4"
        with av.open(path, "w", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("libx264", rate=fps, options={"crf": str(QUALITY), "preset": "medium"})
            stream.pix_fmt = "yuv420p"
            context = stream.codec_context
            context.color_primaries = context.color_trc = context.colorspace = BT709
            context.color_range = NARROW
            for number, frame in enumerate(frames):
                if not number:
                    stream.height, stream.width = frame.shape[:2]
                image = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24").reformat(
                    format="yuv420p", dst_colorspace=Colorspace.ITU709, dst_color_range=ColorRange.MPEG
                )
                image.pts, image.time_base = number, Fraction(1, fps)
                container.mux(stream.encode(image))
            container.mux(stream.encode(None))
        return path.read_bytes()


def animated(frames: Iterator[Picture], fps: int, kind: str) -> bytes:
    """The content of an animated picture that repeats for ever; ``kind``: ``webp`` or ``gif``."""
    from PIL import Image

    first, *others = (Image.fromarray(frame) for frame in frames)
    buffer = io.BytesIO()
    options = {"quality": 80, "method": 4} if kind == "webp" else {}
    first.save(buffer, kind.upper(), save_all=True, append_images=others, duration=round(1000 / fps), loop=0, **options)
    return buffer.getvalue()
