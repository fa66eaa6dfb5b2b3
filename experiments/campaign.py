"""Tables of the campaign, whose cells are those of the published grids: ``python experiments/campaign.py``.

A finished cell lies in ``experiments/campaign/<task>/<algorithm>/seed<seed>/`` as its run left it, without checkpoints.
Rewrites four tables in ``docs/results.md``: every run with its budget, what there is with three seeds, every cell of
the grids, with what is missing, and the paper's Table II, from the evaluations in a cell's folder ``robustness``. A run
counts only if it has the frames, the final episodes and the recipe that its grid asks for.
"""

from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from softgm_bench.analysis import paper
from softgm_bench.analysis.markdown import compared, refilled
from softgm_bench.analysis.pools import SEEDS, lead, pool_runs
from softgm_bench.analysis.runs import Found, Run, find
from softgm_bench.analysis.statistics import Bootstrap, probability_of_improvement
from softgm_bench.config import compose
from softgm_bench.errors import UserError
from softgm_bench.report import Options
from softgm_bench.sweeps import launch

ROOT = Path(__file__).parents[1]
CAMPAIGN = ROOT / "experiments" / "campaign"
PAGE = ROOT / "docs" / "results.md"
LADDER = "+grids=ladder"
GRIDS = {  # the settings of each
    "table1": ("+grids=table1",),
    "ablation": ("+grids=ablation",),
    "ladder": (LADDER,),
    "ladder, MLP": (LADDER, "algo=mappo", "model=mlp"),
    "ladder, recurrent": (LADDER, "model=softgm", "algo.actor.memory={cell:gru,size:128}"),
    "ladder, oracle": (LADDER, "model=softgm", "observation=oracle"),
    "rivals": ("+grids=rivals",),
}
MISSING = "–"
RUNS = (
    "| task | algorithm | seed | frames | minutes | success | 95 % interval | episodes | within 400 steps | motionless "
    "| torque, joint |"
)
SEEDED = (
    "| task | algorithm | success of each seed | mean | 95 % interval over seeds | against SoftGM "
    "| its 95 % interval | probability that a seed of SoftGM is better |"
)
BOOTSTRAP = Bootstrap(Options.resamples, Options.seed)  # as a report's
CONDITIONS = {  # rows of the table of perturbations: what ``softgm_bench.evaluate`` calls them
    "nominal": "none",
    "noise": "noise",
    "section failure": "section_failure",
    "disturbance": "disturbance",
}
PERTURBED = (
    "| policy | condition | success | 95 % interval | lost, won | p | within 400 steps | mean length "
    "| the paper's success |"
)


@cache
def cells(grid: str) -> list[str]:
    """Folders of a grid's cells, ``task/algorithm/seed``, in the grid's order."""
    found, top = launch.cells(GRIDS[grid])
    return [cell.run_dir.relative_to(top).as_posix() for cell in found]


@cache
def asked(task: str) -> Mapping[str, Any]:
    """What a run on a task must have to be a cell."""
    config = compose([f"task={task}"])
    evaluation = config.experiment.evaluation
    frames, episodes = config.experiment.total_frames, evaluation.final_episodes
    return {"recipe": config.recipe, "frames": frames, "episodes": episodes, "horizon": config.task.horizon}


@cache
def committed(folder: Path) -> Found:
    """Whatever runs and evaluations lie in a folder.

    Raises:
        SystemExit: a folder that holds no whole run or evaluation.
    """
    found = find(folder)
    if found.problems:
        raise SystemExit(f"{found.problems[0].folder}: {found.problems[0].reason}")
    return found


@cache
def runs() -> Mapping[str, Run]:
    """All finished cells by their folders.

    Raises:
        SystemExit: a folder that holds no whole run, or another one than its name says, or one that is no cell.
    """
    wanted = {cell for grid in GRIDS for cell in cells(grid)}
    by_folder = {run.final.folder.partition("/")[2]: run for run in committed(CAMPAIGN).runs}
    for folder, run in by_folder.items():
        final, settings = run.final, asked(run.final.task)
        if folder != f"{final.task}/{final.label}/seed{final.seed}":
            raise SystemExit(f"{folder}: it holds {final.label} on {final.task}, seed {final.seed}")
        if folder not in wanted:
            raise SystemExit(f"{folder}: no grid of {', '.join(GRIDS)} has this cell")
        held = {
            "recipe": run.config["recipe"],
            "frames": run.config["experiment"]["total_frames"],
            "episodes": len(final.episodes["length"]),
            "horizon": final.horizon,
        }
        if held != settings or final.frames < settings["frames"]:
            raise SystemExit(f"{folder}: it has {held}, the cell {dict(settings)}")
    return by_folder


def run_table() -> str:
    """Every finished cell as a row of a Markdown table."""
    lines = [RUNS, "|" + " --- |" * (RUNS.count("|") - 1)]
    for run in runs().values():
        result = run.summary["final_evaluation"]
        success, torque = result["success_rate"], result["torque_joint"]
        cells = (
            f"`{run.final.task}`",
            run.final.label,
            f"{run.final.seed}",
            f"{run.final.frames:,}",
            f"{run.minutes:.0f}",
            f"{success['mean']:.3f}",
            f"[{success['low']:.3f}, {success['high']:.3f}]",
            f"{result['episodes']}",
            f"{result['success_by_step']['400']:.3f}",
            f"{result['motionless_failures']}",
            f"{torque['mean']:.1f} +- {torque['std']:.1f}",
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def seed_table() -> str:
    """What has three seeds or more, beside SoftGM where that has them too, with intervals over seeds."""
    lines = [SEEDED, "|" + " --- |" * (SEEDED.count("|") - 1)]
    pools = pool_runs(list(runs().values()))
    for (task, label), pool in pools.items():
        if pool.seeds < SEEDS:
            continue
        full, rates = pools.get((task, "softgm"), pool), pool.success_rates
        assert rates is not None
        each = ", ".join(f"{rate:.3f}" for rate in rates)
        row = [f"`{task}`", label, each, f"{rates.mean():.3f}", _between(pool.success_interval(BOOTSTRAP))]
        ahead = lead(pool, full, BOOTSTRAP)
        if ahead is None:
            row += [MISSING] * 3
        else:
            assert full.success_rates is not None
            better = probability_of_improvement([full.success_rates], [rates])
            row += [f"{ahead[0]:+.3f}", _between(ahead[1:], "+"), f"{better:.2f}"]
        lines.append(f"| {' | '.join(row)} |")
    return "\n".join(lines)


def _between(bounds: Sequence[float] | None, sign: str = "") -> str:
    return MISSING if bounds is None else f"[{bounds[0]:{sign}.3f}, {bounds[1]:{sign}.3f}]"


def cell_table() -> str:
    """Success of every cell of the grids, a dash where it is missing, and how many are."""
    wanted = dict.fromkeys(cell for grid in GRIDS for cell in cells(grid))
    split = [cell.split("/") for cell in wanted]
    tasks, labels = (list(dict.fromkeys(parts[place] for parts in split)) for place in (0, 1))
    lines = [f"| algorithm | {' | '.join(f'`{task}`' for task in tasks)} |", "|" + " --- |" * (len(tasks) + 1)]
    for label in labels:
        row = [_seeds(cell for cell in wanted if cell.startswith(f"{task}/{label}/")) for task in tasks]
        lines.append(f"| {label} | {' | '.join(row)} |")
    counts = [f"`{grid}` {_there(cells(grid))} of {len(cells(grid))}" for grid in GRIDS]
    total = f"{_there(list(wanted))} of {len(wanted)} cells are there"
    return "\n".join([*lines, "", f"{total}: {', '.join(counts)} (some cells are of several grids)."])


def perturbation_table() -> str:
    """Success of policies under perturbations that they were not trained under, each beside the same scenes without."""
    lines = [PERTURBED, "|" + " --- |" * (PERTURBED.count("|") - 1)]
    for run in runs().values():
        folder = f"{run.final.folder}/robustness/"
        played = {
            one.folder.removeprefix(folder): one.episodes
            for one in committed(CAMPAIGN).evaluations
            if one.folder.startswith(folder)
        }
        for row, name in CONDITIONS.items() if played else ():
            success, length = played[name]["success"], played[name]["length"]
            theirs = paper.table_two(run.final.task, run.final.label, name)
            cells = (
                f"`{run.final.task}`, {run.final.label}, seed {run.final.seed}",
                row,
                *compared(success, None if name == "none" else played["none"]["success"]),
                f"{(success * (length <= 400)).mean():.3f}",
                f"{length.mean():.0f}",
                MISSING if theirs is None else f"{theirs.success_rate / 100.0:.3f}",
            )
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def _seeds(folders: Iterable[str]) -> str:
    """Success of the seeds of one cell of the table, in their order."""
    found = [runs().get(folder) for folder in folders]
    return ", ".join(
        MISSING if run is None else f"{run.summary['final_evaluation']['success_rate']['mean']:.3f}" for run in found
    )


def _there(folders: Sequence[str]) -> int:
    return sum(folder in runs() for folder in folders)


def page(text: str) -> str:
    """``docs/results.md`` with its tables made anew."""
    tables = {
        "campaign runs": run_table(),
        "campaign seeds": seed_table(),
        "campaign cells": cell_table(),
        "perturbations": perturbation_table(),
    }
    return refilled(PAGE, text, tables)


def main() -> None:
    """Rewrite them."""
    PAGE.write_text(page(PAGE.read_text()))
    print(f"written: {PAGE.relative_to(ROOT)}, with {len(runs())} finished cells")


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(str(error)) from error
