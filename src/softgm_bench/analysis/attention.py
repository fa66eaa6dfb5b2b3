"""SoftGM's attention: matrices of an episode's steps, and what they do along the episode (paper, Fig. 4).

A matrix has a row for each agent that listens and a column for each node that it listens to; a row sums to one. Cells
without an edge are left pale: their weight is zero by construction. Places on a canvas are in inches from its lower
left corner.
"""

import io
import json
from typing import Any, NamedTuple

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
LEFT, TOP, GAP, RIGHT, LAYER_TITLE = 0.7, 0.85, 0.35, 0.85, 0.27  # around the matrices, inches

Array = NDArray[Any]


class Columns(NamedTuple):
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
    """Give the content of ``attention.npz``.

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


def busiest_steps(trajectory: Trajectory) -> list[int]:
    """Choose in each quarter of the episode the first step with the most edges to bins."""
    edges = trajectory.observation["agents/edge"][:-1].sum(axis=(1, 2))
    parts = np.array_split(np.arange(trajectory.steps), min(4, trajectory.steps))
    return [int(part[edges[part].argmax()]) for part in parts]


def columns_at(trajectory: Trajectory, step: int) -> Columns:
    """Choose the discovered bins; where they are more than ``MOST_BINS``, those with an edge."""
    slots = discovered = np.flatnonzero(trajectory.observation["slots/active"][step])
    if len(discovered) > MOST_BINS:
        slots = np.flatnonzero(trajectory.observation["agents/edge"][step].any(axis=0))
    centre = trajectory.observation["slots/descriptor"][step][slots, :3]
    labels = [f"bin {slot} ({y:.2f}, {z:.2f})" for slot, (_, y, z) in zip(slots, centre + 0.0, strict=True)]
    return Columns(slots, labels, len(discovered))


@look()
def png(canvas: Canvas) -> bytes:
    """Write a picture, the same bytes for the same figure."""
    content = io.BytesIO()
    canvas.savefig(content, format="png", dpi=DPI, metadata={"Software": None})
    return content.getvalue()


@look()
def draw_step(trajectory: Trajectory, step: int, heads: bool = False) -> Canvas:
    """Draw both stages at one step, a row of matrices for each layer: averaged over heads, or one for each of them.

    All cells are squares of one size.
    """
    n, bins = trajectory.n_agents, columns_at(trajectory, step)
    agents = [f"agent {i}" for i in range(n)]
    layers, n_heads = next(iter(trajectory.attention.values())).shape[1:3]
    rows = [(layer, head) for layer in range(layers) for head in (range(n_heads) if heads else [None])]
    names = {stage: agents + (bins.labels if stage == "stage1" else []) for stage in trajectory.attention}
    cell = float(np.clip((8.0 if heads else 10.0) / sum(map(len, names.values())), 0.155, 0.2 if heads else 0.36))
    high, widths = n * cell, [len(of_stage) * cell for of_stage in names.values()]
    offsets = np.cumsum([0.0, *(max(wide, 1.9) + GAP for wide in widths[:-1])])  # headings need room
    right, pitch = LEFT + (offsets[-1] + widths[-1]), high + LAYER_TITLE
    total = TOP + len(rows) * pitch + ((1.1 if heads else 1.25) if bins.labels else 0.6)
    top = total - TOP
    canvas = Canvas(figsize=(right + max(RIGHT, 2.1 - widths[-1]), total))
    for row, (layer, head) in enumerate(rows):
        for left, wide, (stage, columns) in zip(LEFT + offsets, widths, names.items(), strict=True):
            if row == 0:
                _text(canvas, left, top + 0.24, STAGES[stage], fontsize=9, weight="bold")
            weights = trajectory.attention[stage][step, layer]
            matrix = weights.mean(axis=0) if head is None else weights[head]
            shown = np.concatenate([np.arange(n), n + bins.slots]) if stage == "stage1" else np.arange(n)
            axes = _axes(canvas, left, top - row * pitch - high, wide, high)
            _matrix(axes, matrix[:, shown], _allowed(trajectory, step, stage)[:, shown], cell)
            axes.set_yticks(np.arange(n) + 0.5, agents if left == LEFT else [""] * n)
            last = row == len(rows) - 1
            axes.set_xticks(np.arange(len(columns)) + 0.5, columns if last else [""] * len(columns), rotation=90)
            part = f"layer {layer}" + ("" if head is None else f", head {head}")
            axes.set_title(part, fontsize=8, fontweight="normal", color=SOFT, pad=4)
    bar = min(1.4, len(rows) * pitch - LAYER_TITLE)
    _colour_bar(canvas, ScalarMappable(cmap=COLOURS), 1.0, right + 0.2, top - bar, 0.13, bar)
    title = f"step {step} of {trajectory.steps}, {step * trajectory.rod.control_dt:.2f} s"
    if bins.discovered:
        title += f"; {bins.discovered} bins discovered"
    if len(bins.slots) < bins.discovered:
        title += f", the {len(bins.slots)} with an edge are shown"
    _text(canvas, LEFT, total - 0.28, title + ("" if heads else "; mean over heads"), fontsize=9, color=SOFT)
    return canvas


def _axes(canvas: Canvas, x: float, y: float, wide: float, high: float) -> Axes:
    width, height = canvas.get_size_inches()
    return canvas.add_axes((x / width, y / height, wide / width, high / height))


def _text(canvas: Canvas, x: float, y: float, text: str, **settings: Any) -> None:
    width, height = canvas.get_size_inches()
    canvas.text(x / width, y / height, text, **settings)


def _colour_bar(canvas: Canvas, image: ScalarMappable, highest: float, *place: float) -> None:
    bar: Any = canvas.colorbar(image, cax=_axes(canvas, *place))
    bar.outline.set_visible(False)
    bar.set_ticks([0.0, highest / 2, highest], labels=["0", f"{highest / 2:g}", f"{highest:g}"])
    bar.ax.tick_params(length=2, labelsize=7.5)
    bar.ax.grid(False)


def _allowed(trajectory: Trajectory, step: int, stage: str) -> NDArray[np.bool_]:
    """Mark the cells that have an edge: ``(N, N + M)`` of stage 1, ``(N, N)`` of stage 2."""
    n = trajectory.n_agents
    if stage == "stage1":
        return np.concatenate([np.eye(n, dtype=bool), trajectory.observation["agents/edge"][step]], axis=1)
    return np.abs(np.subtract.outer(np.arange(n), np.arange(n))) <= 1


def _matrix(axes: Axes, matrix: Array, allowed: NDArray[np.bool_], cell: float) -> None:
    rows, columns = matrix.shape
    axes.set_facecolor(NO_EDGE)
    axes.pcolormesh(np.ma.masked_where(~allowed, matrix), cmap=COLOURS, vmin=0.0, vmax=1.0)
    for edge in range(rows + 1):
        axes.axhline(edge, color=PAPER, linewidth=1.0)
    for edge in range(columns + 1):
        axes.axvline(edge, color=PAPER, linewidth=5.0 if edge == rows < columns else 1.0)
    axes.set(xlim=(0, columns), ylim=(rows, 0))
    axes.grid(False)
    axes.tick_params(length=0, labelsize=7.5 if cell >= 0.2 else 6.5, pad=2)
    axes.spines[:].set_visible(False)
    for row, column in np.argwhere(allowed) if cell >= 0.27 else ():
        value = matrix[row, column]
        text = f"{value:.2f}".removeprefix("0") if value < 0.995 else "1"
        luminance = np.dot(matplotlib.colormaps[COLOURS](value)[:3], (0.3, 0.59, 0.11))
        colour = PAPER if luminance < 0.45 else INK
        axes.text(column + 0.5, row + 0.52, text, ha="center", va="center", fontsize=6.5, color=colour)


class _Strip(NamedTuple):
    """Numbers over time, ``(rows, T)``; NaN where there is no edge."""

    title: str
    values: Array
    kind: str = "agent"  # of its rows
    highest: float = 1.0


@look()
def draw_overview(trajectory: Trajectory) -> Canvas:
    """Draw along the episode, as means over layers and heads, what agents give to obstacles, themselves, neighbours."""
    strips = _strips(trajectory)
    heights = [
        0.16 * len(strip.values) if strip.kind == "agent" else float(np.clip(0.04 * len(strip.values), 0.6, 2.0))
        for strip in strips
    ]
    left, wide, right, top, distance, bottom, gap = 0.85, 7.6, 0.75, 0.62, 0.75, 0.5, 0.36
    total = top + sum(gap + height for height in heights) + distance + bottom
    canvas = Canvas(figsize=(left + wide + right, total))
    end = "reaches the target" if trajectory.success else "does not reach the target"
    _text(canvas, left, total - 0.26, f"{describe(trajectory.info)}: {end}", fontsize=10, weight="bold")
    lower = total - top - distance
    plots = [_axes(canvas, left, lower, wide, distance)]
    _distance(plots[0], trajectory)
    for strip, height in zip(strips, heights, strict=True):
        lower -= gap + height
        plots.append(_axes(canvas, left, lower, wide, height))
        image = _draw_strip(plots[-1], strip, trajectory.steps * trajectory.rod.control_dt)
        _colour_bar(canvas, image, strip.highest, left + wide + 0.15, lower, 0.1, height)
    for plot in plots[:-1]:
        plot.set_xticklabels([])
    plots[-1].set_xlabel("time, s")
    return canvas


def _strips(trajectory: Trajectory) -> list[_Strip]:
    n, strips = trajectory.n_agents, []
    edge = trajectory.observation["agents/edge"][:-1]  # (T, N, M)
    if "stage1" in trajectory.attention and edge.any():
        known = np.flatnonzero(trajectory.observation["slots/active"][-1])
        to_bins = np.where(edge, trajectory.attention["stage1"].mean(axis=(1, 2))[:, :, n:], np.nan)
        every = np.where(edge.any(axis=-1), np.nansum(to_bins, axis=-1), np.nan)
        strips.append(_Strip("stage 1: to obstacles, together", every.T))
        each = np.where(edge.any(axis=1), np.fmax.reduce(to_bins, axis=1), np.nan)[:, known]
        highest = float(np.ceil(np.nanmax(each) * 10) / 10)
        strips.append(_Strip("stage 1: to one bin, of the agent that gives it most", each.T, "bin", highest))
    if "stage2" in trajectory.attention:
        mean = trajectory.attention["stage2"].mean(axis=(1, 2))  # (T, N, N)
        before, after = np.full((2, n, trajectory.steps), np.nan)
        before[1:], after[:-1] = (np.diagonal(mean, offset, 1, 2).T for offset in (-1, 1))
        strips.append(_Strip("stage 2: to itself", np.diagonal(mean, 0, 1, 2).T))
        strips.append(_Strip("stage 2: to the neighbour nearer the base", before))
        strips.append(_Strip("stage 2: to the neighbour nearer the tip", after))
    return strips


def _draw_strip(axes: Axes, strip: _Strip, duration: float) -> ScalarMappable:
    rows = len(strip.values)
    axes.set_facecolor(NO_EDGE)
    settings: dict[str, Any] = {"cmap": COLOURS, "vmin": 0.0, "vmax": strip.highest, "interpolation": "nearest"}
    extent = (0.0, duration, rows - 0.5, -0.5)
    image = axes.imshow(np.ma.masked_invalid(strip.values), aspect="auto", extent=extent, **settings)
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
    ceiling = 1.15 * float(distance.max())
    axes.plot(time, distance, color=INK, linewidth=1.4)
    axes.axhline(trajectory.config["task"]["success_radius"], color=SOFT, linewidth=0.8, linestyle=(0, (3, 2)))
    axes.fill_between(time, 0.0, ceiling, where=touching, step="mid", color=GRID, linewidth=0)
    axes.set(xlim=(0.0, time[-1]), ylim=(0.0, ceiling))
    axes.grid(False)
    title = "tip to target, m" + ("; shaded: the arm touches an obstacle" if touching.any() else "")
    axes.set_title(title, fontsize=8.5, fontweight="normal", pad=3)
