"""The scene at one moment of an episode, as round cones."""

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from softgm_bench.episodes.trajectory import PATH, Trajectory
from softgm_bench.render import style
from softgm_bench.render.camera import CORNERS, MANY
from softgm_bench.render.grid import make_grid
from softgm_bench.render.shading import ARM, CYLINDER, MARK, OCCLUSION_REACH, OTHER, PENUMBRA, Drawing

Array = NDArray[np.float64]
Pair = tuple[float, float]

SEEN_THROUGH = 0.34  # opacity of walls
FRESH = 0.3  # s during which a discovered bin is shown as new
TRACE = 240  # pieces of the tip's path
FAINT = 0.005  # attention below this is not drawn
STRONG = 0.25  # attention from which on an edge is opaque
LIGHT = (-0.35, -0.62, 1.0)  # towards the key light, in the camera's right, away and up: from the upper left, before it
_PLACE = (np.arange(style.TEXELS) + 0.5) / style.TEXELS  # along a texture


def round_cone(start: Array, start_radius: float, end: Array, end_radius: float) -> Array:
    """The hull of two spheres as a row ``(8,)``: centre and radius of one, then of the other, m."""
    return np.array([*start, start_radius, *end, end_radius], dtype=np.float64)


class Parts:
    """Round cones by the piece: ``seen`` and ``blocking`` hold a drawing's columns row by row."""

    def __init__(self) -> None:
        """Begin with nothing."""
        self.seen: list[tuple] = []
        self.blocking: list[tuple] = []
        self.texture: list[Array] = []

    def paint(self, colour: Array, opacity: Array | float = 1.0) -> int:
        """Add a texture of one colour ``(3,)`` or of ``(TEXELS, 3)`` and return its row."""
        texture = np.empty((style.TEXELS, 4))
        texture[:, :3], texture[:, 3] = colour, opacity
        self.texture.append(texture)
        return len(self.texture) - 1

    def add(self, cone: Array, row: int, owner: int = OTHER, span: Pair = (0.0, 1.0), shine: Pair = (0.0, 0.3)) -> None:
        """Add a round cone that is seen; arguments as the fields of ``Drawing``."""
        self.seen.append((cone, owner, row, span, shine))

    def block(self, cone: Array, owner: int = OTHER, part: float = 1.0) -> None:
        """Add a round cone that takes a part of the light from others."""
        self.blocking.append((cone, owner, part))

    def drawing(self, light: Array, floor: float, below: float) -> Drawing:
        """Everything that was added, sorted into grids; ``light`` and ``floor`` as in ``Drawing``.

        Shadows reach ``below`` m below the floor.
        """
        cone, owner, row, span, shine = (np.array(column) for column in zip(*self.seen, strict=True))
        blocker, blocker_owner, strength = (np.array(column) for column in zip(*self.blocking, strict=True))
        ends = blocker.reshape(-1, 2, 4)
        centre, radius = ends[..., :3], ends[..., 3:]
        low, high = (centre - radius).min(axis=1), (centre + radius).max(axis=1)
        near_grid = make_grid(low - OCCLUSION_REACH, high + OCCLUSION_REACH, 0.1)
        in_light = np.concatenate([blocker[:, 0:3] @ light.T, blocker[:, 4:7] @ light.T], axis=1)
        # the penumbra is widest on the floor, or on what is below it in the picture
        away = np.maximum(in_light[:, 2], in_light[:, 5]) - floor * light[2, 2] + below
        wide = (ends[..., 3].max(axis=1) + PENUMBRA * np.maximum(away, 0.0))[:, None] * [1.0, 1.0, 0.0]
        flat = in_light.reshape(-1, 2, 3) * [1.0, 1.0, 0.0]
        shadow_grid = make_grid(flat.min(axis=1) - wide, flat.max(axis=1) + wide, 0.04)
        fill = np.array([-light[2, 0], -light[2, 1], 0.6 * light[2, 2]])
        fill /= np.linalg.norm(fill)
        seen = cone, owner, row, span, shine, np.stack(self.texture)
        return Drawing(*seen, blocker, blocker_owner, strength, in_light, light, fill, shadow_grid, near_grid, floor)


class Stage:
    """Everything about an episode that does not change from moment to moment."""

    def __init__(self, trajectory: Trajectory, attention: bool = False, camera_azimuth: float = 0.0) -> None:
        """Prepare an episode: ``attention``, where it has any, is drawn as edges.

        The light comes from the left of a camera at ``camera_azimuth`` degrees.
        """
        self.trajectory = trajectory
        self.attention = attention and "stage1" in trajectory.attention
        rod, task = trajectory.config["rod"], trajectory.config["task"]
        self.control_dt = rod["dt"] * rod["substeps"]
        self.success_radius: float = task["success_radius"]
        self.bin_length: float = task["bin_length"]
        self.base_length: float = rod["base_length"]
        self.position = trajectory.position.astype(np.float64)
        self.radius = trajectory.radius()
        cylinders = trajectory.cylinders
        self.edges = cylinders["length"][:, None] * cylinders["axis"]  # from a cylinder's start to its end, m, (C, 3)
        path = cylinders.get(PATH)  # of cylinders that move, the corners of the box in which their starts stay
        self._starts = [cylinders["start"]] if path is None else [path.min(axis=0), path.max(axis=0)]
        self.wall = len(self.edges) >= MANY
        self.first_seen = _first_seen(trajectory, self.bin_length)
        lowest = [-0.2 * self.base_length, (self.position[:, 2] - trajectory.arm.base_radius).min() - 0.02]
        feet = [z for start in self._starts for z in (*start[:, 2], *(start + self.edges)[:, 2])]
        self.floor = float(min([*lowest, *feet]))
        self.light = _light_frame(camera_azimuth)

    def extent(self) -> Array:
        """Points, m, ``(n, 3)``, that a picture of the whole episode has to show."""
        nodes = self.position[:, :, ::6].transpose(0, 2, 1).reshape(-1, 3)
        radius = self.trajectory.cylinders["radius"][:, None, None] * CORNERS
        ends = np.stack([at[:, None] + radius for start in self._starts for at in (start, start + self.edges)], axis=1)
        arm = nodes[:, None] + 0.05 * self.base_length * CORNERS
        target = self.trajectory.target + self.success_radius * CORNERS
        return np.concatenate([[[0.0, 0.0, self.floor]], target, arm.reshape(-1, 3), ends.reshape(-1, 3)])

    def draw(self, step: float) -> Drawing:
        """The scene at a time in control steps from 0 to T; between two steps, the arm is in between."""
        step = min(max(step, 0.0), float(self.trajectory.steps))
        parts = Parts()
        self._arm(parts, step)
        self._cylinders(parts, step)
        self._target(parts, step)
        self._trace(parts, step)
        if self.attention:
            self._attention(parts, step)
        return parts.drawing(self.light, self.floor, self.base_length)

    def nodes(self, step: float) -> Array:
        """Positions at a time in control steps, ``(3, n_nodes)``: cubic between two states and their velocities."""
        k = min(int(step), self.trajectory.steps - 1) if self.trajectory.steps else 0
        f = step - k
        if f == 0.0:
            return self.position[k]
        p, q = self.position[k], self.position[k + 1]
        u, v = (self.control_dt * self.trajectory.velocity[i].astype(np.float64) for i in (k, k + 1))
        return (1 + 2 * f) * (1 - f) ** 2 * p + f * (1 - f) ** 2 * u + f * f * (3 - 2 * f) * q + f * f * (f - 1) * v

    def _arm(self, parts: Parts, step: float) -> None:
        nodes, element = self.nodes(step), self.radius[round(step)]
        radius = np.concatenate([element[:1], 0.5 * (element[1:] + element[:-1]), element[-1:]])
        n = len(element)
        fine, fine_radius = _between(nodes), _between(radius[None])[0]
        row = parts.paint(self._arm_colour(round(step)))
        for i, j in pairwise(range(2 * n + 1)):
            cone = round_cone(fine[:, i], fine_radius[i], fine[:, j], fine_radius[j])
            parts.add(cone, row, ARM, (0.5 * i / n, 0.5 * j / n), (0.0, 1.0))
        for i, j in pairwise(sorted({*range(0, n, 2), n})):  # fewer, since shadows are soft
            parts.block(round_cone(nodes[:, i], radius[i], nodes[:, j], radius[j]), ARM)
        foot, base = np.array([0.0, 0.0, self.floor]), radius[0]
        pedestal = round_cone(foot, 1.25 * base, np.array([0.0, 0.0, -0.6 * base]), 1.02 * base)
        parts.add(pedestal, parts.paint(style.linear(style.PEDESTAL)), shine=(0.0, 0.2))
        parts.block(pedestal)

    def _arm_colour(self, step: int) -> Array:
        trajectory = self.trajectory
        sections = trajectory.n_agents + 1
        stepped = (np.floor(_PLACE * sections) + 0.5) / sections
        colour = style.gradient(style.ARM, 0.5 * _PLACE + 0.5 * stepped)
        touch = np.interp(_PLACE, np.linspace(0.0, 1.0, trajectory.contact.shape[1]), trajectory.contact[step])
        colour = style.mix(colour, style.linear(style.TOUCH), 0.45 * touch)
        for agent in range(1, sections):
            distance = np.abs(_PLACE - agent / sections) * self.base_length
            ring = np.clip(1.5 - 2.0 * distance / style.RING_WIDTH, 0.0, 1.0)
            colour = style.mix(colour, style.linear(style.RING), 0.85 * ring)
        tip = np.clip((_PLACE - 1.0) * self.base_length / 0.004 + 2.0, 0.0, 1.0)
        return style.mix(colour, style.linear(style.REACHED if self._reached(step) else style.TIP), 0.9 * tip)

    def _reached(self, step: float) -> bool:
        return self.trajectory.success and step >= self.trajectory.steps

    def _cylinders(self, parts: Parts, step: float) -> None:
        cylinders, starts = self.trajectory.cylinders, self.trajectory.starts(step)
        for c, (start, end) in enumerate(zip(starts, starts + self.edges, strict=True)):
            known, colour = self._cylinder_colour(c, step)
            opacity = SEEN_THROUGH + (0.8 - SEEN_THROUGH) * known if self.wall else 1.0
            cone = round_cone(start, cylinders["radius"][c], end, cylinders["radius"][c])
            parts.add(cone, parts.paint(colour, opacity), CYLINDER, shine=(0.0, 0.4))
            parts.block(cone, CYLINDER, SEEN_THROUGH if self.wall else 1.0)

    def _cylinder_colour(self, c: int, step: float) -> tuple[Array, Array]:
        """A cylinder's discovered part, from 0 to 1, ``(TEXELS,)``, and its colour, ``(TEXELS, 3)``, by texel."""
        length, seen = float(self.trajectory.cylinders["length"][c]), self.first_seen[c]
        first = seen[np.minimum((_PLACE * length / self.bin_length).astype(int), len(seen) - 1)]
        known = (first <= step).astype(np.float64)
        age = (step - np.where(known > 0.0, first, 0.0)) * self.control_dt
        new = np.clip(1.0 - age / FRESH, 0.0, 1.0)
        colour = style.mix(style.linear(style.DISCOVERED), style.linear(style.NEW), new)
        joint = np.round(_PLACE * length / self.bin_length) * self.bin_length
        joint[(joint < 0.5 * self.bin_length) | (joint > length - 0.01 * self.bin_length)] = np.inf  # ends are none
        known = known * np.clip(np.abs(_PLACE * length - joint) / style.GAP - 0.3, 0.0, 1.0)
        return known, style.mix(style.linear(style.COLUMN), colour, known)

    def _target(self, parts: Parts, step: float) -> None:
        colour = style.linear(style.REACHED if self._reached(step) else style.TARGET)
        target, radius = self.trajectory.target, self.success_radius
        shell = round_cone(target, radius, target, radius)
        parts.add(shell, parts.paint(colour, 0.22), MARK, shine=(0.5, 0.6))
        parts.add(round_cone(target, 0.3 * radius, target, 0.3 * radius), parts.paint(colour), MARK, shine=(0.5, 0.5))
        parts.block(shell, part=0.5)

    def _trace(self, parts: Parts, step: float) -> None:
        whole = max(1, min(TRACE, int(np.ceil(6.0 * step))))
        points = [self.nodes(moment)[:, -1] for moment in np.linspace(0.0, step, whole + 1)]
        row = parts.paint(style.gradient(style.PATH, np.linspace(0.0, 1.0, style.TEXELS)))
        thin = 0.0028 * self.base_length
        for i, (start, end) in enumerate(pairwise(points)):
            cone = round_cone(start, thin, end, thin)
            parts.add(cone, row, span=(i / whole, (i + 1) / whole), shine=(0.35, 0.0))

    def _attention(self, parts: Parts, step: float) -> None:
        trajectory = self.trajectory
        k = min(round(step), trajectory.steps - 1)
        weight = trajectory.attention["stage1"][k].mean(axis=(0, 1))[:, trajectory.n_agents :]  # (N, M)
        centre = trajectory.observation["slots/descriptor"][k, :, :3].astype(np.float64)
        nodes = self.nodes(step)[:, trajectory.agent_nodes]
        for agent, slot in zip(*np.nonzero(weight > FAINT), strict=True):
            part = min(1.0, float(np.sqrt(weight[agent, slot] / STRONG)))
            row = parts.paint(style.linear(style.ATTENTION), 0.3 + 0.7 * part)
            thin = (0.004 + 0.008 * part) * self.base_length
            parts.add(round_cone(centre[slot], thin, nodes[:, agent], thin), row, MARK, shine=(0.7, 0.0))


def _between(values: Array) -> Array:
    """Values ``(k, n)`` at nodes and, cubic, at the middles between them: ``(k, 2 n - 1)``."""
    padded = np.concatenate([2 * values[:, :1] - values[:, 1:2], values, 2 * values[:, -1:] - values[:, -2:-1]], axis=1)
    middle = (9.0 * (padded[:, 1:-2] + padded[:, 2:-1]) - padded[:, :-3] - padded[:, 3:]) / 16.0
    fine = np.empty((values.shape[0], 2 * values.shape[1] - 1))
    fine[:, ::2], fine[:, 1::2] = values, middle
    return fine


def _light_frame(camera_azimuth: float) -> Array:
    """Rows across, across, towards the key light; the second one holds the vertical."""
    azimuth = np.radians(camera_azimuth)
    right = np.array([-np.sin(azimuth), np.cos(azimuth), 0.0])
    away = np.array([-np.cos(azimuth), -np.sin(azimuth), 0.0])
    towards = LIGHT[0] * right + LIGHT[1] * away + np.array([0.0, 0.0, LIGHT[2]])
    towards /= np.linalg.norm(towards)
    across = np.cross([0.0, 0.0, 1.0], towards)
    across /= np.linalg.norm(across)
    return np.stack([across, np.cross(towards, across), towards])


def _first_seen(trajectory: Trajectory, bin_length: float) -> list[Array]:
    """For each cylinder, the step at which each of its bins was discovered, infinite if never."""
    length = trajectory.cylinders["length"]
    seen = [np.full(max(1, int(np.ceil(one / bin_length - 1e-9))), np.inf) for one in length]
    active = trajectory.observation.get("slots/active", np.zeros((1, 0), dtype=bool))
    for slot in np.flatnonzero(active.any(axis=0)) if seen else ():
        first = int(active[:, slot].argmax())
        c, along = cylinder_of(trajectory, int(slot), first)
        index = min(int(along / bin_length), len(seen[c]) - 1)
        seen[c][index] = min(seen[c][index], first)
    return seen


def cylinder_of(trajectory: Trajectory, slot: int, step: int) -> tuple[int, float]:
    """The cylinder to which the bin that a slot shows at a step belongs, and the bin's place along its axis, m.

    At this step the bin is shown where it is.
    """
    axis, length = trajectory.cylinders["axis"], trajectory.cylinders["length"]
    offset = trajectory.observation["slots/descriptor"][step, slot, :3].astype(np.float64) - trajectory.starts(step)
    along = (offset * axis).sum(axis=1)
    off_axis = np.linalg.norm(offset - along[:, None] * axis, axis=1)
    outside = np.maximum(0.0, np.abs(along - 0.5 * length) - 0.5 * length)
    c = int((off_axis + outside).argmin())
    return c, float(along[c])
