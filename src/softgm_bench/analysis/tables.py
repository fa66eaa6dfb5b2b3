"""The report's tables: ours beside the paper's, statistics over tasks, and every source; what was not run says so."""

from collections.abc import Sequence

from scipy.stats import rankdata

from softgm_bench.analysis import names, paper
from softgm_bench.analysis.aggregate import Aggregate, Comparison, Estimate
from softgm_bench.analysis.document import Cell, Column, Table
from softgm_bench.analysis.interventions import Pair
from softgm_bench.analysis.pools import (
    MARKS,
    SEEDS,
    Conditions,
    Pool,
    Pools,
    condition,
    equal_frames,
    lead,
    wilson,
)
from softgm_bench.analysis.runs import Evaluation, Problem, Run
from softgm_bench.analysis.statistics import Bootstrap

Row = list[Cell | str]  # a plain cell may be its text
SIGNIFICANT = "*"
NOT_RUN, NOT_RECORDED, ONE_SEED, DASH = (Cell(text, muted=True) for text in ("not run", "not recorded", "1 seed", "—"))


def _texts(*headings: str) -> list[Column]:
    return [Column(heading, numeric=False) for heading in headings]


def _numbers(*headings: str, group: str = "") -> list[Column]:
    return [Column(heading, group) for heading in headings]


def _table(key: str, caption: str, columns: Sequence[Column], rows: Sequence[Row], notes: Sequence[str] = ()) -> Table:
    assert all(len(row) == len(columns) for row in rows), key
    cells = [[Cell(cell) if isinstance(cell, str) else cell for cell in row] for row in rows]
    return Table(key, caption, columns, cells, notes)


# Heading of a measure, its column of the episodes and its digits, the paper's name for it and the paper's digits.
MEASURES = (
    ("Episode length", "length", 1, "episode_length", 1),
    ("Tip travel, m", "tip_travel_distance", 2, "tip_travel_distance", 4),
    ("Torque, all agents, N m", "torque_joint", 2, "torque", 2),
)
BESIDE_THE_PAPER = [
    *_numbers("ours", "95 % interval", "paper", group="Success, %"),
    *(column for heading, *_ in MEASURES for column in _numbers("ours", "paper", group=heading)),
    *_numbers("Torque per agent, N m"),
]


def _beside_the_paper(
    pool: Pool | None, theirs: paper.Row | None, bootstrap: Bootstrap, best: bool = False, mark: str = ""
) -> Row:
    row = _success(pool, bootstrap, best, mark)
    row.append(Cell(f"{theirs.success_rate:.2f}", muted=True) if theirs else "")
    for _, column, digits, attribute, their_digits in MEASURES:
        values = getattr(theirs, attribute) if theirs else None
        dash = DASH if theirs else ""
        row += [_spread(pool, column, digits), Cell(names.spread(values, their_digits), muted=True) if values else dash]
    return [*row, _spread(pool, "torque_per_agent", 2)]


def _success(pool: Pool | None, bootstrap: Bootstrap, best: bool = False, mark: str = "") -> Row:
    if pool is None:
        return [NOT_RUN, ""]
    rates, interval = pool.success_rates, pool.success_interval(bootstrap)
    if rates is None or interval is None:
        return [NOT_RECORDED, ""]
    bounds = names.percent_interval(interval) + (" (1 seed)" if pool.seeds == 1 else "")
    return [Cell(names.percent(rates.mean()) + mark, strong=best), bounds]


def _spread(pool: Pool | None, column: str, digits: int) -> Cell | str:
    if pool is None:
        return NOT_RUN
    values = pool.statistic(column)
    return names.spread(values, digits) if values else NOT_RECORDED


def table_one(task: str, pools: Pools, labels: Sequence[str], bootstrap: Bootstrap) -> Table:
    """Put the paper's Table I of one task beside ours, and other algorithms that were run on it below."""
    ranks = _success_ranks(task, pools, labels)
    columns = [*_texts("Algorithm", "recipe"), *_numbers("frames, M", "minutes", "seeds × episodes", "rank")]
    columns += BESIDE_THE_PAPER
    rows: list[Row] = []
    for label in labels:
        pool, rank = pools.get((task, label)), ranks.get(label)
        mark = SIGNIFICANT if _differs(pool, pools.get((task, "softgm")), bootstrap) else ""
        results = _beside_the_paper(pool, paper.table_one(task, label), bootstrap, rank == 1, mark)
        rows.append([_name(label, pool), *_budget(pool), _size(pool), _rank(pool, rank), *results])
    number = f"Table I, {names.task(task)}."
    if task not in paper.TASKS:
        number = f"{names.task(task)} (not in the paper)."
        rows = [[cell for cell, column in zip(row, columns, strict=True) if column.name != "paper"] for row in rows]
        columns = [column for column in columns if column.name != "paper"]
    there = [pools[task, label] for label in labels if (task, label) in pools]
    caption = f"{number} Mean ± standard deviation over seeds × episodes. {_protocol(there)}"
    return _table(f"one-{task}", caption, columns, rows, [*_comparability(there), *_notes(there)])


def _budget(pool: Pool | None) -> Row:
    """Recipe, frames and minutes of the trainings."""
    if pool is None:
        return ["", "", ""]
    return [pool.recipe, names.span(pool.frames, 1e6, 2), names.span([round(minutes) for minutes in pool.minutes])]


def _success_ranks(task: str, pools: Pools, labels: Sequence[str]) -> dict[str, int]:
    """Rank by success rate of those that compete, if two or more are ``comparable``; equal rates share a rank."""
    ranked = {label: pools[task, label] for label in labels if (task, label) in pools and pools[task, label].ranked}
    rates = {
        label: pool.success_rates.mean()
        for label, pool in ranked.items()
        if pool.success_rates is not None and pool.seeds >= SEEDS
    }
    if len(rates) < 2 or not equal_frames([ranked[label] for label in rates]):
        return {}
    ranks = rankdata([-rate for rate in rates.values()], method="min")
    return dict(zip(rates, map(int, ranks), strict=True))


def _rank(pool: Pool | None, rank: int | None) -> Cell | str:
    """The rank, or what is missing for one."""
    if pool is None:
        return ""
    if rank is not None:
        return str(rank)
    if not pool.ranked:
        return Cell("not ranked", muted=True)
    return Cell(f"{pool.seeds} of {SEEDS} seeds", muted=True) if pool.seeds < SEEDS else DASH


def _differs(pool: Pool | None, full: Pool | None, bootstrap: Bootstrap) -> bool:
    """Tell whether the interval over seeds of the difference of an algorithm's success to SoftGM's leaves out 0."""
    found = None if pool is None or full is None else lead(pool, full, bootstrap)
    return found is not None and (found[1] > 0.0 or found[2] < 0.0)


def _comparability(pools: Sequence[Pool]) -> list[str]:
    """Say what ranks and marks need, and what is missing for them."""
    ranked = [pool for pool in pools if pool.ranked]
    enough = [pool for pool in ranked if pool.seeds >= SEEDS]
    notes = []
    if ranked and (len(enough) < len(ranked) or not equal_frames(enough)):
        why = f"Ranked are algorithms with {SEEDS} seeds or more if all of these had equal frames"
        have = f"{len(enough)} of {len(ranked)} have the seeds"
        notes.append(f"{why}: {have}{'' if equal_frames(enough) else ', with unequal frames'}.")
    if any(pool.label == "softgm" for pool in enough) and len(enough) > 1:
        notes.append(f"{SIGNIFICANT} the 95 % interval over seeds of the difference to SoftGM leaves out 0.")
    return notes


def success_by_step(pools: Pools) -> Table:
    """Show how many episodes have succeeded by so many control steps, for everything that was run."""
    from softgm_bench.episodes.summary import STEPS, success_by_step  # brings torch along

    columns = [*_texts("Task", "Algorithm"), *_numbers("seeds × episodes")]
    columns += _numbers(*(f"{step:,}" for step in STEPS), group="Success by step, %")
    recorded = {key: pool for key, pool in sorted(pools.items(), key=_by_task) if pool.success_rates is not None}
    rows: list[Row] = []
    for (task, label), pool in recorded.items():
        by_seed = [success_by_step(one.episodes, one.horizon) for one in pool.evaluations]
        shares = [[of_seed[step] for of_seed in by_seed if step in of_seed] for step in map(str, STEPS)]
        means = [names.percent(sum(found) / pool.seeds) if len(found) == pool.seeds else DASH for found in shares]
        rows.append([names.task(task), _name(label, pool), _size(pool), *means])
    there = list(recorded.values())
    caption = f"Success by control step, mean over seeds; a dash: episodes were not that long. {_protocol(there)}"
    return _table("by-step", caption, columns, rows, _notes(there))


def _by_task(item: tuple[tuple[str, str], Pool]) -> tuple:
    """Order as the tables above do: the paper's tasks and algorithms first, others by name."""
    (task, label), _ = item
    orders = (list(paper.TASKS), task), ([*paper.ALGORITHMS, *paper.ABLATIONS], label)
    return *(order.index(name) if name in order else len(order) for order, name in orders), task, label


def table_two(nominal: Pools, conditions: Conditions, bootstrap: Bootstrap) -> Table:
    """Put the paper's Table II beside every task, algorithm and condition that was evaluated."""
    columns = [*_texts("Task", "Algorithm", "Condition"), *_numbers("seeds × episodes"), *BESIDE_THE_PAPER]
    rows: list[Row] = []
    for (task, label), pools in conditions.items():
        name = _name(label, nominal.get((task, label)))
        for perturbation, pool in pools:
            results = _beside_the_paper(pool, paper.table_two(task, label, perturbation), bootstrap)
            rows.append([task, name, names.perturbation(perturbation), _size(pool), *results])
    there = [pool for pools in conditions.values() for _, pool in pools if pool]
    caption = f"Table II, robustness. Mean ± standard deviation over seeds × episodes. {_protocol(there)}"
    found = {condition(evaluation) for pool in there for evaluation in pool.evaluations} - {"none"}
    notes = [f"Conditions: {'; '.join(map(names.perturbation, sorted(found)))}."] if found else []
    return _table("two", caption, columns, rows, [*notes, *_notes(there)])


def ablations(pools: Pools, bootstrap: Bootstrap) -> Table:
    """Compare SoftGM with and without each of its stages, on every task."""
    success = _numbers("mean", "95 % interval", "against full", group="Success, %")
    columns = [*_texts("Task", "Model"), *_numbers("seeds × episodes"), *success, *_numbers("Episode length")]
    keys = [(task, label) for task in paper.TASKS for label in paper.ABLATIONS]
    rows: list[Row] = []
    for task, label in keys:
        pool = pools.get((task, label))
        difference = _difference(pool, pools.get((task, "softgm"))) if label != "softgm" else DASH
        results = [*_success(pool, bootstrap), difference, _spread(pool, "length", 1)]
        rows.append([names.task(task), _name(label, pool), _size(pool), *results])
    there = [pools[key] for key in keys if key in pools]
    caption = f"Ablations: SoftGM without stage 1 (entity to agent) or stage 2 (agent to agent). {_protocol(there)}"
    return _table("ablations", caption, columns, rows, _notes(there))


def _difference(pool: Pool | None, full: Pool | None) -> Cell | str:
    """In percentage points."""
    if pool is None or full is None or pool.success_rates is None or full.success_rates is None:
        return NOT_RUN
    return _points(pool.success_rates.mean() - full.success_rates.mean())


def _points(difference: float) -> str:
    return f"{100 * difference:+.1f}".replace("-", "−")


def _name(label: str, pool: Pool | None) -> str:
    return names.algorithm(label) + (pool.marks if pool else "")


def _size(pool: Pool | None) -> Cell | str:
    """Seeds x episodes."""
    if pool is None:
        return NOT_RUN
    return f"{pool.seeds} × {names.span([len(evaluation.episodes['length']) for evaluation in pool.evaluations])}"


def _protocol(pools: Sequence[Pool]) -> str:
    """Frames of training, horizon and kind of actions of everything in a table."""
    evaluations = [evaluation for pool in pools for evaluation in pool.evaluations]
    if not evaluations:
        return "Nothing was run."
    frames = names.span([evaluation.frames for evaluation in evaluations], 1e6, 2)
    horizons = [evaluation.horizon for evaluation in evaluations if evaluation.horizon is not None]
    limit = f"at most {names.span(horizons)} control steps" if horizons else "time limit not recorded"
    return f"Trained with {frames} million frames; {limit}, {names.actions(evaluations)} actions."


def _notes(pools: Sequence[Pool]) -> list[str]:
    """Explain marks and intervals; say how many episodes the simulation broke, which count as failures."""
    notes = [f"{mark} {text}." for mark, text in MARKS.items() if any(mark in pool.marks for pool in pools)]
    if any(pool.seeds == 1 for pool in pools):
        notes.append(
            "1 seed: the interval is Wilson's over the episodes of the one policy; it holds nothing about seeds."
        )
    recorded = [(pool, diverged) for pool in pools if (diverged := pool.column("diverged"))]
    broken = [
        f"{names.algorithm(pool.label)} {count:,} of {sum(map(len, diverged)):,}"
        for pool, diverged in recorded
        if (count := int(sum(of_seed.sum() for of_seed in diverged)))
    ]
    if recorded:
        notes.append(f"Episodes that diverged, counted as failures: {', '.join(broken) or 'none'}.")
    return notes


def aggregates(entries: Sequence[Aggregate]) -> Table:
    """Show interquartile mean and mean success over the tasks."""
    success = _numbers("IQM", "95 % interval", "mean", "95 % interval", group="Success over all tasks, %")
    columns = [*_texts("Algorithm"), *_numbers("seeds per task"), *success, *_texts("not run, or not ranked, on")]
    rows: list[Row] = []
    for entry in entries:
        missing = Cell(", ".join(map(names.task, entry.missing)), muted=True)
        estimates = [*_estimate(entry.iqm), *_estimate(entry.mean)]
        rows.append([names.algorithm(entry.label), ", ".join(map(str, entry.seeds)), *estimates, missing])
    absent = [names.algorithm(label) for label in paper.ALGORITHMS if label not in {entry.label for entry in entries}]
    notes = [f"Not run on any task: {', '.join(absent)}."] if absent else []
    caption = (
        "Success over the paper's three tasks: interquartile mean (IQM) and mean, with stratified bootstrap intervals "
        "over seeds. A single seed gives none; a task that is missing leaves both out."
    )
    return _table("aggregates", caption, columns, rows, notes)


def _estimate(estimate: Estimate | None) -> Row:
    if estimate is None:
        return [NOT_RUN, ""]
    bounds = ONE_SEED if estimate.interval is None else names.percent_interval(estimate.interval)
    return [names.percent(estimate.value), bounds]


def comparisons(pairs: Sequence[Comparison]) -> Table:
    """Show the probability of improvement of each pair."""
    results = _numbers("seeds, at least", "P(higher success)", "95 % interval")
    rows: list[Row] = []
    for first, second, tasks, seeds, (value, interval) in pairs:
        bounds = ONE_SEED if interval is None else f"[{interval[0]:.2f}, {interval[1]:.2f}]"
        subjects = [names.algorithm(first), names.algorithm(second), ", ".join(map(names.task, tasks))]
        rows.append([*subjects, f"{seeds[0]} and {seeds[1]}", f"{value:.2f}", bounds])
    caption = (
        "Probability of improvement: how often a run of the first algorithm has a higher success rate than a run of "
        "the second, a tie counting one half, averaged over the tasks both have."
    )
    return _table("improvement", caption, [*_texts("Algorithm", "against", "tasks"), *results], rows)


def interventions(pairs: Sequence[Pair]) -> Table:
    """Show what each intervention costs a policy, on the same scenes."""
    success = _numbers("without", "with", "difference, points", group="Success, %")
    discordant = _numbers("only without", "only with", "exact p", group="Episodes that succeed")
    columns = [*_texts("Task", "Algorithm", "Condition", "Intervention"), *_numbers("seed", "episodes")]
    columns += [*success, *discordant, *_texts("not compared, because")]
    rows = [_intervention(pair) for pair in pairs]
    caption = (
        "Interventions: what a policy is shown is changed, the world and its scenes are not. Each row compares one "
        "policy's episodes with those it had without, one by one. "
    )
    caption += _protocol([Pool((pair.intervened,)) for pair in pairs])
    notes = [
        "exact p: McNemar's test, two-sided, of the episodes in which only one of the two succeeds. It holds nothing "
        "about seeds, and rows are not corrected for their number."
    ]
    return _table("interventions", caption, columns, rows, notes)


def _intervention(pair: Pair) -> Row:
    one, plain, found = pair.intervened, pair.plain, pair.discordance
    subject: Row = [names.task(one.task), names.algorithm(one.label), names.perturbation(condition(one))]
    subject += [one.intervention.replace("_", " "), str(one.seed), str(len(one.episodes["length"]))]
    if plain is None or found is None:
        return [*subject, *[DASH] * 6, Cell(pair.reason, muted=True)]
    rates = [one_of.episodes["success"].mean() for one_of in (plain, one)]
    difference = _points(rates[1] - rates[0])
    tested: Row = [str(found.lost), str(found.won), f"{found.p:.2g}"]
    return [*subject, *map(names.percent, rates), difference, *tested, ""]


SOURCE = [*_texts("Task", "Algorithm"), *_numbers("seed")]
RESULT = [
    *_numbers("episodes"),
    *_numbers("mean", "95 % interval", group="Success, %"),
    *_numbers("Episode length", "diverged"),
]


def sources(runs: Sequence[Run]) -> Table:
    """List every run, with Wilson's interval of its success rate."""
    columns = [*SOURCE, *_numbers("frames", "minutes"), *RESULT, *_numbers("time limit"), *_texts("source")]
    rows: list[Row] = []
    for run in runs:
        amounts = [f"{run.final.frames:,}", f"{run.minutes:.0f}"]
        limit, folder = f"{run.final.horizon:,}", Cell(run.final.folder, muted=True)
        rows.append([*_source(run.final), *amounts, *_result(run.final), limit, folder])
    caption = "Every run that the tables and figures hold, with Wilson's 95 % interval over its episodes."
    return _table("sources", caption, columns, rows)


def evaluation_sources(evaluations: Sequence[Evaluation]) -> Table:
    """List every evaluation beside training, whatever its settings."""
    columns = [*SOURCE, *_texts("Condition", "other settings"), *RESULT, *_texts("source")]
    rows: list[Row] = []
    for one in evaluations:
        shown = [f"intervention={one.intervention}"] if one.intervened else []
        settings = [names.perturbation(condition(one)), " ".join([*one.overrides, *shown])]
        rows.append([*_source(one), *settings, *_result(one), Cell(one.folder, muted=True)])
    caption = "Every evaluation beside training, with Wilson's 95 % interval over its episodes."
    return _table("evaluations", caption, columns, rows)


def _source(evaluation: Evaluation) -> Row:
    return [names.task(evaluation.task), evaluation.label, str(evaluation.seed)]


def _result(evaluation: Evaluation) -> Row:
    episodes = evaluation.episodes
    success: Row = [NOT_RECORDED, ""]
    if "success" in episodes:
        success = [names.percent(episodes["success"].mean()), names.percent_interval(wilson(evaluation))]
    diverged = str(int(episodes["diverged"].sum())) if "diverged" in episodes else "not recorded"
    return [str(len(episodes["length"])), *success, _spread(Pool((evaluation,)), "length", 1), diverged]


def left_out(problems: Sequence[Problem], replaced: Sequence[tuple[Run, Run]]) -> Table:
    """List what lies in the folder and is in no table, and why."""
    rows: list[Row] = [[problem.folder, problem.reason] for problem in problems]
    for old, new in replaced:
        why = f"same task, algorithm and seed as {new.final.folder}, which has as many frames or more"
        rows.append([old.final.folder, why])
    return _table("left-out", "Found, and in no table or figure.", _texts("folder", "why"), rows)
