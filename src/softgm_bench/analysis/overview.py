"""Tables of statistics over tasks, of every source, and of what was left out."""

from collections.abc import Sequence

from softgm_bench.analysis import names, paper
from softgm_bench.analysis.aggregate import Aggregate, Comparison, Estimate
from softgm_bench.analysis.document import MISSING, Cell, Column, Table
from softgm_bench.analysis.pools import condition, wilson
from softgm_bench.analysis.runs import Evaluation, Problem, Run


def aggregates(entries: Sequence[Aggregate]) -> Table:
    """Interquartile mean and mean success over the tasks."""
    columns = [
        Column("Algorithm", numeric=False),
        Column("seeds per task"),
        Column("IQM", "Success over all tasks, %"),
        Column("95 % interval", "Success over all tasks, %"),
        Column("mean", "Success over all tasks, %"),
        Column("95 % interval", "Success over all tasks, %"),
        Column("not run, or not ranked, on", numeric=False),
    ]
    rows = [
        [
            Cell(names.algorithm(entry.label)),
            Cell(", ".join(map(str, entry.seeds))),
            *_estimate(entry.iqm),
            *_estimate(entry.mean),
            Cell(", ".join(map(names.task, entry.missing)), muted=True),
        ]
        for entry in entries
    ]
    absent = [names.algorithm(label) for label in paper.ALGORITHMS if label not in {entry.label for entry in entries}]
    notes = [f"Not run on any task: {', '.join(absent)}."] if absent else []
    caption = (
        "Success over the paper's three tasks: interquartile mean (IQM) and mean, with stratified bootstrap intervals "
        "over seeds. A single seed gives none; a task that is missing leaves both out."
    )
    return Table("aggregates", caption, columns, rows, notes)


def comparisons(pairs: Sequence[Comparison]) -> Table:
    """Probability of improvement."""
    columns = [
        Column("Algorithm", numeric=False),
        Column("against", numeric=False),
        Column("tasks", numeric=False),
        Column("seeds, at least"),
        Column("P(higher success)"),
        Column("95 % interval"),
    ]
    rows = []
    for pair in pairs:
        interval = pair.estimate.interval
        bounds = f"[{interval[0]:.2f}, {interval[1]:.2f}]" if interval else "1 seed"
        rows.append(
            [
                Cell(names.algorithm(pair.first)),
                Cell(names.algorithm(pair.second)),
                Cell(", ".join(map(names.task, pair.tasks))),
                Cell(f"{pair.seeds[0]} and {pair.seeds[1]}"),
                Cell(f"{pair.estimate.value:.2f}"),
                Cell(bounds, muted=interval is None),
            ]
        )
    caption = (
        "Probability of improvement: how often a run of the first algorithm has a higher success rate than a run of "
        "the second, a tie counting one half, averaged over the tasks both have."
    )
    return Table("improvement", caption, columns, rows)


def _estimate(estimate: Estimate | None) -> list[Cell]:
    if estimate is None:
        return [MISSING, Cell("")]
    bounds = names.percent_interval(estimate.interval) if estimate.interval else "1 seed"
    return [Cell(names.percent(estimate.value)), Cell(bounds, muted=estimate.interval is None)]


def sources(runs: Sequence[Run]) -> Table:
    """One row a run, with Wilson's interval of its success rate."""
    columns = [
        Column("Task", numeric=False),
        Column("Algorithm", numeric=False),
        Column("seed"),
        Column("frames"),
        Column("minutes"),
        *_result_columns(),
        Column("time limit"),
        Column("source", numeric=False),
    ]
    rows = [
        [
            Cell(names.task(run.final.task)),
            Cell(run.final.label),
            Cell(str(run.final.seed)),
            Cell(f"{run.final.frames:,}"),
            Cell(f"{run.summary['wall_time'] / 60:.0f}"),
            *_result(run.final),
            Cell(f"{run.final.horizon:,}"),
            Cell(run.final.folder, muted=True),
        ]
        for run in runs
    ]
    caption = "Every run that the tables and figures hold, with Wilson's 95 % interval over its episodes."
    return Table("sources", caption, columns, rows)


def evaluation_sources(evaluations: Sequence[Evaluation]) -> Table:
    """One row an evaluation beside training, whatever its settings."""
    columns = [
        Column("Task", numeric=False),
        Column("Algorithm", numeric=False),
        Column("seed"),
        Column("Condition", numeric=False),
        Column("other settings", numeric=False),
        *_result_columns(),
        Column("source", numeric=False),
    ]
    rows = [
        [
            Cell(names.task(evaluation.task)),
            Cell(evaluation.label),
            Cell(str(evaluation.seed)),
            Cell(names.perturbation(condition(evaluation))),
            Cell(" ".join(evaluation.overrides)),
            *_result(evaluation),
            Cell(evaluation.folder, muted=True),
        ]
        for evaluation in evaluations
    ]
    caption = "Every evaluation beside training, with Wilson's 95 % interval over its episodes."
    return Table("evaluations", caption, columns, rows)


def left_out(problems: Sequence[Problem], replaced: Sequence[tuple[Run, Run]]) -> Table:
    """What lies in the folder and is in no table, and why."""
    rows = [[Cell(problem.folder), Cell(problem.reason)] for problem in problems]
    rows += [
        [
            Cell(old.final.folder),
            Cell(f"same task, algorithm and seed as {new.final.folder}, which has as many frames or more"),
        ]
        for old, new in replaced
    ]
    columns = [Column("folder", numeric=False), Column("why", numeric=False)]
    return Table("left-out", "Found, and in no table or figure.", columns, rows)


def _result_columns() -> list[Column]:
    return [
        Column("episodes"),
        Column("mean", "Success, %"),
        Column("95 % interval", "Success, %"),
        Column("Episode length"),
        Column("diverged"),
    ]


def _result(evaluation: Evaluation) -> list[Cell]:
    episodes = evaluation.episodes
    length = episodes["length"]
    success = [Cell("not recorded", muted=True), Cell("")]
    if "success" in episodes:
        success = [
            Cell(names.percent(float(episodes["success"].mean()))),
            Cell(names.percent_interval(wilson(evaluation))),
        ]
    diverged = str(int(episodes["diverged"].sum())) if "diverged" in episodes else "not recorded"
    spread = names.spread((float(length.mean()), float(length.std())), 1)
    return [Cell(str(len(length))), *success, Cell(spread or ""), Cell(diverged)]
