"""The report's figures, drawn inside ``style.look``; None where nothing was run that they could show."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator
from scipy.stats import sem

from softgm_bench.analysis import names, paper, style
from softgm_bench.analysis.aggregate import THRESHOLDS, Aggregate, Comparison, Estimate
from softgm_bench.analysis.document import Figure
from softgm_bench.analysis.pools import Conditions, Pool, Pools
from softgm_bench.analysis.runs import Evaluation, Run
from softgm_bench.analysis.statistics import Array, Bootstrap

AXIS_NAMES = {
    "success_rate": "success rate",
    "episode_length": "episode length, steps",
    "discounted_return": "discounted return",
}
RunsByKey = Mapping[tuple[str, str], Sequence[Run]]


def learning_curves(
    key: str, runs: RunsByKey, tasks: Sequence[str], labels: Sequence[str], measures: Sequence[str], caption: str
) -> Figure | None:
    """Draw a row for each measure and a column for each task: mean over seeds, standard error shaded, seeds thin.

    Args:
        key: of the figure.
        runs: by task and algorithm.
        tasks: columns, of which those without any run are left out.
        labels: algorithms, of which those without any run are left out.
        measures: rows.
        caption: of the figure; the conditions of the evaluations are added.
    """
    tasks, labels = _present(runs, tasks, labels)
    if not tasks:
        return None
    canvas = _canvas(max(3.5 * len(tasks), 5.5), 2.3 * len(measures) + 0.5)
    panels = canvas.subplots(len(measures), len(tasks), sharex="col", squeeze=False)
    for row, measure in zip(panels, measures, strict=True):
        for axes, task in zip(row, tasks, strict=True):
            for label in labels:
                draw_curve(axes, curve(runs.get((task, label), ()), measure), label)
            axes.margins(x=0.02)
            axes.xaxis.set_major_locator(MaxNLocator(5))
            axes.xaxis.set_major_formatter(FuncFormatter(lambda frames, _: f"{frames / 1e6:g}"))
            if measure == "success_rate":
                axes.set_ylim(-0.03, 1.03)
            elif measure == "episode_length":
                axes.set_ylim(bottom=0)
        row[0].set_ylabel(AXIS_NAMES[measure])
    for top, bottom, task in zip(panels[0], panels[-1], tasks, strict=True):
        top.set_title(names.task(task), pad=8)
        bottom.set_xlabel("million frames")
    canvas.align_ylabels()
    _legend(canvas, labels)
    drawn = {task: [run for label in labels for run in runs.get((task, label), ())] for task in tasks}
    actions = names.actions(run.final for of_task in drawn.values() for run in of_task)
    limits = [f"{names.task(task)} {names.span([run.progress_horizon for run in drawn[task]])}" for task in tasks]
    caption = f"{caption} {actions.capitalize()} actions; time limit in control steps: {', '.join(limits)}."
    return Figure(key, caption, *style.save(canvas))


def curve(runs: Sequence[Run], measure: str) -> tuple[Array, Array] | None:
    """Put the runs' evaluations on common frames; None if any did not record the measure, or none is there.

    A run that was never evaluated during training is left out. Runs whose evaluations lie at the same frames keep them.
    Others are interpolated linearly at the union of their frames within the range that all of them have.

    Returns:
        The frames, ``(points,)``, and a value of each seed at each of them, ``(seeds, points)``.
    """
    progress = [sorted(run.progress, key=lambda entry: entry["frames"]) for run in runs if run.progress]
    values: Any = [[(entry.get(measure) or {}).get("mean") for entry in of_run] for of_run in progress]
    if not progress or any(None in of_run for of_run in values):
        return None
    frames = [np.array([entry["frames"] for entry in of_run], dtype=np.float64) for of_run in progress]
    grid = np.unique(np.concatenate(frames))
    grid = grid[(grid >= max(at[0] for at in frames)) & (grid <= min(at[-1] for at in frames))]
    if len(grid) == 0:
        return None
    return grid, np.stack([np.interp(grid, at, of_run) for at, of_run in zip(frames, values, strict=True)])


def draw_curve(axes: Axes, drawn: tuple[Array, Array] | None, label: str) -> None:
    """Draw what ``curve`` gave: the mean, and around it the standard error of several seeds, each of them thin."""
    if drawn is None:
        return
    (frames, seeds), look = drawn, style.line(label)
    mean = seeds.mean(axis=0)
    axes.plot(frames, mean, **look)
    if len(seeds) > 1:
        error = sem(seeds, axis=0)
        axes.fill_between(frames, mean - error, mean + error, color=look["color"], alpha=0.2, lw=0)
        axes.plot(frames, seeds.T, **_thin(label))


def time_to_target(pools: Pools, tasks: Sequence[str], labels: Sequence[str]) -> Figure | None:
    """Draw the share of episodes that reached their target within so many control steps, a panel for each task."""
    tasks, labels = _present(pools, tasks, labels)
    if not tasks:
        return None
    canvas = _canvas(max(3.5 * len(tasks), 5.5), 3.2)
    panels = canvas.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
    for axes, task in zip(panels, tasks, strict=True):
        there = [pools[task, label] for label in labels if (task, label) in pools]
        longest = max((_draw_times(axes, pool) for pool in there if pool.success_rates is not None), default=10)
        axes.set(xscale="log", xlim=(5, longest), ylim=(0, 1.03), xlabel="control steps")
        axes.xaxis.set_major_formatter(FuncFormatter(lambda steps, _: f"{steps:g}"))
        axes.xaxis.set_minor_formatter(FuncFormatter(lambda steps, _: ""))
        axes.set_title(names.task(task), pad=8)
    panels[0].set_ylabel("share of episodes at the target")
    _legend(canvas, labels)
    caption = (
        "Time to the target: share of all episodes (seeds × episodes of the final evaluations) that have reached "
        "their target after so many control steps; seeds thin. The right end is the success rate."
    )
    return Figure("time_to_target", caption, *style.save(canvas))


def _draw_times(axes: Axes, pool: Pool) -> int:
    """Draw one algorithm's line, and return the longest time that an episode could take."""
    longest = max(one.horizon or int(one.episodes["length"].max()) for one in pool.evaluations)
    for one in pool.evaluations if pool.seeds > 1 else ():
        axes.step(*_reached([one], longest), where="post", **_thin(pool.label))
    axes.step(*_reached(pool.evaluations, longest), where="post", **style.line(pool.label))
    return longest


def _reached(evaluations: Sequence[Evaluation], longest: int) -> tuple[Array, Array]:
    lengths, success = (np.concatenate([one.episodes[name] for one in evaluations]) for name in ("length", "success"))
    steps, counts = np.unique(lengths[success > 0], return_counts=True)
    share = np.cumsum(counts) / len(lengths)
    return np.concatenate([[1], steps, [longest]]), np.concatenate([[0], share, share[-1:] if len(share) else [0.0]])


def robustness(conditions: Conditions, bootstrap: Bootstrap) -> Figure | None:
    """Draw success under every condition, a panel for each task and algorithm; the paper's beside ours."""
    if not conditions:
        return None
    canvas = _canvas(max(2.9 * len(conditions) + 1.0, 5.6), 1.3 + 0.36 * max(map(len, conditions.values())))
    panels = canvas.subplots(1, len(conditions), squeeze=False)[0]
    diamond: dict[str, Any] = {"marker": "D", "color": style.SOFT, "markerfacecolor": style.PAPER, "linestyle": ""}
    for axes, ((task, label), pools) in zip(panels, conditions.items(), strict=True):
        for row, (name, pool) in enumerate(pools):
            if theirs := paper.table_two(task, label, name):
                axes.plot(theirs.success_rate / 100, row, markersize=6, clip_on=False, **diamond)
            _draw_estimate(axes, row, _success(pool, bootstrap), label)
        _rows(axes, [names.perturbation(name) for name, _ in pools], "success rate")
        axes.set_title(f"{names.algorithm(label)}, {names.task(task).lower()}", pad=8)
    disc = Line2D([], [], marker="o", linestyle="", color=style.SOFT, label="ours, 95 % interval")
    canvas.legend(handles=[disc, Line2D([], [], label="paper", **diamond)], loc="outside upper left", ncols=2)
    caption = (
        "Success under the conditions of Table II. Intervals: over seeds where there are several, else Wilson's "
        "over the episodes of the one policy."
    )
    return Figure("robustness", caption, *style.save(canvas))


def _success(pool: Pool | None, bootstrap: Bootstrap) -> Estimate | None:
    if pool is None or pool.success_rates is None:
        return None
    return Estimate(pool.success_rates.mean(), pool.success_interval(bootstrap))


def performance_profiles(entries: Sequence[Aggregate]) -> Figure | None:
    """Draw the share of runs above each success rate, over all tasks."""
    drawn = {entry.label: entry.profile for entry in entries if entry.profile}
    if not drawn:
        return None
    canvas = _canvas(6.4, 3.4)
    axes = canvas.subplots()
    for label, (share, interval) in drawn.items():
        look = style.line(label)
        axes.step(THRESHOLDS, share, where="post", **look)
        if interval is not None:
            low, high = interval
            axes.fill_between(THRESHOLDS, low, high, step="post", color=look["color"], alpha=0.18, lw=0)
    axes.set(xlim=(0, 1), ylim=(0, 1.03), xlabel="success rate τ", ylabel="share of runs above τ")
    _legend(canvas, list(drawn))
    caption = (
        "Performance profile over the runs (seeds) of all three tasks, for the algorithms that have all three; "
        "shaded: 95 % stratified bootstrap interval, where an algorithm has several seeds on every task."
    )
    return Figure("performance_profile", caption, *style.save(canvas))


def improvement(pairs: Sequence[Comparison]) -> Figure | None:
    """Draw the probability of improvement, a row for each pair of algorithms."""
    if not pairs:
        return None
    canvas = _canvas(6.4, 0.9 + 0.34 * len(pairs))
    axes = canvas.subplots()
    for row, pair in enumerate(pairs):
        _draw_estimate(axes, row, pair.estimate, pair.first)
    texts = [f"{names.algorithm(pair.first)} > {names.algorithm(pair.second)}" for pair in pairs]
    _rows(axes, texts, "probability of improvement in success rate")
    axes.axvline(0.5, color=style.SOFT, linewidth=1, linestyle=(0, (2, 2)))
    caption = (
        "Probability that a run of the first algorithm has a higher success rate than a run of the second, "
        "averaged over the tasks both have; bars: 95 % stratified bootstrap intervals. A ring has one seed on "
        "some task: no interval, and a value that says only which of the single runs was higher."
    )
    return Figure("probability_of_improvement", caption, *style.save(canvas))


def aggregate_scores(entries: Sequence[Aggregate]) -> Figure | None:
    """Draw interquartile mean and mean over the tasks."""
    complete = [entry for entry in entries if not entry.missing]
    if not complete:
        return None
    canvas = _canvas(6.8, 1.0 + 0.36 * len(complete))
    panels = canvas.subplots(1, 2, sharey=True)
    for axes, attribute, text in zip(panels, ("iqm", "mean"), ("Interquartile mean", "Mean"), strict=True):
        for row, entry in enumerate(complete):
            _draw_estimate(axes, row, getattr(entry, attribute), entry.label)
        _rows(axes, [names.algorithm(entry.label) for entry in complete], "success rate")
        axes.set_title(text, pad=8)
    caption = (
        "Success rate over the three tasks; bars: 95 % stratified bootstrap intervals. A ring has one seed on some "
        "task and therefore no interval."
    )
    return Figure("aggregates", caption, *style.save(canvas))


def _present(there: Collection[tuple[str, str]], tasks: Sequence[str], labels: Sequence[str]) -> list[list[str]]:
    """The tasks and the labels that are there with any of the others."""
    pairs = [(task, label) for task in tasks for label in labels if (task, label) in there]
    return [
        [name for name in wanted if name in {pair[place] for pair in pairs}]
        for place, wanted in enumerate((tasks, labels))
    ]


def _canvas(width: float, height: float) -> Canvas:
    return Canvas(figsize=(width, height), layout="constrained")


def _thin(label: str) -> dict[str, Any]:
    """Settings of a single seed's line."""
    return {"color": style.colour(label), "alpha": 0.3, "linewidth": 0.6, "zorder": 2}


def _legend(canvas: Canvas, labels: Sequence[str]) -> None:
    longest = max(len(names.algorithm(label)) for label in labels)
    columns = max(1, min(len(labels), int(canvas.get_figwidth() / (0.6 + 0.085 * longest))))
    handles = [Line2D([], [], label=names.algorithm(label), **style.line(label)) for label in labels]
    canvas.legend(handles=handles, loc="outside upper left", ncols=columns, handlelength=2.2, columnspacing=1.6)


def _draw_estimate(axes: Axes, row: int, estimate: Estimate | None, label: str) -> None:
    """A bar and a disc, or a ring where there is no interval."""
    if estimate is None:
        axes.text(0.02, row, "not run", color=style.SOFT, fontsize=8, va="center")
        return
    shade, face = style.colour(label), style.PAPER
    if estimate.interval is not None:
        axes.plot(estimate.interval, [row, row], color=shade, linewidth=7, alpha=0.3)
        face = shade
    axes.plot(estimate.value, row, "o", color=shade, markerfacecolor=face, markersize=7, clip_on=False, zorder=5)


def _rows(axes: Axes, texts: Sequence[str], xlabel: str) -> None:
    """A row for each text, the first at the top."""
    axes.set_yticks(range(len(texts)), texts)
    axes.set(xlim=(0, 1), ylim=(len(texts) - 0.5, -0.5), xlabel=xlabel)
    axes.tick_params(axis="y", length=0)
    axes.grid(False, axis="y")
