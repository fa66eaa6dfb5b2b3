"""A perspective camera, and one that shows given points as large as they fit."""

from math import atan2, cos, degrees, radians, sin, tan
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softgm_bench.episodes.trajectory import Trajectory

Array = NDArray[np.float64]
FIELD_OF_VIEW = 28.0  # degrees, vertical: a long lens, so that near columns do not dwarf the arm
# Azimuth and elevation, degrees. From behind a wall: what comes through it comes towards the camera.
BEHIND_A_WALL = (-40.0, 20.0)
BESIDE_POSTS = (-62.0, 22.0)
BESIDE_THE_MOTION = (-65.0, 16.0)  # the first one from the target's direction
MANY = 8  # cylinders that make up a wall
MARGIN = 0.06  # part of width and height that stays free at each border
NEAR = 0.05  # m in front of the camera, nothing nearer is drawn
CORNERS = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])  # of a box about 0


def direction(
    trajectory: Trajectory, azimuth: float | None = None, elevation: float | None = None
) -> tuple[float, float]:
    """Azimuth and elevation of the camera, degrees: the chosen ones, or those that suit the task."""
    obstacles = len(trajectory.cylinders["length"])
    default = BEHIND_A_WALL if obstacles >= MANY else BESIDE_POSTS
    if not obstacles:
        x, y, _ = trajectory.target
        default = BESIDE_THE_MOTION[0] + degrees(atan2(y, x)), BESIDE_THE_MOTION[1]
    return default[0] if azimuth is None else azimuth, default[1] if elevation is None else elevation


class Camera(NamedTuple):
    """The place from which a picture is taken, and its size; +z is up."""

    position: Array  # m, (3,)
    basis: Array  # rows right, up, forward, (3, 3)
    focal: float  # length in pixels
    width: int  # pixels
    height: int  # pixels

    def project(self, points: Array) -> tuple[Array, Array]:
        """Pixel coordinates ``(..., 2)``, from the upper left corner, and depths, m, of points ``(..., 3)``."""
        local = (points - self.position) @ self.basis.T
        depth = local[..., 2]
        scale = self.focal / np.maximum(depth, NEAR)
        x = 0.5 * self.width + scale * local[..., 0]
        y = 0.5 * self.height - scale * local[..., 1]
        return np.stack([x, y], axis=-1), depth


def look_at(centre: Array, azimuth: float, elevation: float, distance: float, width: int, height: int) -> Camera:
    """A camera that looks at ``centre`` (m, ``(3,)``) from ``distance`` m away.

    Seen from the centre it is ``azimuth`` degrees from +x towards +y and ``elevation``, below 90, above the horizon.
    """
    a, e = radians(azimuth), radians(elevation)
    out = np.array([cos(e) * cos(a), cos(e) * sin(a), sin(e)])
    right = np.array([-sin(a), cos(a), 0.0])
    basis = np.stack([right, np.cross(out, right), -out])
    focal = 0.5 * height / tan(radians(0.5 * FIELD_OF_VIEW))
    return Camera(np.asarray(centre, dtype=np.float64) + distance * out, basis, focal, width, height)


def fit(
    points: Array, azimuth: float, elevation: float, width: int, height: int, *, distance: float | None = None
) -> Camera:
    """The camera from a direction that shows all points (m, ``(n, 3)``), centred and as large as possible.

    A part ``MARGIN`` of width and height stays free at each border; ``distance``, m, is kept where it is given.
    """
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = float(np.linalg.norm(points - centre, axis=1).max()) + NEAR
    border = MARGIN * np.array([width, height])

    def nearest() -> float:  # by bisection: the further, the smaller everything is
        low, high = 0.0, 200.0 * reach
        for _ in range(40):
            middle = 0.5 * (low + high)
            pixel, depth = look_at(centre, azimuth, elevation, middle, width, height).project(points)
            fits = (depth > NEAR).all() and (pixel >= border).all() and (pixel <= [width, height] - border).all()
            low, high = (low, middle) if fits else (middle, high)
        return high

    for _ in range(3):  # where the centre of the image lies in space depends on the distance, and the other way round
        far = distance or nearest()
        camera = look_at(centre, azimuth, elevation, far, width, height)
        pixel, _ = camera.project(points)
        offset = 0.5 * (pixel.min(axis=0) + pixel.max(axis=0)) - [0.5 * width, 0.5 * height]
        centre = centre + far / camera.focal * (offset[0] * camera.basis[0] - offset[1] * camera.basis[1])
    return look_at(centre, azimuth, elevation, distance or nearest(), width, height)
