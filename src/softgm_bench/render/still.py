"""Pictures of single moments, with a default camera and a line of text."""

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from softgm_bench.episodes.trajectory import Trajectory
from softgm_bench.render.camera import default_direction, fit
from softgm_bench.render.raycast import render
from softgm_bench.render.scene import Stage

Picture = NDArray[np.uint8]

INK, PALE, DONE = (74, 68, 72), (205, 196, 188), (56, 161, 105)


@dataclass(frozen=True)
class Look:
    """How to look at an episode.

    Attributes:
        width: pixels.
        height: pixels.
        azimuth: of the camera, degrees from +x towards +y; by default the task's.
        elevation: degrees above the horizon; by default the task's.
        distance: m, from the middle of the scene; by default the smallest from which all of the episode is in view.
        attention: whether attention is drawn as edges.
        text: whether time and distance are written.
    """

    width: int = 960
    height: int = 720
    azimuth: float | None = None
    elevation: float | None = None
    distance: float | None = None
    attention: bool = False
    text: bool = False


def direction(trajectory: Trajectory, look: Look) -> tuple[float, float]:
    """Azimuth and elevation of the camera, degrees."""
    azimuth, elevation = default_direction(len(trajectory.cylinders["length"]), trajectory.target)
    return (
        azimuth if look.azimuth is None else look.azimuth,
        elevation if look.elevation is None else look.elevation,
    )


class Studio:
    """Takes pictures of one episode with one camera."""

    def __init__(self, trajectory: Trajectory, look: Look) -> None:
        """Prepare the scene and the camera."""
        azimuth, elevation = direction(trajectory, look)
        self.trajectory = trajectory
        self.look = look
        self.stage = Stage(trajectory, look.attention, azimuth)
        self.camera = fit(self.stage.extent(), azimuth, elevation, look.width, look.height, distance=look.distance)

    def picture(self, step: float, speed: float = 1.0) -> Picture:
        """The moment ``step``, in control steps from 0 to T: ``(height, width, 3)``.

        ``speed`` is that of the video that the picture belongs to, for the text.
        """
        image = render(self.stage.draw(step), self.camera)
        return self._write_on(image, step, speed) if self.look.text else image

    def _write_on(self, image: Picture, step: float, speed: float) -> Picture:
        trajectory, (width, height) = self.trajectory, (self.look.width, self.look.height)
        canvas = Image.fromarray(image)
        draw = ImageDraw.Draw(canvas)
        unit = height / 720.0
        font = ImageFont.load_default(size=max(9.0, 17.0 * unit))
        margin, line = 28.0 * unit, height - 28.0 * unit
        steps = trajectory.steps
        distance = float(np.linalg.norm(self.stage.nodes(step)[:, -1] - trajectory.target))
        over = step >= steps
        words = (
            f"{step * self.stage.control_dt:.2f} s",
            f"step {int(step)}",
            f"{100.0 * distance:.1f} cm to the target",
            *([_speed(speed)] if speed != 1.0 else []),
        )
        x = margin
        for word in words:
            draw.text((x, line), word, fill=INK, font=font, anchor="ls")
            x += draw.textlength(_widest(word), font=font) + margin
        if over:
            ending, colour = _ending(trajectory)
            draw.text((width - margin, line), ending, fill=colour, font=font, anchor="rs")
        bar = height - 12.0 * unit
        part = min(1.0, step / max(steps, 1))
        thick = max(1, round(3.0 * unit))
        draw.line([(margin, bar), (width - margin, bar)], fill=PALE, width=thick)
        if part > 0.0:
            colour = DONE if over and trajectory.success else INK
            draw.line([(margin, bar), (margin + part * (width - 2.0 * margin), bar)], fill=colour, width=thick)
        return np.asarray(canvas)


def png(picture: Picture) -> bytes:
    """The file's content."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def _widest(word: str) -> str:
    """With zeros for digits, so that the words beside do not move when a number changes."""
    return "".join("0" if letter.isdigit() else letter for letter in word)


def _speed(speed: float) -> str:
    return f"{speed:g}x" if speed > 1.0 else f"{1.0 / speed:.3g}x slower"


def _ending(trajectory: Trajectory) -> tuple[str, tuple[int, int, int]]:
    if trajectory.success:
        return "target reached", DONE
    return ("simulation diverged" if trajectory.diverged else "not reached"), (192, 71, 60)
