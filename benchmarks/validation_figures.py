"""One figure for each study of ``validation.py`` and for the table of ``parity.py``, drawn from what they wrote."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.ticker import NullLocator

Result = dict[str, Any]
BLUE, ORANGE, GREEN, GREY = "#1f5fa8", "#d9702b", "#3a8f5a", "#808080"
STYLE: Any = {
    "figure.dpi": 150,
    "savefig.dpi": 150,
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.titlesize": 9,
    "axes.titlelocation": "left",
    "legend.frameon": False,
    "lines.linewidth": 1.2,
    "lines.markersize": 4.5,
}


def draw(study: str, result: Result, path: Path) -> None:
    """Draw one study into a PNG file."""
    with plt.rc_context(STYLE):
        figure = FIGURES[study](result)
        path.parent.mkdir(parents=True, exist_ok=True)
        figure.savefig(path, bbox_inches="tight")
        plt.close(figure)


def _cantilever(result: Result):
    figure, axes = plt.subplots(figsize=(4.6, 3.2))
    rows = result["small"]
    n = np.array([row["elements"] for row in rows])
    for key, colour, label in (
        ("relative_to_timoshenko", BLUE, "to Timoshenko's beam"),
        ("relative_to_timoshenko_half_an_element_stiff", ORANGE, "to one whose first L / 2n does not bend"),
        ("relative_to_discrete", GREEN, "to the closed form for n elements"),
    ):
        axes.loglog(n, [abs(row[key]) for row in rows], "o", color=colour, label=label)
    first, second = abs(rows[0]["relative_to_timoshenko"]), abs(rows[0]["relative_to_timoshenko_half_an_element_stiff"])
    axes.loglog(n, first * n[0] / n, "-", color=BLUE, linewidth=0.8)
    axes.loglog(n, second * (n[0] / n) ** 2, "-", color=ORANGE, linewidth=0.8)
    axes.annotate("slope -1", (n[2], 1.6 * first * n[0] / n[2]), color=BLUE)
    axes.annotate("slope -2", (n[2], 1.9 * second * (n[0] / n[2]) ** 2), color=ORANGE)
    axes.set_xticks(n, [str(value) for value in n])
    axes.minorticks_off()
    axes.set_ylim(1e-11, 3.0)
    axes.set_xlabel("number of elements n")
    axes.set_ylabel("relative difference of the tip's deflection")
    axes.set_title("Cantilever under a small tip force")
    axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.32))
    return figure


def _stretch(result: Result):
    figure, axes = plt.subplots(figsize=(4.2, 3.0))
    rows = result["rows"]
    share = np.linspace(-0.05, 0.62, 200)
    axes.plot(share, 1.0 / (1.0 - share), color=BLUE, label="incompressible section, 1 / (1 - F / EA)")
    axes.plot(share, 1.0 + share, "--", color=GREY, linewidth=0.8, label="linear, 1 + F / EA")
    axes.plot(
        [row["force_over_EA"] for row in rows],
        [row["tip_m"] for row in rows],
        "o",
        color=ORANGE,
        label="simulated",
    )
    axes.set_xlabel("tip force F over EA")
    axes.set_ylabel("height of the tip, m")
    worst = max(row["difference_m"] for row in rows)
    axes.set_title(f"Arm pulled along its axis\n(largest difference of a node {worst:.0e} m)")
    axes.legend(loc="upper left")
    return figure


def _arc(result: Result):
    figure, axes = plt.subplots(figsize=(4.8, 3.6))
    colours = plt.get_cmap("viridis")(np.linspace(0.1, 0.8, len(result["rows"])))
    for row, colour in zip(result["rows"], colours, strict=True):
        n = len(row["x_m"]) - 1
        turn = 2.0 * np.pi * row["turns"] / n
        radius = 0.5 / n / np.sin(0.5 * turn)
        # the circle through the nodes of a polygon whose first chord stands on the origin along z
        middle = np.array([radius * np.cos(0.5 * turn), 0.5 / n])
        angle = np.pi + 0.5 * turn - np.linspace(0.0, 2.0 * np.pi, 400)
        circle = middle[:, None] + radius * np.array([np.cos(angle), np.sin(angle)])
        axes.plot(*circle, color=colour, linewidth=0.7)
        axes.plot(row["x_m"], row["z_m"], "o", color=colour, markersize=2.6, label=f"{row['couple_Nm']:.2f} N m")
    axes.set_xlim(-0.15, 1.35)
    axes.set_ylim(-0.15, 1.05)
    axes.set_aspect("equal")
    axes.set_xlabel("x, m")
    axes.set_ylabel("z, m")
    worst = max(row["difference_m"] for row in result["rows"])
    axes.set_title(f"Couple at the end: nodes (dots) lie on circles\n(largest difference {worst:.0e} m)")
    axes.legend(loc="upper right", title="couple")
    return figure


def _energy(result: Result):
    figure, (near, far) = plt.subplots(1, 2, figsize=(8.4, 3.1), gridspec_kw={"wspace": 0.3})
    for row, colour in zip(reversed(result["rows"]), (ORANGE, BLUE, GREEN), strict=True):
        time = result["control_dt_s"] * np.arange(len(row["change"]))
        near.plot(time, 1e4 * np.array(row["change"]), color=colour, linewidth=0.5, label=f"{row['tip_m']:.2f} m")
    near.set_xlabel("time since the release, s")
    near.set_ylabel("change of total energy, 1e-4 of its start")
    near.set_title("Undamped arm: energy stays")
    near.legend(loc="lower left", title="tip released from", ncols=3, columnspacing=1.0, handlelength=1.2)
    near.set_ylim(-4.6, 2.0)

    ours, theirs = (np.abs(result["far"][name]["change"]) for name in ("ours", "pyelastica"))
    half = np.abs(result["far"]["ours_half_the_step"]["change"])
    time = result["control_dt_s"] * np.arange(len(ours))
    far.semilogy(time[1:], half[1:], color=GREY, linewidth=0.6, label="half the substep")
    far.semilogy(time[1:], ours[1:], color=BLUE, linewidth=0.8, label="softgm_bench")
    far.semilogy(time[25::25], theirs[25::25], "o", color=ORANGE, markersize=2.6, label="PyElastica")
    far.set_ylim(1e-7, 1e2)
    far.set_xlabel("time since the release, s")
    far.set_ylabel("|change| over the energy at the start")
    far.set_title(f"Released from {result['far']['tip_m']:.2f} m it grows, in PyElastica too")
    far.legend(loc="upper left")
    return figure


def _time_step(result: Result):
    figure, axes = plt.subplots(figsize=(4.6, 3.2))
    step = np.array(result["dt_s"])
    for curve, colour, order in zip(result["curves"], (BLUE, GREEN, ORANGE), (2, 2, 1), strict=True):
        axes.loglog(step, curve["error_m"], "o", color=colour, label=curve["label"])
        guide = curve["error_m"][2] * (step / step[2]) ** order
        axes.loglog(step, guide, "-", color=colour, linewidth=0.8)
        axes.annotate(f"slope {order}", (step[3], 2.5 * guide[3]), color=colour, ha="right")
    axes.set_ylim(1e-10, 1e-1)
    axes.set_xticks(step, [f"{1e6 * value:g}" for value in step])
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set_xlabel("substep, µs")
    axes.set_ylabel("largest error of a node after 0.4 s, m")
    axes.set_title("Position Verlet is of order 2; the split-off damper of order 1")
    axes.legend(loc="upper left", ncols=1)
    return figure


def _float32(result: Result):
    figure, panels = plt.subplots(1, 2, figsize=(8.4, 3.1), sharey=True, gridspec_kw={"wspace": 0.08})
    for axes, (scene, curves) in zip(panels, result["scenes"].items(), strict=True):
        _float32_panel(axes, curves, result["time_s"])
        axes.set_title({"free": "Free space", "wall": "Against the wall"}[scene])
        axes.set_xlabel("time, s")
    panels[0].set_ylabel("distance of the tips, m")
    panels[0].legend(loc="upper left", title=f"median (thin: largest) of {result['seeds']} arms", alignment="left")
    return figure


def _float32_panel(axes: Axes, curves: Result, time: list[float]) -> None:
    for name, colour, label in (
        ("float32", ORANGE, "float32 arm to float64 arm"),
        ("torque", BLUE, "float64 arms, one torque rounded to float32"),
    ):
        axes.loglog(time, curves[name]["median_m"], color=colour, label=label)
        axes.loglog(time, curves[name]["largest_m"], color=colour, linewidth=0.5, alpha=0.7)
    axes.set_xlim(0.04, 80.0)
    axes.set_ylim(1e-11, 20.0)


def _parity(result: Result):
    figure, axes = plt.subplots(figsize=(6.0, 5.2))
    rows = result["rows"]
    place = np.arange(len(rows))
    for backend, colour, marker in (("torch", BLUE, "o"), ("numba", ORANGE, "D")):
        # exact zeros lie on the left edge
        values = [max(row["difference"][backend]["position"], 1e-16) for row in rows]
        axes.semilogx(values, place, marker, color=colour, markersize=3.5, label=backend, clip_on=False)
    missed = [(i, row) for i, row in enumerate(rows) if row.get("contacts_missed_by_pruning")]
    pruned = [row["difference_to_pruned"]["torch"]["position"] for _, row in missed]
    axes.semilogx(pruned, [i for i, _ in missed], "x", color=GREY, label="to PyElastica with its pruning")
    axes.axvline(1e-11, color=GREY, linewidth=0.8)
    axes.annotate("asserted below", (1e-11, len(rows) - 0.3), color=GREY, ha="right", va="bottom")
    axes.set_yticks(place, [row["case"] for row in rows])
    axes.invert_yaxis()
    axes.set_xlim(1e-16, 1e-2)
    axes.set_xlabel("largest difference of a node's position to PyElastica, m")
    axes.legend(loc="center right")
    return figure


FIGURES = {
    "parity": _parity,
    "cantilever": _cantilever,
    "stretch": _stretch,
    "arc": _arc,
    "energy": _energy,
    "time_step": _time_step,
    "float32": _float32,
}
