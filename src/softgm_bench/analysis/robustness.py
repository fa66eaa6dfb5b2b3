"""Which conditions a policy was evaluated under, in the order in which they are shown."""

from collections.abc import Mapping

from softgm_bench.analysis import paper
from softgm_bench.analysis.pools import Pool

Pools = Mapping[tuple[str, str], Pool]
Perturbed = Mapping[tuple[str, str, str], Pool]


def subjects(perturbed: Perturbed) -> list[tuple[str, str]]:
    """Task and algorithm of everything that was evaluated, and what the paper has in any case."""
    return sorted({(task, label) for task, label, _ in perturbed} | {("wall", "softgm")}, key=_order)


def conditions_of(task: str, label: str, nominal: Pools, perturbed: Perturbed) -> list[tuple[str, Pool | None]]:
    """Nominal, the paper's three, others: each with its evaluations; a name with several parameters keeps them."""
    there = {name: pool for (*subject, name), pool in perturbed.items() if subject == [task, label]}
    by_name: dict[str, list[str]] = {}
    for full in there:
        by_name.setdefault(full.split(" ")[0], []).append(full)
    rows: list[tuple[str, Pool | None]] = []
    if "none" not in by_name:
        rows.append(("none", nominal.get((task, label))))
    others = sorted(set(by_name) - {"none", *paper.PERTURBATIONS})
    for name in ("none", *paper.PERTURBATIONS, *others):
        full_names = by_name.get(name, [])
        rows += [(name if len(full_names) == 1 else full, there[full]) for full in full_names]
        if not full_names and name in paper.PERTURBATIONS:
            rows.append((name, None))
    return rows


def _order(subject: tuple[str, str]) -> tuple:
    task, label = subject
    position = paper.TASKS.index(task) if task in paper.TASKS else len(paper.TASKS)
    return position, task, label != "softgm", label
