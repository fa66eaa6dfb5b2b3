"""Light on one point: a key light with soft shadows, a fill light, the studio's ambient light; compiled functions."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from softgm_bench.render.geometry import jit, nearest_on_axis, normal_at
from softgm_bench.render.grid import Grid, cell_of

# What a round cone belongs to. Pieces of the arm overlap, cylinders stand side by side: their shadows are joined
# accordingly. A mark (the target, attention) is seen through what hides it.
ARM, CYLINDER, OTHER, MARK = 0, 1, 2, 3

PENUMBRA = 0.07  # tangent of the key light's angular radius
OCCLUSION_REACH = 0.3  # m, further things do not dim the ambient light
KEY, FILL = 1.15, 0.2
AMBIENT = 0.62


class Drawing(NamedTuple):
    """A picture's content for compiled functions: P round cones that are seen, Q that take light from others."""

    cone: NDArray[np.float64]  # centre and radius of both spheres, m, (P, 8)
    owner: NDArray[np.int64]  # ARM, CYLINDER, OTHER or MARK, (P,)
    row: NDArray[np.int64]  # of the texture, (P,)
    span: NDArray[np.float64]  # texture coordinates, 0 to 1, of both ends, (P, 2)
    shine: NDArray[np.float64]  # emission and gloss, each 0 to 1, (P, 2)
    texture: NDArray[np.float64]  # linear red, green, blue and opacity along each thing, (rows, W, 4)
    blocker: NDArray[np.float64]  # as cone, (Q, 8)
    blocker_owner: NDArray[np.int64]  # as owner, (Q,)
    blocker_strength: NDArray[np.float64]  # part of the light that it takes, (Q,)
    in_light: NDArray[np.float64]  # both centres in the light's frame: across, across, towards the light, (Q, 6)
    light: NDArray[np.float64]  # rows of the light's frame, the last one towards the light, (3, 3)
    fill: NDArray[np.float64]  # direction towards the fill light, (3,)
    shadow_grid: Grid  # boxes in the plane across the light
    near_grid: Grid  # boxes in space, enlarged by OCCLUSION_REACH
    floor: float  # height, m


@jit
def smooth(x):
    """0 below 0, 1 above 1, a smooth step between."""
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@jit
def texture_at(drawing, cone, y):
    """Colour and opacity of a round cone, y along its axis, linear between texels."""
    width = drawing.texture.shape[1]
    u = drawing.span[cone, 0] + y * (drawing.span[cone, 1] - drawing.span[cone, 0])
    place = min(max(u * width - 0.5, 0.0), width - 1.000001)
    i = int(place)
    f = place - i
    texture, row, j = drawing.texture, drawing.row[cone], min(i + 1, width - 1)
    return (
        texture[row, i, 0] + f * (texture[row, j, 0] - texture[row, i, 0]),
        texture[row, i, 1] + f * (texture[row, j, 1] - texture[row, i, 1]),
        texture[row, i, 2] + f * (texture[row, j, 2] - texture[row, i, 2]),
        texture[row, i, 3] + f * (texture[row, j, 3] - texture[row, i, 3]),
    )


@jit
def lit_part(drawing, px, py, pz):
    """The part of the key light that reaches a point, 0 to 1.

    Seen from the point the light is a disc. A round cone that passes at some distance from the middle of the disc hides
    a part of it that grows smoothly with depth and width, so there is no noise.
    """
    light = drawing.light
    u = light[0, 0] * px + light[0, 1] * py + light[0, 2] * pz
    v = light[1, 0] * px + light[1, 1] * py + light[1, 2] * pz
    depth = light[2, 0] * px + light[2, 1] * py + light[2, 2] * pz
    cell = cell_of(drawing.shadow_grid, u, v, 0.0)
    if cell < 0:
        return 1.0
    of_arm, of_cylinders, rest = 0.0, 0.0, 1.0
    for k in range(drawing.shadow_grid.first[cell], drawing.shadow_grid.first[cell + 1]):
        n = drawing.shadow_grid.items[k]
        a = drawing.in_light
        eu, ev = a[n, 3] - a[n, 0], a[n, 4] - a[n, 1]
        square = eu * eu + ev * ev
        y = 0.0
        if square > 1e-12:
            y = min(max(((u - a[n, 0]) * eu + (v - a[n, 1]) * ev) / square, 0.0), 1.0)
        away = a[n, 2] + y * (a[n, 5] - a[n, 2]) - depth
        if away <= 0.0:
            continue
        radius = drawing.blocker[n, 3] + y * (drawing.blocker[n, 7] - drawing.blocker[n, 3])
        gu, gv = u - a[n, 0] - y * eu, v - a[n, 1] - y * ev
        distance = sqrt(gu * gu + gv * gv)
        width = PENUMBRA * away + 1e-4
        if distance >= radius + width:
            continue
        hidden = 1.0 - smooth(0.5 + 0.5 * (distance - radius) / width)
        hidden *= min(1.0, radius / width) * smooth(away / radius) * drawing.blocker_strength[n]
        if drawing.blocker_owner[n] == ARM:
            of_arm = max(of_arm, hidden)
        elif drawing.blocker_owner[n] == CYLINDER:
            of_cylinders += hidden
        else:
            rest *= 1.0 - hidden
    return (1.0 - of_arm) * max(0.0, 1.0 - of_cylinders) * rest


@jit
def open_part(drawing, px, py, pz, nx, ny, nz):
    """The part of the ambient light, 0 to 1, that arm and cylinders leave to a point p with unit normal n."""
    cell = cell_of(drawing.near_grid, px, py, pz)
    if cell < 0:
        return 1.0
    of_arm, of_cylinders = 0.0, 0.0
    for k in range(drawing.near_grid.first[cell], drawing.near_grid.first[cell + 1]):
        n = drawing.near_grid.items[k]
        cone = drawing.blocker
        y = nearest_on_axis(px, py, pz, cone, n)
        gx = cone[n, 0] + y * (cone[n, 4] - cone[n, 0]) - px
        gy = cone[n, 1] + y * (cone[n, 5] - cone[n, 1]) - py
        gz = cone[n, 2] + y * (cone[n, 6] - cone[n, 2]) - pz
        distance = sqrt(gx * gx + gy * gy + gz * gz)
        cosine = (gx * nx + gy * ny + gz * nz) / max(distance, 1e-9)
        if distance > OCCLUSION_REACH or cosine <= 0.0:
            continue
        radius = cone[n, 3] + y * (cone[n, 7] - cone[n, 3])
        part = min(1.0, radius / max(distance, 1e-9))
        fade = 1.0 - smooth(distance / OCCLUSION_REACH)
        taken = cosine * part * part * fade * drawing.blocker_strength[n]
        if drawing.blocker_owner[n] == CYLINDER:
            of_cylinders += 0.7 * taken
        else:
            of_arm = max(of_arm, taken)
    return (1.0 - 0.9 * of_arm) * max(0.25, 1.0 - of_cylinders)


@jit
def shade(drawing, n, y, px, py, pz, dx, dy, dz):
    """Linear colour and opacity of a point on round cone n, seen along the unit direction d."""
    own_red, own_green, own_blue, opacity = texture_at(drawing, n, y)
    nx, ny, nz = normal_at(px, py, pz, drawing.cone, n, y)
    facing = max(0.05, -(nx * dx + ny * dy + nz * dz))
    glass = opacity < 0.5  # too faint for the shadows on it to be seen
    if opacity < 0.995:  # as a thin skin: more of it lies in the way of a slanting look
        opacity = 1.0 - (1.0 - opacity) ** min(1.0 / facing, 4.0)
    glow, gloss = drawing.shine[n, 0], drawing.shine[n, 1]
    light = drawing.light[2]
    towards = nx * light[0] + ny * light[1] + nz * light[2]
    key = 0.0
    if towards > 0.0:
        key = towards if glass else towards * lit_part(drawing, px + 1e-3 * nx, py + 1e-3 * ny, pz + 1e-3 * nz)
    fill = max(0.0, nx * drawing.fill[0] + ny * drawing.fill[1] + nz * drawing.fill[2])
    around = 1.0 if glass else open_part(drawing, px, py, pz, nx, ny, nz)
    up = 0.5 + 0.5 * nz
    bounce = 0.62 + 0.38 * up
    diffuse = KEY * key + FILL * fill * around
    hx, hy, hz = light[0] - dx, light[1] - dy, light[2] - dz
    scale = 1.0 / sqrt(hx * hx + hy * hy + hz * hz + 1e-12)
    half = max(0.0, (nx * hx + ny * hy + nz * hz) * scale)
    sheen = gloss * (0.30 * half**24 * min(1.0, key * 2.0) + 0.16 * (1.0 - facing) ** 3 * around)
    ambient = AMBIENT * around * bounce
    # the floor is warm, the sky above a little cooler
    red = own_red * (diffuse * 1.03 + ambient * (1.03 - 0.05 * up)) + sheen
    green = own_green * (diffuse + ambient) + sheen
    blue = own_blue * (diffuse * 0.95 + ambient * (0.94 + 0.08 * up)) + sheen
    return (
        red + glow * (own_red - red),
        green + glow * (own_green - green),
        blue + glow * (own_blue - blue),
        opacity,
    )
