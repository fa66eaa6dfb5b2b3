"""Puts a report together from what was found."""

from collections import Counter
from collections.abc import Mapping, Sequence

from softgm_bench.analysis import aggregate, figures, names, overview, paper, tables
from softgm_bench.analysis.document import Block, Document, Section
from softgm_bench.analysis.pools import Pool, newest, pool_evaluations, pool_runs
from softgm_bench.analysis.runs import Found, Run

TITLE = "Report of softgm_bench"
ONE_SEED = (
    "Of one seed no interval over seeds can be given: its interval is Wilson's over the episodes of that one policy "
    "and says nothing about how seeds differ."
)
TORQUE = (
    "Torque. The paper's formula averages a single agent's torque (at most 25 √2 = 35.4 N m); its tables hold values "
    "of 58 to 81, which fit the norm over all agents and axes (at most 25 √12 = 86.6 N m). The column beside the "
    "paper's is therefore the norm over all agents (torque_joint); the paper's formula is the column torque per agent "
    "(torque_per_agent)."
)


def build(found: Found, drawing: tables.Drawing) -> Document:
    """The whole report; the same input gives the same document."""
    runs, replaced = newest(found.runs)
    pools = pool_runs(runs)
    perturbed = pool_evaluations(found.evaluations)
    grouped: dict[tuple[str, str], list[Run]] = {}
    for run in runs:
        grouped.setdefault((run.final.task, run.final.label), []).append(run)
    return Document(
        TITLE,
        [
            Section("What was found", [*_summary(found, runs)]),
            Section("Comparison with the paper", _comparison(pools, drawing)),
            Section("Robustness", _robustness(pools, perturbed, drawing)),
            Section("Learning curves", _curves(grouped)),
            Section("Ablations", _ablations(pools, grouped, drawing)),
            Section("Over all tasks", _over_tasks(pools, drawing)),
            Section("Sources", _sources(found, runs, replaced)),
            Section("How the numbers are made", _method(drawing)),
        ],
    )


def _summary(found: Found, runs: Sequence[Run]) -> list[Block]:
    tasks = sorted({run.final.task for run in runs})
    labels = sorted({run.final.label for run in runs})
    seeds = Counter((run.final.task, run.final.label) for run in runs).values()
    out = len(found.problems) + len(found.runs) - len(runs)
    text = (
        f"Finished runs: {len(runs)}. Tasks: {', '.join(tasks)}. Algorithms: {', '.join(labels)}. Seeds of each pair "
        f"that was run: {names.span(list(seeds))}. Evaluations beside training: {len(found.evaluations)}. Folders "
        f"left out: {out}"
    )
    text += "; the section Sources says why." if out else "."
    return [text, *([ONE_SEED] if 1 in seeds else [])]


def _others(pools: Mapping[tuple[str, str], Pool], task: str) -> list[str]:
    """Algorithms on a task that are neither the paper's nor its ablations; ranked ones first."""
    known = {*paper.ALGORITHMS, *paper.ABLATIONS}
    there = [label for where, label in pools if where == task and label not in known]
    return sorted(there, key=lambda label: (not pools[task, label].ranked, label))


def _comparison(pools: Mapping[tuple[str, str], Pool], drawing: tables.Drawing) -> list[Block]:
    blocks: list[Block] = [TORQUE]
    for task in paper.TASKS:
        blocks.append(tables.table_one(task, pools, [*paper.ALGORITHMS, *_others(pools, task)], drawing))
    for task in sorted({task for task, _ in pools} - set(paper.TASKS)):
        there = sorted(label for where, label in pools if where == task)
        blocks.append(tables.table_one(task, pools, there, drawing))
    labels = [*paper.ALGORITHMS, *sorted({label for task in paper.TASKS for label in _others(pools, task)})]
    drawn = figures.time_to_target(pools, paper.TASKS, labels)
    return [*blocks, *([drawn] if drawn else [])]


def _robustness(
    pools: Mapping[tuple[str, str], Pool], perturbed: Mapping[tuple[str, str, str], Pool], drawing: tables.Drawing
) -> list[Block]:
    drawn = figures.robustness(pools, perturbed, drawing.resamples, drawing.seed)
    return [tables.table_two(pools, perturbed, drawing), *([drawn] if drawn else [])]


def _curves(grouped: figures.RunsByKey) -> list[Block]:
    tasks = [*paper.TASKS, *sorted({task for task, _ in grouped} - set(paper.TASKS))]
    labels = [
        *paper.ALGORITHMS,
        *sorted({label for _, label in grouped} - set(paper.ALGORITHMS) - set(paper.ABLATIONS)),
    ]
    caption = (
        "Evaluations during training: mean over seeds, shaded the standard error, thin lines single "
        "seeds. Dashed: independent critics."
    )
    drawn = figures.learning_curves("learning_curves", grouped, tasks, labels, tuple(figures.AXIS_NAMES), caption)
    return [drawn or "Not run."]


def _ablations(
    pools: Mapping[tuple[str, str], Pool], grouped: figures.RunsByKey, drawing: tables.Drawing
) -> list[Block]:
    blocks: list[Block] = [tables.ablations(pools, drawing)]
    without = {key: runs for key, runs in grouped.items() if key[1] in paper.ABLATIONS[1:]}
    if not without:
        return [*blocks, "No ablation was run: there is no figure."]
    tasks = [task for task in paper.TASKS if any(where == task for where, _ in without)]
    caption = "SoftGM and its ablations, evaluations during training: mean over seeds, shaded the standard error."
    measures = ("success_rate", "episode_length")
    drawn = figures.learning_curves("ablations", grouped, tasks, paper.ABLATIONS, measures, caption)
    return [*blocks, *([drawn] if drawn else [])]


def _over_tasks(pools: Mapping[tuple[str, str], Pool], drawing: tables.Drawing) -> list[Block]:
    entries = aggregate.aggregates(pools, drawing.resamples, drawing.seed)
    pairs = aggregate.comparisons(pools, drawing.resamples, drawing.seed)
    curves = aggregate.profiles(pools, drawing.resamples, drawing.seed)
    blocks: list[Block | None] = [
        overview.aggregates(entries),
        figures.aggregate_scores(entries),
        figures.performance_profiles(curves) or "No algorithm was run on all three tasks: no performance profile.",
        overview.comparisons(pairs) if pairs else "No two algorithms were run on the same task: none can be compared.",
        figures.improvement(pairs),
    ]
    return [block for block in blocks if block is not None]


def _sources(found: Found, runs: Sequence[Run], replaced: Sequence[tuple[Run, Run]]) -> list[Block]:
    blocks: list[Block] = [overview.sources(runs)]
    if found.evaluations:
        blocks.append(overview.evaluation_sources(found.evaluations))
    if found.problems or replaced:
        blocks.append(overview.left_out(found.problems, replaced))
    return blocks


def _method(drawing: tables.Drawing) -> list[Block]:
    return [
        "Mean ± standard deviation: over all episodes of all seeds together (population). Success: mean over seeds of "
        "a seed's share of successful episodes; an episode that diverged is none. Ranks compare success rates on one "
        "task; an oracle and training under a perturbation are never ranked, training with a curriculum only where "
        "every ranked run had one.",
        f"Intervals cover 95 %. Over seeds: percentiles of a stratified bootstrap ({drawing.resamples:,} resamples, "
        f"seed {drawing.seed}), which draws runs with replacement within each task (Agarwal et al. 2021). Of a single "
        "policy: Wilson's score interval over its episodes.",
        "Interquartile mean: mean of the middle half of all runs of all tasks. Performance profile: share of runs "
        "above a success rate. Probability of improvement: Mann-Whitney statistic over its largest value, averaged "
        "over tasks.",
    ]
