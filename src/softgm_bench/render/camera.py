"""A perspective camera, and one that shows given points as large as they fit."""

from dataclasses import dataclass
from math import atan2, cos, degrees, radians, sin, tan

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
FIELD_OF_VIEW = 28.0  # degrees, vertical: a long lens, so that near columns do not dwarf the arm
# Azimuth and elevation, degrees. From behind a wall: what comes through it comes towards the camera.
BEHIND_A_WALL = (-40.0, 20.0)
BESIDE_POSTS = (-62.0, 22.0)
BESIDE_THE_MOTION = (-65.0, 16.0)  # the first one from the target's direction
MANY = 8  # cylinders that make up a wall
NEAR = 0.05  # m in front of the camera, nothing nearer is looked at


def default_direction(n_cylinders: int, target: Array) -> tuple[float, float]:
    """Azimuth and elevation, degrees, from which a scene is looked at unless somebody says otherwise."""
    if n_cylinders:
        return BEHIND_A_WALL if n_cylinders >= MANY else BESIDE_POSTS
    azimuth, elevation = BESIDE_THE_MOTION
    return azimuth + degrees(atan2(target[1], target[0])), elevation


@dataclass(frozen=True)
class Camera:
    """Where the picture is taken from; +z is up.

    Attributes:
        position: m, ``(3,)``.
        basis: rows right, up, forward, ``(3, 3)``.
        focal: length in pixels.
        width: pixels.
        height: pixels.
    """

    position: Array
    basis: Array
    focal: float
    width: int
    height: int

    def project(self, points: Array) -> tuple[Array, Array]:
        """Of points ``(..., 3)`` pixel coordinates ``(..., 2)``, from the upper left corner, and the depths in m."""
        local = (points - self.position) @ self.basis.T
        depth = local[..., 2]
        scale = self.focal / np.maximum(depth, NEAR)
        x = 0.5 * self.width + scale * local[..., 0]
        y = 0.5 * self.height - scale * local[..., 1]
        return np.stack([x, y], axis=-1), depth


def look_at(centre: Array, azimuth: float, elevation: float, distance: float, width: int, height: int) -> Camera:
    """A camera that looks at ``centre`` from ``distance`` m away.

    Args:
        centre: m, ``(3,)``.
        azimuth: of the camera seen from the centre, degrees from +x towards +y.
        elevation: degrees above the horizon, below 90.
        distance: m.
        width: pixels.
        height: pixels.
    """
    a, e = radians(azimuth), radians(elevation)
    out = np.array([cos(e) * cos(a), cos(e) * sin(a), sin(e)])
    right = np.array([-sin(a), cos(a), 0.0])
    basis = np.stack([right, np.cross(out, right), -out])
    focal = 0.5 * height / tan(radians(0.5 * FIELD_OF_VIEW))
    return Camera(np.asarray(centre, dtype=np.float64) + distance * out, basis, focal, width, height)


def fit(
    points: Array,
    azimuth: float,
    elevation: float,
    width: int,
    height: int,
    margin: float = 0.06,
    distance: float | None = None,
) -> Camera:
    """The camera from a direction that shows all points, centred and as large as possible.

    Args:
        points: m, ``(n, 3)``.
        azimuth: as in ``look_at``.
        elevation: as in ``look_at``.
        width: pixels.
        height: pixels.
        margin: part of width and height that stays free at each border.
        distance: m, instead of the smallest from which everything fits.
    """
    centre = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = float(np.linalg.norm(points - centre, axis=1).max()) + NEAR
    far = distance or 1e3 * reach
    for _ in range(3):  # where the centre of the image lies in space depends on the distance, and the other way round
        if distance is None:
            far = _smallest_distance(points, centre, azimuth, elevation, width, height, margin, reach)
        camera = look_at(centre, azimuth, elevation, far, width, height)
        pixel, _ = camera.project(points)
        offset = 0.5 * (pixel.min(axis=0) + pixel.max(axis=0)) - [0.5 * width, 0.5 * height]
        centre = centre + far / camera.focal * (offset[0] * camera.basis[0] - offset[1] * camera.basis[1])
    if distance is None:
        far = _smallest_distance(points, centre, azimuth, elevation, width, height, margin, reach)
    return look_at(centre, azimuth, elevation, far, width, height)


def _smallest_distance(
    points: Array, centre: Array, azimuth: float, elevation: float, width: int, height: int, margin: float, reach: float
) -> float:
    """By bisection: the further, the smaller everything is."""
    low, high = 0.0, 200.0 * reach
    border = margin * np.array([width, height])
    for _ in range(40):
        middle = 0.5 * (low + high)
        pixel, depth = look_at(centre, azimuth, elevation, middle, width, height).project(points)
        fits = (depth > NEAR).all() and (pixel >= border).all() and (pixel <= [width, height] - border).all()
        low, high = (low, middle) if fits else (middle, high)
    return high
