"""Style of figures: colours that colour-blind readers tell apart, and the same bytes for the same picture."""

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import matplotlib
import matplotlib.style

matplotlib.use("Agg")

from matplotlib.figure import Figure as Canvas

# Of text, of lesser text, of grid lines and of the ground: a page may replace them by its own.
INK, SOFT, GRID, PAPER = "#1d2126", "#5d6670", "#e9e6df", "#fffffe"

# After Okabe and Ito. One hue for a learner, dark and solid when its critic is centralised, light and dashed when not.
COLOURS = {
    "softgm": "#d55e00",
    "mappo": "#0072b2",
    "ippo": "#56b4e9",
    "maddpg": "#00805e",
    "iddpg": "#6cc5a1",
    "masac": "#a8548c",
    "isac": "#e09fc6",
    "softgm_no_stage1": "#7b6fd0",
    "softgm_no_stage2": "#9c8412",
    "softgm_remember": "#8c2d04",
    "softgm_informarl": "#3b7f8c",
    "softgm_section_transformer": "#b8860b",
}
DASHED = {"ippo", "iddpg", "isac"}
OTHERS = ("#8a6d3b", "#6b7f2a", "#4a6f8a", "#8f5b5b", "#5f5f9e")

SETTINGS: dict[str, Any] = {
    "figure.facecolor": PAPER,
    "axes.facecolor": PAPER,
    "savefig.facecolor": PAPER,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": SOFT,
    "xtick.color": SOFT,
    "ytick.color": SOFT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "axes.grid": True,
    "grid.color": GRID,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.solid_capstyle": "round",
    "svg.hashsalt": "softgm_bench",
    "pdf.compression": 0,
}


def colour(label: str) -> str:
    """Give an algorithm's colour; one that has none of its own gets one by its name."""
    return COLOURS.get(label) or OTHERS[sum(label.encode()) % len(OTHERS)]


def line(label: str) -> dict[str, Any]:
    """Give matplotlib's settings of an algorithm's line."""
    return {
        "color": colour(label),
        "linestyle": (0, (4, 1.6)) if label in DASHED else "-",
        "linewidth": 2.4 if label == "softgm" else 1.8,
        "zorder": 4 if label == "softgm" else 3,
    }


@contextmanager
def look() -> Iterator[None]:
    """Make nothing of a reader's own matplotlib settings matter inside, or in a function that it decorates."""
    with matplotlib.style.context(["default", SETTINGS]):
        yield


def save(canvas: Canvas) -> tuple[str, bytes]:
    """Write a figure as SVG and PDF, without dates."""
    svg, pdf = io.StringIO(), io.BytesIO()
    canvas.savefig(svg, format="svg", metadata={"Date": None})
    canvas.savefig(pdf, format="pdf", metadata={"CreationDate": None})
    lines = (text.rstrip() for text in svg.getvalue().splitlines())
    return "\n".join(lines) + "\n", pdf.getvalue()
