"""The report's figures; None where nothing was run that they could show."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure as Canvas
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from softgm_bench.analysis import names, paper, style
from softgm_bench.analysis.aggregate import THRESHOLDS, Aggregate, Comparison, Pools, Profile
from softgm_bench.analysis.curves import Curve, curve
from softgm_bench.analysis.document import Figure
from softgm_bench.analysis.pools import Pool
from softgm_bench.analysis.robustness import Perturbed, conditions_of, subjects
from softgm_bench.analysis.runs import Run

AXIS_NAMES = {
    "success_rate": "success rate",
    "episode_length": "episode length, steps",
    "discounted_return": "discounted return",
}
RunsByKey = Mapping[tuple[str, str], Sequence[Run]]


def learning_curves(
    key: str, runs: RunsByKey, tasks: Sequence[str], labels: Sequence[str], measures: Sequence[str], caption: str
) -> Figure | None:
    """A row for each measure and a column for each task: mean over seeds, standard error shaded, seeds thin.

    Args:
        key: of the figure.
        runs: by task and algorithm.
        tasks: columns, of which those without any run are left out.
        labels: algorithms, of which those without any run are left out.
        measures: rows.
        caption: of the figure; the conditions of the evaluations are added.
    """
    tasks = [task for task in tasks if any((task, label) in runs for label in labels)]
    labels = [label for label in labels if any((task, label) in runs for task in tasks)]
    if not tasks:
        return None
    with style.look():
        canvas = Canvas(figsize=(max(3.5 * len(tasks), 5.5), 2.3 * len(measures) + 0.5), layout="constrained")
        panels = canvas.subplots(len(measures), len(tasks), sharex="col", squeeze=False)
        for row, measure in zip(panels, measures, strict=True):
            for axes, task in zip(row, tasks, strict=True):
                for label in labels:
                    _draw_curve(axes, curve(runs.get((task, label), ()), measure), label)
                axes.margins(x=0.02)
                axes.xaxis.set_major_locator(MaxNLocator(5))
                axes.xaxis.set_major_formatter(FuncFormatter(lambda frames, _: f"{frames / 1e6:g}"))
                if measure == "success_rate":
                    axes.set_ylim(-0.03, 1.03)
                elif measure == "episode_length":
                    axes.set_ylim(bottom=0)
            row[0].set_ylabel(AXIS_NAMES[measure])
        for axes, task in zip(panels[0], tasks, strict=True):
            axes.set_title(names.task(task), pad=8)
        for axes in panels[-1]:
            axes.set_xlabel("million frames")
        canvas.align_ylabels()
        _legend(canvas, labels)
        return Figure(key, f"{caption} {_conditions(runs, tasks, labels)}", *style.save(canvas))


def _conditions(runs: RunsByKey, tasks: Sequence[str], labels: Sequence[str]) -> str:
    """Time limits and kind of actions of the evaluations during training."""
    limits, kinds = [], set()
    for task in tasks:
        drawn = [run for label in labels for run in runs.get((task, label), ())]
        limits.append(f"{names.task(task)} {names.span([run.progress_horizon for run in drawn])}")
        kinds |= {"deterministic" if run.final.deterministic else "sampled" for run in drawn}
    return f"{' and '.join(sorted(kinds)).capitalize()} actions; time limit in control steps: {', '.join(limits)}."


def _draw_curve(axes: Axes, drawn: Curve | None, label: str) -> None:
    if drawn is None:
        return
    look = style.line(label)
    axes.plot(drawn.frames, drawn.mean, **look)
    if len(drawn.seeds) > 1:
        axes.fill_between(
            drawn.frames, drawn.mean - drawn.error, drawn.mean + drawn.error, color=look["color"], alpha=0.2, lw=0
        )
        for values in drawn.seeds:
            axes.plot(drawn.frames, values, color=look["color"], alpha=0.3, linewidth=0.6, zorder=2)


def _legend(canvas: Canvas, labels: Sequence[str]) -> None:
    longest = max(len(names.algorithm(label)) for label in labels)
    columns = max(1, min(len(labels), int(canvas.get_figwidth() / (0.6 + 0.085 * longest))))
    handles = [Line2D([], [], label=names.algorithm(label), **style.line(label)) for label in labels]
    canvas.legend(handles=handles, loc="outside upper left", ncols=columns, handlelength=2.2, columnspacing=1.6)


def time_to_target(pools: Pools, tasks: Sequence[str], labels: Sequence[str]) -> Figure | None:
    """Share of episodes that reached their target within so many control steps, a panel for each task."""
    tasks = [task for task in tasks if any((task, label) in pools for label in labels)]
    labels = [label for label in labels if any((task, label) in pools for task in tasks)]
    if not tasks:
        return None
    with style.look():
        canvas = Canvas(figsize=(max(3.5 * len(tasks), 5.5), 3.2), layout="constrained")
        panels = canvas.subplots(1, len(tasks), sharey=True, squeeze=False)[0]
        for axes, task in zip(panels, tasks, strict=True):
            longest = 0
            for label in labels:
                pool = pools.get((task, label))
                if pool is not None and pool.success_rates is not None:
                    longest = max(longest, _draw_times(axes, pool))
            axes.set(xscale="log", xlim=(5, longest or 10), ylim=(0, 1.03), xlabel="control steps")
            axes.xaxis.set_major_formatter(FuncFormatter(lambda steps, _: f"{steps:g}"))
            axes.xaxis.set_minor_formatter(FuncFormatter(lambda steps, _: ""))
            axes.set_title(names.task(task), pad=8)
        panels[0].set_ylabel("share of episodes at the target")
        _legend(canvas, labels)
        caption = (
            "Time to the target: share of all episodes (seeds x episodes of the final evaluations) that have reached "
            "their target after so many control steps; seeds thin. The right end is the success rate."
        )
        return Figure("time_to_target", caption.replace(" x ", " × "), *style.save(canvas))


def _draw_times(axes: Axes, pool: Pool) -> int:
    look = style.line(pool.label)
    all_lengths, all_reached, longest = [], [], 0
    for evaluation in pool.evaluations:
        lengths, reached = evaluation.episodes["length"], evaluation.episodes["success"] > 0
        longest = max(longest, evaluation.horizon or int(lengths.max()))
        all_lengths.append(lengths)
        all_reached.append(reached)
    if pool.seeds > 1:
        for lengths, reached in zip(all_lengths, all_reached, strict=True):
            axes.step(
                *_reached(lengths, reached, longest), where="post", color=look["color"], alpha=0.3, lw=0.6, zorder=2
            )
    axes.step(*_reached(np.concatenate(all_lengths), np.concatenate(all_reached), longest), where="post", **look)
    return longest


def _reached(lengths: np.ndarray, success: np.ndarray, longest: int) -> tuple[np.ndarray, np.ndarray]:
    steps, counts = np.unique(lengths[success], return_counts=True)
    share = np.cumsum(counts) / len(lengths)
    return np.concatenate([[1], steps, [longest]]), np.concatenate([[0], share, share[-1:] if len(share) else [0.0]])


def robustness(nominal: Pools, perturbed: Perturbed, resamples: int, seed: int) -> Figure | None:
    """Success under every condition, a panel for each task and algorithm; the paper's beside ours."""
    drawn = [subject for subject in subjects(perturbed) if any(key[:2] == subject for key in perturbed)]
    if not drawn:
        return None
    with style.look():
        rows = max(len(conditions_of(*subject, nominal, perturbed)) for subject in drawn)
        canvas = Canvas(figsize=(max(2.9 * len(drawn) + 1.0, 5.6), 1.3 + 0.36 * rows), layout="constrained")
        for axes, subject in zip(canvas.subplots(1, len(drawn), squeeze=False)[0], drawn, strict=True):
            conditions = conditions_of(*subject, nominal, perturbed)
            for row, (name, pool) in enumerate(conditions):
                _draw_condition(axes, row, pool, paper.table_two(*subject, name), resamples, seed)
            _rows(axes, [names.perturbation(name) for name, _ in conditions])
            axes.set(xlim=(0, 1), xlabel="success rate")
            axes.set_title(f"{names.algorithm(subject[1])}, {names.task(subject[0]).lower()}", pad=8)
        ours = Line2D([], [], marker="o", linestyle="", color=style.SOFT, label="ours, 95 % interval")
        theirs = Line2D([], [], marker="D", linestyle="", color=style.SOFT, markerfacecolor=style.PAPER, label="paper")
        canvas.legend(handles=[ours, theirs], loc="outside upper left", ncols=2)
        caption = (
            "Success under the conditions of Table II. Intervals: over seeds where there are several, else Wilson's "
            "over the episodes of the one policy."
        )
        return Figure("robustness", caption, *style.save(canvas))


def _draw_condition(
    axes: Axes, row: int, pool: Pool | None, theirs: paper.Row | None, resamples: int, seed: int
) -> None:
    if theirs is not None:
        rate = theirs.success_rate / 100
        axes.plot(rate, row, "D", color=style.SOFT, markerfacecolor=style.PAPER, markersize=6, clip_on=False)
    rates, interval = (pool.success_rates, pool.success_interval(resamples, seed)) if pool else (None, None)
    if pool is None or rates is None or interval is None:
        axes.text(0.02, row, "not run", color=style.SOFT, fontsize=8, va="center")
        return
    shade = style.colour(pool.label)
    axes.plot(interval, [row, row], color=shade, linewidth=7, alpha=0.3)
    axes.plot(rates.mean(), row, "o", color=shade, markersize=7, clip_on=False, zorder=5)


def _rows(axes: Axes, texts: Sequence[str]) -> None:
    """A row for each text, the first at the top."""
    axes.set_yticks(range(len(texts)), texts)
    axes.set_ylim(len(texts) - 0.5, -0.5)
    axes.tick_params(axis="y", length=0)
    axes.grid(False, axis="y")


def performance_profiles(drawn: Sequence[Profile]) -> Figure | None:
    """Share of runs above each success rate, over all tasks."""
    if not drawn:
        return None
    with style.look():
        canvas = Canvas(figsize=(6.4, 3.4), layout="constrained")
        axes = canvas.subplots()
        for profile in drawn:
            look = style.line(profile.label)
            axes.step(THRESHOLDS, profile.share, where="post", **look)
            if profile.interval is not None:
                low, high = profile.interval
                axes.fill_between(THRESHOLDS, low, high, step="post", color=look["color"], alpha=0.18, lw=0)
        axes.set(xlim=(0, 1), ylim=(0, 1.03), xlabel="success rate τ", ylabel="share of runs above τ")
        _legend(canvas, [profile.label for profile in drawn])
        caption = (
            "Performance profile over the runs (seeds) of all three tasks, for the algorithms that have all three; "
            "shaded: 95 % stratified bootstrap interval, where an algorithm has several seeds on every task."
        )
        return Figure("performance_profile", caption, *style.save(canvas))


def improvement(drawn: Sequence[Comparison]) -> Figure | None:
    """Probability of improvement, a row for each pair of algorithms."""
    if not drawn:
        return None
    with style.look():
        canvas = Canvas(figsize=(6.4, 0.9 + 0.34 * len(drawn)), layout="constrained")
        axes = canvas.subplots()
        for row, pair in enumerate(drawn):
            shade = style.colour(pair.first)
            if pair.estimate.interval is not None:
                axes.plot(pair.estimate.interval, [row, row], color=shade, linewidth=7, alpha=0.3)
            face = shade if pair.estimate.interval is not None else style.PAPER
            axes.plot(
                pair.estimate.value, row, "o", color=shade, markerfacecolor=face, markersize=7, clip_on=False, zorder=5
            )
        axes.axvline(0.5, color=style.SOFT, linewidth=1, linestyle=(0, (2, 2)))
        texts = [f"{names.algorithm(pair.first)} > {names.algorithm(pair.second)}" for pair in drawn]
        _rows(axes, texts)
        axes.set(xlim=(0, 1), xlabel="probability of improvement in success rate")
        caption = (
            "Probability that a run of the first algorithm has a higher success rate than a run of the second, "
            "averaged over the tasks both have; bars: 95 % stratified bootstrap intervals. A ring has one seed on "
            "some task: no interval, and a value that says only which of the single runs was higher."
        )
        return Figure("probability_of_improvement", caption, *style.save(canvas))


def aggregate_scores(drawn: Sequence[Aggregate]) -> Figure | None:
    """Interquartile mean and mean over the tasks."""
    complete = [entry for entry in drawn if not entry.missing]
    if not complete:
        return None
    with style.look():
        canvas = Canvas(figsize=(6.8, 1.0 + 0.36 * len(complete)), layout="constrained")
        panels = canvas.subplots(1, 2, sharey=True)
        for axes, attribute, text in zip(panels, ("iqm", "mean"), ("Interquartile mean", "Mean"), strict=True):
            for row, entry in enumerate(complete):
                estimate, shade = getattr(entry, attribute), style.colour(entry.label)
                if estimate.interval is not None:
                    axes.plot(estimate.interval, [row, row], color=shade, linewidth=7, alpha=0.3)
                face = shade if estimate.interval is not None else style.PAPER
                axes.plot(
                    estimate.value, row, "o", color=shade, markerfacecolor=face, markersize=7, clip_on=False, zorder=5
                )
            axes.set_title(text, pad=8)
            _rows(axes, [names.algorithm(entry.label) for entry in complete])
            axes.set(xlim=(0, 1), xlabel="success rate")
        caption = (
            "Success rate over the three tasks; bars: 95 % stratified bootstrap intervals. A ring has one seed on some "
            "task and therefore no interval."
        )
        return Figure("aggregates", caption, *style.save(canvas))
