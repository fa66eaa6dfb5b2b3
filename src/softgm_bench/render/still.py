"""Pictures of single moments, with a default camera and a line of text."""

import io
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from softgm_bench.episodes.trajectory import Trajectory
from softgm_bench.render.camera import direction, fit
from softgm_bench.render.raycast import render
from softgm_bench.render.scene import Stage

Picture = NDArray[np.uint8]

INK, PALE, DONE, FAILED = (74, 68, 72), (205, 196, 188), (56, 161, 105), (192, 71, 60)


@dataclass(frozen=True)
class PictureSettings:
    """Size, camera and additions of the pictures of an episode."""

    width: int = 960  # pixels
    height: int = 720  # pixels
    azimuth: float | None = None  # of the camera, degrees from +x towards +y; by default the task's
    elevation: float | None = None  # degrees above the horizon; by default the task's
    distance: float | None = None  # m, from the middle of the scene; by default the whole episode just fits
    attention: bool = False  # drawn as edges
    text: bool = False  # time and distance are written


class Studio:
    """Takes pictures of one episode with one camera."""

    def __init__(self, trajectory: Trajectory, settings: PictureSettings) -> None:
        """Prepare the scene and the camera."""
        view = direction(trajectory, settings.azimuth, settings.elevation)
        size = settings.width, settings.height
        self.trajectory = trajectory
        self.settings = settings
        self.stage = Stage(trajectory, settings.attention, view[0])
        self.camera = fit(self.stage.extent(), *view, *size, distance=settings.distance)

    def picture(self, step: float, speed: float = 1.0) -> Picture:
        """The moment ``step``, in control steps from 0 to T: ``(height, width, 3)``.

        ``speed`` is that of the video that the picture belongs to, for the text.
        """
        image = render(self.stage.draw(step), self.camera)
        return self._write_on(image, step, speed) if self.settings.text else image

    def _write_on(self, image: Picture, step: float, speed: float) -> Picture:
        trajectory, (height, width, _) = self.trajectory, image.shape
        canvas = Image.fromarray(image)
        draw = ImageDraw.Draw(canvas)
        unit = height / 720.0
        font = ImageFont.load_default(size=max(9.0, 17.0 * unit))
        margin, line, bar = 28.0 * unit, height - 28.0 * unit, height - 12.0 * unit
        distance = float(np.linalg.norm(self.stage.nodes(step)[:, -1] - trajectory.target))
        over = step >= trajectory.steps
        words = [
            f"{step * self.stage.control_dt:.2f} s",
            f"step {int(step)}",
            f"{100.0 * distance:.1f} cm to the target",
        ]
        if speed != 1.0:
            words.append(f"{speed:g}x" if speed > 1.0 else f"{1.0 / speed:.3g}x slower")
        x = margin
        for word in words:
            draw.text((x, line), word, fill=INK, font=font, anchor="ls")
            # with zeros for digits, so that the words beside do not move when a number changes
            widest = "".join("0" if letter.isdigit() else letter for letter in word)
            x += draw.textlength(widest, font=font) + margin
        colour = DONE if trajectory.success else FAILED
        if over:
            failure = "simulation diverged" if trajectory.diverged else "not reached"
            ending = "target reached" if trajectory.success else failure
            draw.text((width - margin, line), ending, fill=colour, font=font, anchor="rs")
        part = min(1.0, step / max(trajectory.steps, 1))
        thick = max(1, round(3.0 * unit))
        draw.line([(margin, bar), (width - margin, bar)], fill=PALE, width=thick)
        if part > 0.0:
            colour = DONE if over and trajectory.success else INK
            draw.line([(margin, bar), (margin + part * (width - 2.0 * margin), bar)], fill=colour, width=thick)
        return np.asarray(canvas)


def png(picture: Picture) -> bytes:
    """The content of a PNG file."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()
