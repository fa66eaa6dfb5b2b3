"""From round cones to an image: one ray a pixel, more where neighbouring pixels differ; compiled functions."""

import numpy as np
from numpy.typing import NDArray

from softgm_bench.render.camera import CORNERS, NEAR, Camera
from softgm_bench.render.geometry import MISS, hit_round_cone, jit
from softgm_bench.render.grid import cell_of, make_grid
from softgm_bench.render.shading import MARK, Drawing, lit_part, open_part, shade, texture_at

TILE = 8.0  # pixels
LAYERS = 24  # translucent surfaces in front of one another; more are left out
BACKDROP = (0.905, 0.88, 0.84)  # linear
HIDDEN = 0.6  # part of its opacity that a mark keeps behind what hides it
CONTRAST = 0.02  # difference of neighbouring pixels, square root of linear, from which both are looked at again
MIDDLE = np.full((1, 2), 0.5)  # place of the first ray in a pixel
# Places of the further rays in a pixel: no two in one row or column.
ROOKS = np.array([[0, 2], [1, 4], [2, 0], [3, 5], [4, 1], [5, 3]]) / 6.0 + 1.0 / 12.0


def render(drawing: Drawing, camera: Camera) -> NDArray[np.uint8]:
    """An sRGB image ``(height, width, 3)``, always the same; the camera is outside of all round cones."""
    low, high = _on_screen(drawing.cone, camera)
    tiles = make_grid(low, high, TILE, ([0.0, 0.0, 0.0], [camera.width - 1.0, camera.height - 1.0, 0.0]))
    image = np.empty((camera.height, camera.width, 3))
    _draw(drawing, camera, tiles, np.ones(image.shape[:2], dtype=bool), MIDDLE, image)
    _draw(drawing, camera, tiles, _edges(image), ROOKS, image)
    return _to_srgb(image)


def _on_screen(cone: NDArray[np.float64], camera: Camera) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Boxes in pixels, ``(P, 3)`` each, of the third coordinate 0, around the round cones' pictures.

    The hull of two spheres is inside of the hull of two boxes around them, whose corners are projected.
    """
    offset = CORNERS @ camera.basis  # boxes along the camera's axes
    ends = cone.reshape(-1, 2, 4)
    points = ends[:, :, None, :3] + ends[:, :, None, 3:] * offset
    pixel, depth = camera.project(points.reshape(len(cone), 16, 3))
    low, high = np.zeros((len(cone), 3)), np.zeros((len(cone), 3))
    low[:, :2], high[:, :2] = pixel.min(axis=1) - 1.0, pixel.max(axis=1) + 1.0
    behind = (depth <= NEAR).any(axis=1)  # its picture is not bounded by its corners'
    low[behind, :2], high[behind, :2] = 0.0, [camera.width, camera.height]
    return low, high


def _to_srgb(image: NDArray[np.float64]) -> NDArray[np.uint8]:
    return _SRGB[(np.clip(image, 0.0, 1.0) * (len(_SRGB) - 1) + 0.5).astype(np.uint16)]


_LINEAR = np.linspace(0.0, 1.0, 1 << 14)
_ENCODED = np.where(_LINEAR <= 0.0031308, 12.92 * _LINEAR, 1.055 * _LINEAR ** (1.0 / 2.4) - 0.055)
_SRGB = (255.0 * _ENCODED + 0.5).astype(np.uint8)


@jit
def _draw(drawing, camera, tiles, chosen, places, image):
    """Set chosen pixels of a linear image ``(height, width, 3)`` to the mean of rays at places from 0 to 1 in them."""
    depth = np.empty(LAYERS)
    layer = np.empty(LAYERS, np.int64)
    place = np.empty(LAYERS)
    rays = len(places)
    for j in range(camera.height):
        for i in range(camera.width):
            if not chosen[j, i]:
                continue
            red, green, blue = 0.0, 0.0, 0.0
            for k in range(rays):
                r, g, b = _colour_at(drawing, camera, tiles, i + places[k, 0], j + places[k, 1], depth, layer, place)
                red, green, blue = red + min(r, 1.0), green + min(g, 1.0), blue + min(b, 1.0)
            image[j, i, 0], image[j, i, 1], image[j, i, 2] = red / rays, green / rays, blue / rays


def _edges(image: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels that differ from a neighbour, ``(height, width)``."""
    root, edge = np.sqrt(np.maximum(image, 0.0)), np.zeros(image.shape[:2], dtype=bool)
    below = (np.abs(np.diff(root, axis=0)) > CONTRAST).any(axis=-1)
    beside = (np.abs(np.diff(root, axis=1)) > CONTRAST).any(axis=-1)
    for part, differs in ((edge[1:], below), (edge[:-1], below), (edge[:, 1:], beside), (edge[:, :-1], beside)):
        part |= differs
    return edge


@jit
def _colour_at(drawing, camera, tiles, x, y, depth, layer, place):
    """Linear colour at pixel coordinates (x, y); depth, layer and place are room for translucent surfaces."""
    across = (x - 0.5 * camera.width) / camera.focal
    upward = (0.5 * camera.height - y) / camera.focal
    basis = camera.basis
    dx = across * basis[0, 0] + upward * basis[1, 0] + basis[2, 0]
    dy = across * basis[0, 1] + upward * basis[1, 1] + basis[2, 1]
    dz = across * basis[0, 2] + upward * basis[1, 2] + basis[2, 2]
    scale = 1.0 / np.sqrt(dx * dx + dy * dy + dz * dz)
    dx, dy, dz = dx * scale, dy * scale, dz * scale
    ox, oy, oz = camera.position[0], camera.position[1], camera.position[2]

    nearest, solid, solid_place, count = MISS, -1, 0.0, 0
    cell = cell_of(tiles, x, y, 0.0)
    for k in range(tiles.first[cell], tiles.first[cell + 1]):
        n = tiles.items[k]
        t, along = hit_round_cone(ox, oy, oz, dx, dy, dz, drawing.cone, n)
        if t >= nearest and drawing.owner[n] != MARK:
            continue
        if drawing.owner[n] != MARK and texture_at(drawing, n, along)[3] >= 0.995:
            nearest, solid, solid_place = t, n, along
        elif t < MISS and count < LAYERS:
            m = count
            while m > 0 and depth[m - 1] < t:  # furthest first
                depth[m], layer[m], place[m] = depth[m - 1], layer[m - 1], place[m - 1]
                m -= 1
            depth[m], layer[m], place[m] = t, n, along
            count += 1

    down = (drawing.floor - oz) / dz if dz < 0.0 and oz > drawing.floor else MISS
    red, green, blue = _backdrop(x / camera.width, y / camera.height)
    if solid >= 0 and nearest < down:
        red, green, blue, _ = shade(
            drawing, solid, solid_place, ox + nearest * dx, oy + nearest * dy, oz + nearest * dz, dx, dy, dz
        )
    else:
        nearest = down
        if down < MISS:
            taken = _floor(drawing, ox + down * dx, oy + down * dy)
            red, green, blue = red * (1.0 - 0.92 * taken), green * (1.0 - taken), blue * (1.0 - taken)
    for m in range(count):
        t = depth[m]
        if t < nearest or drawing.owner[layer[m]] == MARK:
            r, g, b, opacity = shade(drawing, layer[m], place[m], ox + t * dx, oy + t * dy, oz + t * dz, dx, dy, dz)
            if t >= nearest:
                opacity *= HIDDEN
            red, green, blue = red + opacity * (r - red), green + opacity * (g - green), blue + opacity * (b - blue)
    return red, green, blue


@jit
def _backdrop(x, y):
    """Linear colour of the studio behind everything, darker towards the corners; x and y from 0 to 1."""
    corner = (x - 0.5) ** 2 + (y - 0.5) ** 2
    light = 1.04 - 0.30 * corner
    return BACKDROP[0] * light, BACKDROP[1] * light, BACKDROP[2] * light


@jit
def _floor(drawing, px, py):
    """The part of the floor's light that shadows take, 0 to 1; there is nothing else to see of the floor."""
    lit = lit_part(drawing, px, py, drawing.floor)
    around = open_part(drawing, px, py, drawing.floor, 0.0, 0.0, 1.0)
    return 1.0 - (0.62 + 0.38 * lit) * (0.45 + 0.55 * around)
