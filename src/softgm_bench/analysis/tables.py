"""The report's tables: ours beside the paper's; what was not run says so."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from softgm_bench.analysis import names, paper
from softgm_bench.analysis.document import MISSING, Cell, Column, Table
from softgm_bench.analysis.pools import MARKS, Pool, condition
from softgm_bench.analysis.robustness import Perturbed, conditions_of, subjects

Pools = Mapping[tuple[str, str], Pool]
DASH = Cell("—", muted=True)
NONE = Cell("")


@dataclass(frozen=True)
class Measure:
    """A column of the paper's tables: ours, theirs, and how many digits each has."""

    heading: str
    ours: str
    theirs: str
    digits: int
    their_digits: int


MEASURES = (
    Measure("Episode length", "episode_length", "episode_length", 1, 1),
    Measure("Tip travel, m", "tip_travel_distance", "tip_travel_distance", 2, 4),
    Measure("Torque, all agents, N m", "torque_joint", "torque", 2, 2),
)
COLUMN_OF = {"episode_length": "length"}


@dataclass(frozen=True)
class Drawing:
    """How intervals over seeds are drawn."""

    resamples: int
    seed: int


def table_one(task: str, pools: Pools, labels: Sequence[str], drawing: Drawing) -> Table:
    """The paper's Table I for one task, and other algorithms that were run on it, below."""
    known = task in paper.TASKS
    columns = [
        Column("Algorithm", numeric=False),
        Column("seeds × episodes"),
        Column("rank"),
        *_grouped("Success, %", ["ours", "95 % interval", *(["paper"] if known else [])]),
    ]
    for measure in MEASURES:
        columns += _grouped(measure.heading, ["ours", *(["paper"] if known else [])])
    columns += [Column("Torque per agent, N m")]
    ranks = success_ranks(task, pools, labels)
    rows = [_row_one(task, label, pools.get((task, label)), ranks, known, drawing) for label in labels]
    there = [pool for label in labels if (pool := pools.get((task, label)))]
    number = f"Table I, {names.task(task)}." if known else f"{names.task(task)} (not in the paper)."
    caption = f"{number} Mean ± standard deviation over seeds × episodes. {_protocol(there)}"
    return Table(f"one-{task}", caption, columns, rows, _notes(there))


def _row_one(
    task: str, label: str, pool: Pool | None, ranks: Mapping[str, int], known: bool, drawing: Drawing
) -> list[Cell]:
    theirs = paper.table_one(task, label)
    best = ranks.get(label) == 1
    name = names.algorithm(label) + (pool.marks if pool else "")
    row = [Cell(name), _size(pool), _rank(pool, ranks.get(label))]
    row += _success(pool, best, drawing)
    if known:
        row.append(_paper_success(theirs))
    for measure in MEASURES:
        row.append(_ours(pool, measure))
        if known:
            row.append(_theirs(theirs, measure))
    row.append(_number(pool, names.spread(pool.statistic("torque_per_agent") if pool else None, 2)))
    return row


def success_ranks(task: str, pools: Pools, labels: Sequence[str]) -> dict[str, int]:
    """Rank by success rate of those that compete, if there are two or more; equal rates share a rank."""
    rates = {
        label: float(pool.success_rates.mean())
        for label in labels
        if (pool := pools.get((task, label))) and pool.ranked and pool.success_rates is not None
    }
    if len(rates) < 2:
        return {}
    return {label: 1 + sum(other > rate for other in rates.values()) for label, rate in rates.items()}


def table_two(nominal: Pools, perturbed: Perturbed, drawing: Drawing) -> Table:
    """The paper's Table II, and every other task, algorithm and condition that was evaluated."""
    columns = [
        Column("Task", numeric=False),
        Column("Algorithm", numeric=False),
        Column("Condition", numeric=False),
        Column("seeds × episodes"),
        *_grouped("Success, %", ["ours", "95 % interval", "paper"]),
    ]
    for measure in MEASURES:
        columns += _grouped(measure.heading, ["ours", "paper"])
    columns += [Column("Torque per agent, N m")]
    rows, there, conditions = [], [], set()
    for task, label in subjects(perturbed):
        marks = nominal[task, label].marks if (task, label) in nominal else ""
        for name, pool in conditions_of(task, label, nominal, perturbed):
            theirs = paper.table_two(task, label, name)
            rows.append(
                [
                    Cell(task),
                    Cell(names.algorithm(label) + marks),
                    Cell(names.perturbation(name)),
                    _size(pool),
                    *_success(pool, False, drawing),
                    _paper_success(theirs),
                    *(cell for measure in MEASURES for cell in (_ours(pool, measure), _theirs(theirs, measure))),
                    _number(pool, names.spread(pool.statistic("torque_per_agent") if pool else None, 2)),
                ]
            )
            if pool:
                there.append(pool)
                conditions |= {condition(evaluation) for evaluation in pool.evaluations} - {"none"}
    caption = f"Table II, robustness. Mean ± standard deviation over seeds × episodes. {_protocol(there)}"
    notes = [f"Conditions: {'; '.join(map(names.perturbation, sorted(conditions)))}."] if conditions else []
    return Table("two", caption, columns, rows, [*notes, *_notes(there)])


def ablations(pools: Pools, drawing: Drawing) -> Table:
    """SoftGM with and without each of its stages, on every task."""
    columns = [Column("Task", numeric=False), Column("Model", numeric=False), *_run_columns()]
    rows, there = [], []
    for task in paper.TASKS:
        full = pools.get((task, "softgm"))
        for label in paper.ABLATIONS:
            pool = pools.get((task, label))
            rows.append(
                [
                    Cell(names.task(task)),
                    Cell(names.algorithm(label) + (pool.marks if pool else "")),
                    _size(pool),
                    *_success(pool, False, drawing),
                    _difference(pool, full) if label != "softgm" else DASH,
                    _ours(pool, MEASURES[0]),
                ]
            )
            there += [pool] if pool else []
    caption = f"Ablations: SoftGM without stage 1 (entity to agent) or stage 2 (agent to agent). {_protocol(there)}"
    return Table("ablations", caption, columns, rows, _notes(there))


def _run_columns() -> list[Column]:
    return [
        Column("seeds × episodes"),
        *_grouped("Success, %", ["mean", "95 % interval", "against full"]),
        Column("Episode length"),
    ]


def _difference(pool: Pool | None, full: Pool | None) -> Cell:
    """In percentage points."""
    if pool is None or full is None or pool.success_rates is None or full.success_rates is None:
        return MISSING
    return Cell(f"{100 * (pool.success_rates.mean() - full.success_rates.mean()):+.1f}".replace("-", "−"))


def _grouped(group: str, members: Sequence[str]) -> list[Column]:
    return [Column(member, group) for member in members]


def _size(pool: Pool | None) -> Cell:
    """Seeds x episodes."""
    if pool is None:
        return MISSING
    return Cell(f"{pool.seeds} × {names.span([len(evaluation.episodes['length']) for evaluation in pool.evaluations])}")


def _rank(pool: Pool | None, rank: int | None) -> Cell:
    if pool is None:
        return NONE
    if rank is None:
        return DASH if pool.ranked else Cell("not ranked", muted=True)
    return Cell(str(rank))


def _success(pool: Pool | None, best: bool, drawing: Drawing) -> list[Cell]:
    if pool is None:
        return [MISSING, NONE]
    rates, interval = pool.success_rates, pool.success_interval(drawing.resamples, drawing.seed)
    if rates is None or interval is None:
        return [Cell("not recorded", muted=True), NONE]
    bounds = names.percent_interval(interval) + (" (1 seed)" if pool.seeds == 1 else "")
    return [Cell(names.percent(float(rates.mean())), strong=best), Cell(bounds)]


def _ours(pool: Pool | None, measure: Measure) -> Cell:
    column = COLUMN_OF.get(measure.ours, measure.ours)
    return _number(pool, names.spread(pool.statistic(column) if pool else None, measure.digits))


def _number(pool: Pool | None, text: str | None) -> Cell:
    if pool is None:
        return MISSING
    return Cell("not recorded", muted=True) if text is None else Cell(text)


def _theirs(row: paper.Row | None, measure: Measure) -> Cell:
    if row is None:
        return NONE
    text = names.spread(getattr(row, measure.theirs), measure.their_digits)
    return DASH if text is None else Cell(text, muted=True)


def _paper_success(row: paper.Row | None) -> Cell:
    return NONE if row is None else Cell(f"{row.success_rate:.2f}", muted=True)


def _protocol(pools: Sequence[Pool]) -> str:
    """Frames of training, horizon and kind of actions of everything in a table."""
    evaluations = [evaluation for pool in pools for evaluation in pool.evaluations]
    if not evaluations:
        return "Nothing was run."
    frames = names.span([evaluation.frames for evaluation in evaluations], 1e6, 2)
    horizons = sorted({evaluation.horizon for evaluation in evaluations if evaluation.horizon is not None})
    kinds = sorted({"deterministic" if evaluation.deterministic else "sampled" for evaluation in evaluations})
    limit = f"at most {names.span(horizons)} control steps" if horizons else "time limit not recorded"
    return f"Trained with {frames} million frames; {limit}, {' and '.join(kinds)} actions."


def _notes(pools: Sequence[Pool]) -> list[str]:
    used = {mark for pool in pools for mark in pool.marks}
    notes = [f"{mark} {text}." for mark, text in MARKS.items() if mark in used]
    if any(pool.seeds == 1 for pool in pools):
        notes.append(
            "1 seed: the interval is Wilson's over the episodes of the one policy; it holds nothing about seeds."
        )
    return [*notes, *_diverged(pools)]


def _diverged(pools: Sequence[Pool]) -> list[str]:
    """How many episodes ended because the simulation broke; they count as failures."""
    counted = [(pool, pool.diverged) for pool in pools if pool.diverged is not None]
    if not counted:
        return []
    broken = [
        f"{names.algorithm(pool.label)} {count:,} of {sum(len(one.episodes['length']) for one in pool.evaluations):,}"
        for pool, count in counted
        if count
    ]
    return [f"Episodes that diverged, counted as failures: {', '.join(broken) if broken else 'none'}."]
