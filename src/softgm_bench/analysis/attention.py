"""Where SoftGM looks: attention matrices of an episode's steps, and what they do along the episode (paper, Fig. 4).

A matrix has a row for each agent that listens and a column for each node that it listens to; a row sums to one. Cells
without an edge are left pale: their weight is zero by construction.
"""

import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure as Canvas
from numpy.typing import NDArray

from softgm_bench.analysis.style import GRID, INK, PAPER, SOFT, look
from softgm_bench.episodes.trajectory import Trajectory, describe

COLOURS = "magma_r"  # perceptually uniform; zero is the pale end
NO_EDGE = "#f3f1eb"
MOST_BINS = 40  # columns of a matrix: with more discovered bins, only those with an edge
DPI = 150
STAGES = {"stage1": "stage 1, obstacles to agents", "stage2": "stage 2, agents to agents"}

Array = NDArray[Any]


@dataclass(frozen=True)
class Columns:
    """The bins that a stage-1 matrix of one step shows.

    Attributes:
        slots: their slots, ``(D,)``.
        labels: ``bin <slot> (y, z)``, m.
        discovered: how many are known at the step, shown or not.
    """

    slots: NDArray[np.int64]
    labels: list[str]
    discovered: int


def arrays(trajectory: Trajectory) -> dict[str, Array]:
    """What ``attention.npz`` holds.

    Returns:
        ``stage1`` (T, L, H, N, N + M) and ``stage2`` (T, L, H, N, N), those that the encoder has; ``active`` (T, M):
        the slot holds a discovered bin; ``edge`` (T, N, M): the agent senses it now; ``descriptor`` (M, 9) of the bins
        known at the end (centre, axis, radius, length, m; axial position); ``time`` (T,), s; ``metadata``, JSON.
    """
    observed = trajectory.observation
    return {
        **trajectory.attention,
        "active": observed["slots/active"][:-1],
        "edge": observed["agents/edge"][:-1],
        "descriptor": observed["slots/descriptor"][-1],
        "time": np.arange(trajectory.steps) * trajectory.rod.control_dt,
        "metadata": np.array(json.dumps(trajectory.info | {"success": trajectory.success})),
    }


def busiest_steps(trajectory: Trajectory, count: int = 4) -> list[int]:
    """Choose from each of ``count`` equal parts of the episode the first step with the most edges to bins."""
    edges = trajectory.observation["agents/edge"][:-1].sum(axis=(1, 2))
    parts = np.array_split(np.arange(trajectory.steps), min(count, trajectory.steps))
    return [int(part[edges[part].argmax()]) for part in parts]


def columns_at(trajectory: Trajectory, step: int) -> Columns:
    """The discovered bins; where they are more than ``MOST_BINS``, those with an edge."""
    discovered = np.flatnonzero(trajectory.observation["slots/active"][step])
    slots = discovered
    if len(slots) > MOST_BINS:
        slots = np.flatnonzero(trajectory.observation["agents/edge"][step].any(axis=0))
    centre = trajectory.observation["slots/descriptor"][step][slots, :3]
    labels = [f"bin {slot} ({y:.2f}, {z:.2f})" for slot, (_, y, z) in zip(slots, centre + 0.0, strict=True)]
    return Columns(slots, labels, len(discovered))


def draw_step(trajectory: Trajectory, step: int, heads: bool = False) -> Canvas:
    """Both stages at one step, a row of matrices for each layer: averaged over heads, or one for each of them."""
    weights = {stage: values[step] for stage, values in trajectory.attention.items()}  # (L, H, N, ...)
    columns = columns_at(trajectory, step)
    n = trajectory.n_agents
    layers, n_heads = next(iter(weights.values())).shape[:2]
    rows = [(layer, head) for layer in range(layers) for head in (range(n_heads) if heads else [None])]
    wide = {"stage1": n + len(columns.slots), "stage2": n}
    with look():
        grid = _Grid([wide[stage] for stage in weights], n, len(rows), bool(len(columns.slots)), compact=heads)
        for row, (layer, head) in enumerate(rows):
            for column, (stage, values) in enumerate(weights.items()):
                axes = grid.axes(row, column)
                matrix = values[layer].mean(axis=0) if head is None else values[layer, head]
                allowed = _allowed(trajectory, step, stage)
                if stage == "stage1":
                    shown = np.concatenate([np.arange(n), n + columns.slots])
                    matrix, allowed = matrix[:, shown], allowed[:, shown]
                _matrix(axes, matrix, allowed, grid.cell)
                axes.set_yticks(np.arange(n) + 0.5, [f"agent {i}" for i in range(n)] if column == 0 else [""] * n)
                names = [f"agent {i}" for i in range(n)] + (columns.labels if stage == "stage1" else [])
                last = row == len(rows) - 1
                axes.set_xticks(np.arange(len(names)) + 0.5, names if last else [""] * len(names), rotation=90)
                part = f"layer {layer + 1}" + ("" if head is None else f", head {head + 1}")
                axes.set_title(part, fontsize=8, fontweight="normal", color=SOFT, pad=4)
                if row == 0:
                    grid.heading(column, STAGES[stage])
        grid.colour_bar()
        grid.title(_step_title(trajectory, step, columns) + ("" if heads else "; mean over heads"))
        return grid.canvas


def draw_overview(trajectory: Trajectory) -> Canvas:
    """Along the episode, means over layers and heads: what agents give to obstacles, to themselves, to neighbours."""
    strips = _strips(trajectory)
    duration = trajectory.steps * trajectory.rod.control_dt
    left, width, right, top, bottom, gap = 0.85, 7.6, 0.75, 0.62, 0.5, 0.36
    total = top + sum(0.36 + strip.height for strip in strips) + 0.75 + bottom
    size = (left + width + right, total)

    def place(x: float, y: float, wide: float, high: float) -> tuple[float, float, float, float]:
        return x / size[0], y / size[1], wide / size[0], high / size[1]

    with look():
        canvas = Canvas(figsize=size)
        canvas.text(left / size[0], 1 - 0.26 / total, _title(trajectory), fontsize=10, weight="bold")
        lower = total - top - 0.75
        plots = [canvas.add_axes(place(left, lower, width, 0.75))]
        _distance(plots[0], trajectory)
        for strip in strips:
            lower -= gap + strip.height
            plots.append(canvas.add_axes(place(left, lower, width, strip.height)))
            image = _draw_strip(plots[-1], strip, duration)
            bar = canvas.colorbar(image, cax=canvas.add_axes(place(left + width + 0.15, lower, 0.1, strip.height)))
            _plain_bar(bar, strip.highest)
        for plot in plots[:-1]:
            plot.set_xticklabels([])
        plots[-1].set_xlabel("time, s")
        return canvas


def png(canvas: Canvas) -> bytes:
    """The picture, the same bytes for the same figure."""
    content = io.BytesIO()
    with look():
        canvas.savefig(content, format="png", dpi=DPI, metadata={"Software": None})
    return content.getvalue()


@dataclass(frozen=True)
class _Strip:
    """Numbers over time; NaN where there is no edge."""

    title: str
    values: Array  # (rows, T)
    kind: str  # of its rows
    highest: float = 1.0

    @property
    def height(self) -> float:
        """In inches."""
        if self.kind == "agent":
            return 0.16 * len(self.values)
        return float(np.clip(0.04 * len(self.values), 0.6, 2.0))


def _strips(trajectory: Trajectory) -> list[_Strip]:
    n, strips = trajectory.n_agents, []
    if "stage1" in trajectory.attention:
        edge = trajectory.observation["agents/edge"][:-1]  # (T, N, M)
        known = np.flatnonzero(trajectory.observation["slots/active"][-1])
        to_bins = np.where(edge, trajectory.attention["stage1"].mean(axis=(1, 2))[:, :, n:], np.nan)
        if edge.any():
            every = np.where(edge.any(axis=-1), np.nansum(to_bins, axis=-1), np.nan)
            strips.append(_Strip("stage 1: to obstacles, together", every.T, "agent"))
            each = np.where(edge.any(axis=1), np.fmax.reduce(to_bins, axis=1), np.nan)[:, known]
            highest = float(np.ceil(np.nanmax(each) * 10) / 10)
            strips.append(_Strip("stage 1: to one bin, of the agent that gives it most", each.T, "bin", highest))
    if "stage2" in trajectory.attention:
        mean = trajectory.attention["stage2"].mean(axis=(1, 2))  # (T, N, N)
        before, after = np.full((2, n, trajectory.steps), np.nan)
        before[1:], after[:-1] = (np.diagonal(mean, offset, 1, 2).T for offset in (-1, 1))
        strips.append(_Strip("stage 2: to itself", np.diagonal(mean, 0, 1, 2).T, "agent"))
        strips.append(_Strip("stage 2: to the neighbour nearer the base", before, "agent"))
        strips.append(_Strip("stage 2: to the neighbour nearer the tip", after, "agent"))
    return strips


def _draw_strip(axes: Axes, strip: _Strip, duration: float) -> Any:
    rows = len(strip.values)
    axes.set_facecolor(NO_EDGE)
    image = axes.imshow(
        np.ma.masked_invalid(strip.values),
        cmap=COLOURS,
        vmin=0.0,
        vmax=strip.highest,
        aspect="auto",
        interpolation="nearest",
        extent=(0.0, duration, rows - 0.5, -0.5),
    )
    axes.grid(False)
    axes.spines[:].set_visible(False)
    axes.set_title(strip.title, fontsize=8.5, fontweight="normal", pad=3)
    shown = range(rows) if strip.kind == "agent" else sorted({0, rows - 1})
    axes.set_yticks(shown, [f"{strip.kind} {row}" for row in shown], fontsize=7)
    axes.tick_params(axis="y", length=0)
    axes.tick_params(axis="x", length=2)
    return image


def _distance(axes: Axes, trajectory: Trajectory) -> None:
    distance = np.linalg.norm(trajectory.position[:, :, -1] - trajectory.target, axis=1)
    time = np.arange(trajectory.steps + 1) * trajectory.rod.control_dt
    touching = trajectory.contact.any(axis=1)
    axes.plot(time, distance, color=INK, linewidth=1.4)
    axes.axhline(trajectory.config["task"]["success_radius"], color=SOFT, linewidth=0.8, linestyle=(0, (3, 2)))
    ceiling = 1.15 * float(distance.max())
    axes.fill_between(time, 0.0, ceiling, where=touching, step="mid", color=GRID, linewidth=0)
    axes.set_xlim(0.0, time[-1])
    axes.set_ylim(0.0, ceiling)
    axes.grid(False)
    axes.set_title(
        "tip to target, m" + ("; shaded: the arm touches an obstacle" if touching.any() else ""),
        fontsize=8.5,
        fontweight="normal",
        pad=3,
    )


def _allowed(trajectory: Trajectory, step: int, stage: str) -> NDArray[np.bool_]:
    """Which cells have an edge: ``(N, N + M)`` of stage 1, ``(N, N)`` of stage 2."""
    n = trajectory.n_agents
    if stage == "stage1":
        return np.concatenate([np.eye(n, dtype=bool), trajectory.observation["agents/edge"][step]], axis=1)
    return np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 1


def _matrix(axes: Axes, matrix: Array, allowed: NDArray[np.bool_], cell: float) -> None:
    rows, columns = matrix.shape
    axes.set_facecolor(NO_EDGE)
    shown = np.ma.masked_where(~allowed, matrix)
    axes.pcolormesh(shown, cmap=COLOURS, vmin=0.0, vmax=1.0)
    for edge in range(rows + 1):
        axes.axhline(edge, color=PAPER, linewidth=1.0)
    for edge in range(columns + 1):
        axes.axvline(edge, color=PAPER, linewidth=5.0 if edge == rows < columns else 1.0)
    axes.set_xlim(0, columns)
    axes.set_ylim(rows, 0)
    axes.grid(False)
    axes.tick_params(length=0, labelsize=7.5 if cell >= 0.2 else 6.5, pad=2)
    axes.spines[:].set_visible(False)
    if cell >= 0.27:
        for row, column in zip(*np.nonzero(allowed), strict=True):
            value = matrix[row, column]
            text = f"{value:.2f}".removeprefix("0") if value < 0.995 else "1"
            colour = PAPER if _luminance(value) < 0.45 else INK
            axes.text(column + 0.5, row + 0.52, text, ha="center", va="center", fontsize=6.5, color=colour)


def _luminance(value: float) -> float:
    red, green, blue, _ = matplotlib.colormaps[COLOURS](value)
    return 0.3 * red + 0.59 * green + 0.11 * blue


def _title(trajectory: Trajectory) -> str:
    end = "reaches the target" if trajectory.success else "does not reach the target"
    return f"{describe(trajectory.info)}: {end}"


def _step_title(trajectory: Trajectory, step: int, columns: Columns) -> str:
    known = f"{columns.discovered} bins discovered"
    if len(columns.slots) < columns.discovered:
        known += f", the {len(columns.slots)} with an edge are shown"
    time = step * trajectory.rod.control_dt
    return f"step {step} of {trajectory.steps}, {time:.2f} s" + (f"; {known}" if columns.discovered else "")


def _plain_bar(bar: Any, highest: float) -> None:
    bar.outline.set_visible(False)
    bar.set_ticks([0.0, highest / 2, highest], labels=["0", f"{highest / 2:g}", f"{highest:g}"])
    bar.ax.tick_params(length=2, labelsize=7.5)
    bar.ax.grid(False)


class _Grid:
    """Matrices in rows and columns, laid out in inches so that all cells are squares of one size."""

    LEFT, TOP, GAP, RIGHT = 0.7, 0.85, 0.35, 0.85

    def __init__(self, widths: Sequence[int], height: int, rows: int, bins: bool, compact: bool) -> None:
        """``widths`` of the columns and the matrices' ``height``, in cells; ``bins``: their labels are to have room."""
        self.cell = float(np.clip((8.0 if compact else 10.0) / sum(widths), 0.155, 0.2 if compact else 0.36))
        self.widths, self.height, self.rows = [width * self.cell for width in widths], height * self.cell, rows
        self.step = self.height + 0.27
        self.bottom = (1.1 if compact else 1.25) if bins else 0.6
        self.pitch = [max(width, 1.9) + self.GAP for width in self.widths]  # headings need room
        matrices = sum(self.pitch[:-1]) + self.widths[-1]
        margin = max(self.RIGHT, 2.1 - self.widths[-1])
        self.size = (self.LEFT + matrices + margin, self.TOP + rows * self.step + self.bottom)
        self.right = self.LEFT + matrices
        self.canvas = Canvas(figsize=self.size)

    def axes(self, row: int, column: int) -> Axes:
        """The place of one matrix."""
        x, y = self._left(column), self.size[1] - self.TOP - row * self.step - self.height
        return self.canvas.add_axes(self._box(x, y, self.widths[column], self.height))

    def heading(self, column: int, text: str) -> None:
        """Over the first matrix of a column."""
        self._text(self._left(column), self.size[1] - self.TOP + 0.24, text, fontsize=9, weight="bold")

    def title(self, text: str) -> None:
        """Over everything."""
        self._text(self.LEFT, self.size[1] - 0.28, text, fontsize=9, color=SOFT)

    def colour_bar(self) -> None:
        """Right of the first row."""
        height = min(1.4, self.rows * self.step - 0.27)
        box = self._box(self.right + 0.2, self.size[1] - self.TOP - height, 0.13, height)
        bar = self.canvas.colorbar(ScalarMappable(cmap=COLOURS), cax=self.canvas.add_axes(box))
        _plain_bar(bar, 1.0)

    def _left(self, column: int) -> float:
        return self.LEFT + sum(self.pitch[:column])

    def _box(self, x: float, y: float, width: float, height: float) -> tuple[float, float, float, float]:
        return x / self.size[0], y / self.size[1], width / self.size[0], height / self.size[1]

    def _text(self, x: float, y: float, text: str, **settings: Any) -> None:
        self.canvas.text(x / self.size[0], y / self.size[1], text, **settings)
