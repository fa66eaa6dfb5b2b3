"""Puts a report together from what was found."""

from collections import Counter
from collections.abc import Callable, Iterable, Sequence

from softgm_bench.analysis import aggregate, figures, interventions, names, paper, tables
from softgm_bench.analysis.document import Block, Document, Section
from softgm_bench.analysis.pools import SEEDS, Pools, by_algorithm, by_condition, newest, pool_evaluations, pool_runs
from softgm_bench.analysis.runs import Found, Run
from softgm_bench.analysis.statistics import Bootstrap
from softgm_bench.analysis.style import look

Track = Callable[[Sequence[str]], Iterable[str]]

TITLE = "Report of softgm_bench"
ONE_SEED = (
    "Of one seed no interval over seeds can be given: its interval is Wilson's over the episodes of that one policy "
    "and says nothing about how seeds differ."
)
NONE_COMPARED = (
    f"No two algorithms have {SEEDS} seeds at equal frames on the same task: no probability of improvement is given."
)
TORQUE = (
    "Torque. The paper's formula averages a single agent's torque (at most 25 √2 = 35.4 N m); its tables hold values "
    "of 58 to 81, which fit the norm over all agents and axes (at most 25 √12 = 86.6 N m). The column beside the "
    "paper's is therefore the norm over all agents (torque_joint); the paper's formula is the column torque per agent "
    "(torque_per_agent)."
)


@look()
def build(found: Found, bootstrap: Bootstrap, track: Track | None = None) -> Document:
    """Build the whole report; the same input gives the same document. ``track`` goes through its sections."""
    runs, replaced = newest(found.runs)
    grouped, pools = by_algorithm(runs), pool_runs(runs)
    sections: dict[str, Callable[[], Iterable[Block | None]]] = {
        "What was found": lambda: _summary(found, runs),
        "Comparison with the paper": lambda: _comparison(pools, bootstrap),
        "Robustness": lambda: _robustness(found, pools, bootstrap),
        "Learning curves": lambda: [_curves(grouped) or "Not run."],
        "Ablations": lambda: [tables.ablations(pools, bootstrap), _ablations(grouped)],
        "Over all tasks": lambda: _over_tasks(pools, bootstrap),
        "Sources": lambda: [
            tables.sources(runs),
            tables.evaluation_sources(found.evaluations) if found.evaluations else None,
            tables.left_out(found.problems, replaced) if found.problems or replaced else None,
        ],
        "How the numbers are made": lambda: _method(bootstrap),
    }
    titles = list(sections)
    return Document(
        TITLE,
        [
            Section(title, [one for one in sections[title]() if one])
            for title in (titles if track is None else track(titles))
        ],
    )


def _summary(found: Found, runs: Sequence[Run]) -> list[Block | None]:
    tasks = sorted({run.final.task for run in runs})
    labels = sorted({run.final.label for run in runs})
    seeds = Counter((run.final.task, run.final.label) for run in runs).values()
    out = len(found.problems) + len(found.runs) - len(runs)
    text = (
        f"Finished runs: {len(runs)}. Tasks: {', '.join(tasks)}. Algorithms: {', '.join(labels)}. Seeds of each pair "
        f"that was run: {names.span(list(seeds))}. Evaluations beside training: {len(found.evaluations)}. Folders "
        f"left out: {out}"
    )
    return [text + ("; the section Sources says why." if out else "."), ONE_SEED if 1 in seeds else None]


def _comparison(pools: Pools, bootstrap: Bootstrap) -> list[Block | None]:
    """Tables of the paper's tasks, with other algorithms below, ranked ones first; then of other tasks."""
    known = {*paper.ALGORITHMS, *paper.ABLATIONS}
    blocks: list[Block | None] = [TORQUE]
    for task in [*paper.TASKS, *sorted({task for task, _ in pools} - set(paper.TASKS))]:
        there = sorted(label for where, label in pools if where == task)
        if task in paper.TASKS:
            others = [label for label in there if label not in known]
            there = [*paper.ALGORITHMS, *sorted(others, key=lambda label: not pools[task, label].ranked)]
        blocks.append(tables.table_one(task, pools, there, bootstrap))
    others = sorted({label for task, label in pools if task in paper.TASKS} - known)
    time_to_target = figures.time_to_target(pools, paper.TASKS, [*paper.ALGORITHMS, *others])
    return [*blocks, time_to_target, tables.success_by_step(pools) if pools else None]


def _robustness(found: Found, pools: Pools, bootstrap: Bootstrap) -> list[Block | None]:
    perturbed = pool_evaluations(found.evaluations)
    conditions = by_condition(pools, perturbed)
    evaluated = {
        subject: rows for subject, rows in conditions.items() if any(pool for name, pool in rows if name != "none")
    }
    pairs = interventions.pairs(found.evaluations)
    return [
        tables.table_two(pools, conditions, bootstrap),
        figures.robustness(evaluated, bootstrap),
        tables.interventions(pairs) if pairs else None,
    ]


def _curves(grouped: figures.RunsByKey) -> Block | None:
    tasks = [*paper.TASKS, *sorted({task for task, _ in grouped} - set(paper.TASKS))]
    others = {label for _, label in grouped} - set(paper.ALGORITHMS) - set(paper.ABLATIONS)
    caption = (
        "Evaluations during training: mean over seeds, shaded the standard error, thin lines single "
        "seeds. Dashed: independent critics."
    )
    labels, measures = [*paper.ALGORITHMS, *sorted(others)], tuple(figures.AXIS_NAMES)
    return figures.learning_curves("learning_curves", grouped, tasks, labels, measures, caption)


def _ablations(grouped: figures.RunsByKey) -> Block | None:
    run = {task for task, label in grouped if label in paper.ABLATIONS[1:]}
    if not run:
        return "No ablation was run: there is no figure."
    tasks = [task for task in paper.TASKS if task in run]
    caption = "SoftGM and its ablations, evaluations during training: mean over seeds, shaded the standard error."
    measures = ("success_rate", "episode_length")
    return figures.learning_curves("ablations", grouped, tasks, paper.ABLATIONS, measures, caption)


def _over_tasks(pools: Pools, bootstrap: Bootstrap) -> list[Block | None]:
    entries = aggregate.aggregates(pools, bootstrap)
    pairs = aggregate.comparisons(pools, bootstrap)
    return [
        tables.aggregates(entries),
        figures.aggregate_scores(entries),
        figures.performance_profiles(entries) or "No algorithm was run on all three tasks: no performance profile.",
        tables.comparisons(pairs) if pairs else NONE_COMPARED,
        figures.improvement(pairs),
    ]


def _method(bootstrap: Bootstrap) -> list[Block | None]:
    return [
        "Mean ± standard deviation: over all episodes of all seeds together (population). Success: mean over seeds of "
        "a seed's share of successful episodes; an episode that diverged is none. Ranks compare success rates on one "
        f"task, and need {SEEDS} seeds and equal frames, as probabilities of improvement do; an oracle, another recipe "
        "than the tuned one, training under a perturbation and runs of smoke size are never ranked, training with a "
        "curriculum only where every ranked run had one.",
        f"Intervals cover 95 %. Over seeds: percentiles of a stratified bootstrap ({bootstrap.resamples:,} resamples, "
        f"seed {bootstrap.seed}), which draws runs with replacement within each task (Agarwal et al. 2021). Of a "
        "single policy: Wilson's score interval over its episodes.",
        "Interquartile mean: mean of the middle half of all runs of all tasks. Performance profile: share of runs "
        "above a success rate. Probability of improvement: Mann-Whitney statistic over its largest value, averaged "
        "over tasks.",
    ]
