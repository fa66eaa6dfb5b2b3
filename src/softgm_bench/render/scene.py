"""What is seen at one moment of an episode, as round cones."""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from softgm_bench.episodes.trajectory import Trajectory
from softgm_bench.render import style
from softgm_bench.render.camera import MANY
from softgm_bench.render.grid import make_grid
from softgm_bench.render.shading import ARM, CYLINDER, MARK, OCCLUSION_REACH, OTHER, PENUMBRA, Drawing

Array = NDArray[np.float64]

SEEN_THROUGH = 0.34  # opacity of walls
FRESH = 0.3  # s during which a discovered bin is shown as new
TRACE = 240  # pieces of the tip's path
FAINT = 0.005  # attention below this is not drawn
STRONG = 0.25  # attention from which on an edge is opaque
LIGHT = (-0.35, -0.62, 1.0)  # towards the key light, in the camera's right, away and up: from the upper left, before it


@dataclass
class Parts:
    """Round cones by the piece; the fields are those of ``Drawing``."""

    cone: list[Array] = field(default_factory=list)
    owner: list[int] = field(default_factory=list)
    row: list[int] = field(default_factory=list)
    span: list[tuple[float, float]] = field(default_factory=list)
    look: list[tuple[float, float]] = field(default_factory=list)
    blocker: list[Array] = field(default_factory=list)
    blocker_owner: list[int] = field(default_factory=list)
    blocker_strength: list[float] = field(default_factory=list)
    texture: list[Array] = field(default_factory=list)

    def paint(self, colour: Array, opacity: Array | float = 1.0) -> int:
        """Add a texture of one colour ``(3,)`` or of ``(TEXELS, 3)``; its row."""
        texture = np.empty((style.TEXELS, 4))
        texture[:, :3], texture[:, 3] = colour, opacity
        self.texture.append(texture)
        return len(self.texture) - 1

    def add(
        self,
        start: Array,
        start_radius: float,
        end: Array,
        end_radius: float,
        row: int,
        owner: int = OTHER,
        span: tuple[float, float] = (0.0, 1.0),
        look: tuple[float, float] = (0.0, 0.3),
    ) -> None:
        """Add the hull of two spheres that is seen; ``look``: emission, gloss."""
        self.cone.append(np.array([*start, start_radius, *end, end_radius], dtype=np.float64))
        self.owner.append(owner)
        self.row.append(row)
        self.span.append(span)
        self.look.append(look)

    def block(
        self, start: Array, start_radius: float, end: Array, end_radius: float, owner: int = OTHER, part: float = 1.0
    ) -> None:
        """Add the hull of two spheres that takes a part of the light from others."""
        self.blocker.append(np.array([*start, start_radius, *end, end_radius], dtype=np.float64))
        self.blocker_owner.append(owner)
        self.blocker_strength.append(part)


class Stage:
    """Everything about an episode that does not change from moment to moment."""

    def __init__(self, trajectory: Trajectory, attention: bool = False, camera_azimuth: float = 0.0) -> None:
        """Prepare an episode.

        Args:
            trajectory: the episode.
            attention: draw attention as edges where the trajectory has it.
            camera_azimuth: degrees; the light comes from the camera's left.
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
        self.wall = len(trajectory.cylinders["length"]) >= MANY
        self.first_seen = _first_seen(trajectory, self.bin_length)
        lowest = [-0.2 * self.base_length, float((self.position[:, 2] - rod["base_radius"]).min()) - 0.02]
        if len(trajectory.cylinders["length"]):
            ends = trajectory.cylinders["start"], self.ends()
            lowest += [float(end[:, 2].min()) for end in ends]
        self.floor = min(lowest)
        self.light = _light_frame(camera_azimuth)

    def ends(self) -> Array:
        """The cylinders' far ends, m, ``(C, 3)``."""
        cylinders = self.trajectory.cylinders
        return cylinders["start"] + cylinders["length"][:, None] * cylinders["axis"]

    def extent(self) -> Array:
        """Points, m, ``(n, 3)``, that a picture of the whole episode has to show."""
        shown = [np.array([[0.0, 0.0, self.floor]]), self.trajectory.target[None] + self.success_radius * _BOX]
        nodes = self.position[:, :, ::6].transpose(0, 2, 1).reshape(-1, 3)
        shown.append((nodes[:, None] + 0.05 * self.base_length * _BOX).reshape(-1, 3))
        cylinders, ends = self.trajectory.cylinders, self.ends()
        for start, end, radius in zip(cylinders["start"], ends, cylinders["radius"], strict=True):
            shown += [start + radius * _BOX, end + radius * _BOX]
        return np.concatenate(shown)

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
        return self._finish(parts)

    def nodes(self, step: float) -> Array:
        """Positions at a time in control steps, ``(3, n_nodes)``: cubic between two states and their velocities."""
        k = min(int(step), self.trajectory.steps - 1) if self.trajectory.steps else 0
        f = step - k
        if f == 0.0:
            return self.position[k]
        p, q = self.position[k], self.position[k + 1]
        u, v = (self.control_dt * self.trajectory.velocity[i].astype(np.float64) for i in (k, k + 1))
        return (1 + 2 * f) * (1 - f) ** 2 * p + f * (1 - f) ** 2 * u + f * f * (3 - 2 * f) * q + f * f * (f - 1) * v

    # the things in it

    def _arm(self, parts: Parts, step: float) -> None:
        nearest = round(step)
        nodes, element = self.nodes(step), self.radius[nearest]
        radius = np.concatenate([element[:1], 0.5 * (element[1:] + element[:-1]), element[-1:]])
        n = len(element)
        fine_nodes, fine_radius = _between(nodes), _between(radius[None])[0]
        row = parts.paint(self._arm_colour(nearest))
        for i in range(2 * n):
            span = (0.5 * i / n, 0.5 * (i + 1) / n)
            parts.add(
                fine_nodes[:, i], fine_radius[i], fine_nodes[:, i + 1], fine_radius[i + 1], row, ARM, span, (0, 1)
            )
        coarse = sorted({*range(0, n, 2), n})  # shadows are soft
        for i, j in pairwise(coarse):
            parts.block(nodes[:, i], radius[i], nodes[:, j], radius[j], ARM)
        foot = np.array([0.0, 0.0, self.floor])
        grey = parts.paint(style.linear(style.PEDESTAL))
        base = radius[0]
        pedestal = foot, 1.25 * base, np.array([0.0, 0.0, -0.6 * base]), 1.02 * base
        parts.add(*pedestal, grey, look=(0.0, 0.2))
        parts.block(*pedestal)

    def _arm_colour(self, step: int) -> Array:
        trajectory = self.trajectory
        place = (np.arange(style.TEXELS) + 0.5) / style.TEXELS
        sections = trajectory.n_agents + 1
        stepped = (np.floor(place * sections) + 0.5) / sections
        colour = style.gradient(style.ARM, 0.5 * place + 0.5 * stepped)
        touch = np.interp(place, np.linspace(0.0, 1.0, trajectory.contact.shape[1]), trajectory.contact[step])
        colour = style.mix(colour, style.linear(style.TOUCH), 0.45 * touch)
        for agent in range(1, sections):
            distance = np.abs(place - agent / sections) * self.base_length
            ring = np.clip(1.5 - 2.0 * distance / style.RING_WIDTH, 0.0, 1.0)
            colour = style.mix(colour, style.linear(style.RING), 0.85 * ring)
        tip = np.clip((place - 1.0) * self.base_length / 0.004 + 2.0, 0.0, 1.0)
        return style.mix(colour, style.linear(style.REACHED if self._reached(step) else style.TIP), 0.9 * tip)

    def _reached(self, step: float) -> bool:
        return self.trajectory.success and step >= self.trajectory.steps

    def _cylinders(self, parts: Parts, step: float) -> None:
        cylinders, ends = self.trajectory.cylinders, self.ends()
        place = (np.arange(style.TEXELS) + 0.5) / style.TEXELS
        for c, (start, end) in enumerate(zip(cylinders["start"], ends, strict=True)):
            length, radius = float(cylinders["length"][c]), float(cylinders["radius"][c])
            seen = self.first_seen[c]
            index = np.minimum((place * length / self.bin_length).astype(int), len(seen) - 1)
            known = (seen[index] <= step).astype(np.float64)
            age = (step - np.where(known > 0.0, seen[index], 0.0)) * self.control_dt
            colour = style.mix(
                np.broadcast_to(style.linear(style.DISCOVERED), (style.TEXELS, 3)),
                style.linear(style.NEW),
                np.clip(1.0 - age / FRESH, 0.0, 1.0),
            )
            joint = np.round(place * length / self.bin_length) * self.bin_length
            joint[(joint < 0.5 * self.bin_length) | (joint > length - 0.01 * self.bin_length)] = np.inf  # ends are none
            known = known * np.clip(np.abs(place * length - joint) / style.GAP - 0.3, 0.0, 1.0)
            colour = style.mix(np.broadcast_to(style.linear(style.COLUMN), colour.shape), colour, known)
            opacity = SEEN_THROUGH + (0.8 - SEEN_THROUGH) * known if self.wall else 1.0
            row = parts.paint(colour, opacity)
            parts.add(start, radius, end, radius, row, CYLINDER, look=(0.0, 0.4))
            parts.block(start, radius, end, radius, CYLINDER, SEEN_THROUGH if self.wall else 1.0)

    def _target(self, parts: Parts, step: float) -> None:
        colour = style.linear(style.REACHED if self._reached(step) else style.TARGET)
        target = self.trajectory.target
        shell, core = parts.paint(colour, 0.22), parts.paint(colour)
        small = 0.3 * self.success_radius
        parts.add(target, self.success_radius, target, self.success_radius, shell, MARK, look=(0.5, 0.6))
        parts.add(target, small, target, small, core, MARK, look=(0.5, 0.5))
        parts.block(target, self.success_radius, target, self.success_radius, part=0.5)

    def _trace(self, parts: Parts, step: float) -> None:
        whole = max(1, min(TRACE, int(np.ceil(6.0 * step))))
        points = [self.nodes(moment)[:, -1] for moment in np.linspace(0.0, step, whole + 1)]
        row = parts.paint(style.gradient(style.PATH, np.linspace(0.0, 1.0, style.TEXELS)))
        thin = 0.0028 * self.base_length
        for i in range(whole):
            span = (i / whole, (i + 1) / whole)
            parts.add(points[i], thin, points[i + 1], thin, row, span=span, look=(0.35, 0.0))

    def _attention(self, parts: Parts, step: float) -> None:
        trajectory = self.trajectory
        k = min(round(step), trajectory.steps - 1)
        n_agents = trajectory.n_agents
        weight = trajectory.attention["stage1"][k].mean(axis=(0, 1))[:, n_agents:]  # (N, M)
        centre = trajectory.observation["slots/descriptor"][k, :, :3].astype(np.float64)
        nodes = self.nodes(step)[:, trajectory.agent_nodes]
        for agent, slot in zip(*np.nonzero(weight > FAINT), strict=True):
            part = min(1.0, float(np.sqrt(weight[agent, slot] / STRONG)))
            row = parts.paint(style.linear(style.ATTENTION), 0.1 + 0.85 * part)
            thin = (0.0025 + 0.0045 * part) * self.base_length
            parts.add(centre[slot], thin, nodes[:, agent], thin, row, MARK, look=(0.7, 0.0))

    def _finish(self, parts: Parts) -> Drawing:
        blocker = np.stack(parts.blocker)
        low, high, largest = _boxes(blocker)
        near_grid = make_grid(low - OCCLUSION_REACH, high + OCCLUSION_REACH, 0.1)
        in_light = np.concatenate([blocker[:, 0:3] @ self.light.T, blocker[:, 4:7] @ self.light.T], axis=1)
        # the penumbra is widest on the floor, or on what is below it in the picture
        away = np.maximum(in_light[:, 2], in_light[:, 5]) - self.floor * self.light[2, 2] + self.base_length
        wide = (largest + PENUMBRA * np.maximum(away, 0.0))[:, None] * [1.0, 1.0, 0.0]
        flat = in_light.reshape(-1, 2, 3) * [1.0, 1.0, 0.0]
        shadow_grid = make_grid(flat.min(axis=1) - wide, flat.max(axis=1) + wide, 0.04)
        fill = np.array([-self.light[2, 0], -self.light[2, 1], 0.6 * self.light[2, 2]])
        return Drawing(
            cone=np.stack(parts.cone),
            owner=np.array(parts.owner, dtype=np.int64),
            row=np.array(parts.row, dtype=np.int64),
            span=np.array(parts.span, dtype=np.float64),
            look=np.array(parts.look, dtype=np.float64),
            texture=np.stack(parts.texture),
            blocker=blocker,
            blocker_owner=np.array(parts.blocker_owner, dtype=np.int64),
            blocker_strength=np.array(parts.blocker_strength, dtype=np.float64),
            in_light=in_light,
            light=self.light,
            fill=fill / np.linalg.norm(fill),
            shadow_grid=shadow_grid,
            near_grid=near_grid,
            floor=float(self.floor),
        )


_BOX = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])


def _boxes(cone: Array) -> tuple[Array, Array, Array]:
    """Lower and upper corners ``(n, 3)`` of round cones ``(n, 8)``, and the larger radius of each ``(n,)``."""
    ends = cone.reshape(-1, 2, 4)
    centre, radius = ends[..., :3], ends[..., 3:]
    return (centre - radius).min(axis=1), (centre + radius).max(axis=1), ends[..., 3].max(axis=1)


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
    cylinders = trajectory.cylinders
    seen = [np.full(max(1, int(np.ceil(length / bin_length - 1e-9))), np.inf) for length in cylinders["length"]]
    active = trajectory.observation.get("slots/active")
    if active is None or not active.any():
        return seen
    descriptor = trajectory.observation["slots/descriptor"].astype(np.float64)
    for slot in np.flatnonzero(active.any(axis=0)):
        first = int(active[:, slot].argmax())
        found = descriptor[first, slot]
        offset = found[:3] - cylinders["start"]
        along = (offset * cylinders["axis"]).sum(axis=1)
        off_axis = np.linalg.norm(offset - along[:, None] * cylinders["axis"], axis=1)
        outside = np.maximum(0.0, np.abs(along - 0.5 * cylinders["length"]) - 0.5 * cylinders["length"])
        c = int((off_axis + outside).argmin())
        index = min(int(along[c] / bin_length), len(seen[c]) - 1)
        seen[c][index] = min(seen[c][index], first)
    return seen
