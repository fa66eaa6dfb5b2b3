"""Tables and learning curves of all committed runs: ``python experiments/results.py``.

Reads ``experiments/trained/<task>/<algorithm>/seed<seed>/``, ``experiments/sections/<task>/<algorithm>/<setting>/``,
``experiments/failures/wall/<algorithm>/`` and the kept trial's evaluations. Rewrites ``docs/learning_curves.png`` and
the tables in ``docs/results.md``, each between ``<!-- table -->`` and ``<!-- end -->``.
"""

import math
from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from pathlib import Path

from softgm_bench.analysis.markdown import compared, refilled
from softgm_bench.analysis.runs import Columns, Run, find
from softgm_bench.episodes import certified
from softgm_bench.errors import UserError

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "experiments" / "trained"
SECTIONS = ROOT / "experiments" / "sections"
FAILURES = ROOT / "experiments" / "failures"
TRIAL = ROOT / "experiments" / "campaign" / "wall" / "softgm" / "seed0" / "evaluations"
PAGE = ROOT / "docs" / "results.md"
PICTURE = ROOT / "docs" / "learning_curves.png"
TASKS = ("basic", "structured", "wall")
HEADER = (
    "| algorithm | seed | frames | minutes | threads | success | 95 % interval | episodes | mean length "
    "| discounted return | torque, joint |"
)
AS_TRAINED = "n_agents-6"
COUNTS = {f"N = {n}": f"n_agents-{n}" for n in (4, 5, 6, 7, 8, 9, 12)}  # folders by what a row says
ELEMENTS = {f"{n} elements": f"n_elements-{n}" for n in (30, 90)}
FOUR_SECTIONS = {"N = 4": "n_agents-4", "N = 6, torque field of four": "torque_sections-4"}
ELSEWHERE = {  # tables: what acts where, as their columns, and their rows
    "other sizes, basic": (("basic/softgm", "basic/mappo"), COUNTS | ELEMENTS),
    "other sizes, wall": (("wall/softgm", "wall/mappo"), COUNTS),
    "four sections": (("basic/softgm", "wall/softgm"), FOUR_SECTIONS),
}
FAILING = {  # folder of evaluations and the one in it, by column
    "softgm, gamma 0.98": (TRIAL, "none"),
    **{name: (FAILURES, f"wall/{name}") for name in ("softgm", "softgm_oracle", "mappo")},
}
SPLITS = {  # of the scenes of `wall`: what they are told apart by, m, and the borders
    "from the opening's centre to the target, sideways": (0.0, 0.05, 0.10, 0.15, 0.20, math.inf),
    "from the target up to the opening's centre": (-math.inf, -0.15, -0.05, 0.05, math.inf),
    "height of the opening's centre": (0.35, 0.40, 0.45, 0.50, 0.55, math.inf),
}


@cache
def all_runs() -> list[Run]:
    """Of every task.

    Raises:
        SystemExit: a folder that holds no whole run.
    """
    found = find(RUNS)
    if found.problems:
        raise SystemExit(f"{found.problems[0].folder}: {found.problems[0].reason}")
    return found.runs


def runs(task: str) -> list[Run]:
    """A task's runs, the most successful first."""
    of_task = [run for run in all_runs() if run.final.task == task]
    return sorted(of_task, key=lambda run: (-_success(run)["mean"], run.final.folder))


def _success(run: Run) -> dict[str, float]:
    return run.summary["final_evaluation"]["success_rate"]


def table(task: str) -> str:
    """A task's runs as a Markdown table."""
    if not runs(task):
        return "No run yet."
    rows = [HEADER, "|" + " --- |" * HEADER.count(" |")]
    for run in runs(task):
        summary, success = run.summary, _success(run)
        result = summary["final_evaluation"]
        cells = [
            summary["algo"],
            str(summary["seed"]),
            f"{summary['frames']:,}",
            f"{run.minutes:.0f}",
            str(summary["threads"]),
            f"{success['mean']:.3f}",
            f"[{success['low']:.3f}, {success['high']:.3f}]",
            str(result["episodes"]),
            f"{result['episode_length']['mean']:.0f}",
            f"{result['discounted_return']['mean']:.1f} +- {result['discounted_return']['std']:.1f}",
            f"{result['torque_joint']['mean']:.1f} +- {result['torque_joint']['std']:.1f}",
        ]
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


@cache
def episodes_in(folder: Path) -> Mapping[str, Columns]:
    """Episodes of the kept policies' evaluations, by their folders below this one.

    Raises:
        SystemExit: a folder that holds no whole evaluation.
    """
    found = find(folder)
    if found.problems:
        raise SystemExit(f"{found.problems[0].folder}: {found.problems[0].reason}")
    return {one.folder.partition("/")[2]: one.episodes for one in found.evaluations}


def failures() -> str:
    """Where on ``wall`` a solution is known and where policies succeed, as a Markdown table.

    Raises:
        SystemExit: the evaluations are not of the certified scenes.
    """
    known = certified.of_task("wall")
    played = [episodes_in(folder)[name]["success"] for folder, name in FAILING.values()]
    if known is None or any(len(success) != known.scenes for success in played):
        raise SystemExit(f"{FAILURES}: evaluations of the certified scenes expected")
    opening, away = known.privileged[:, :3], known.privileged[:, :3] - known.target
    lines = [f"| scenes | number | certified | {' | '.join(FAILING)} |", "|" + " --- |" * (len(FAILING) + 3)]
    for (what, borders), value in zip(SPLITS.items(), (abs(away[:, 1]), away[:, 2], opening[:, 2]), strict=True):
        for low, high in pairwise(borders):
            here = (value >= low) & (value < high)
            ends = [f"{end:.2f}" for end in (low, high) if math.isfinite(end)]
            word = "" if len(ends) == 2 else "at least " if math.isinf(high) else "below "
            shares = [one[here].mean() for one in (known.length > 0, *played)]
            cells = [f"{what}: {word}{' to '.join(ends)} m", f"{here.sum()}", *(f"{share:.2f}" for share in shares)]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def elsewhere(policies: Sequence[str], rows: Mapping[str, str]) -> str:
    """Success in other settings as a Markdown table, each beside the same scenes with the settings of training."""
    header = "".join(f" {policy} | 95 % interval | lost, won | p |" for policy in policies)
    lines = [f"| tested with |{header}", "|" + " --- |" * (4 * len(policies) + 1)]
    for row, folder in rows.items():
        cells = [row]
        for policy in policies:
            usual, other = (episodes_in(SECTIONS)[f"{policy}/{name}"]["success"] for name in (AS_TRAINED, folder))
            cells += compared(other, None if folder == AS_TRAINED else usual)
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def page(text: str) -> str:
    """``docs/results.md`` with its tables made anew."""
    tables = {task: table(task) for task in TASKS}
    tables |= {name: elsewhere(*settings) for name, settings in ELSEWHERE.items()} | {"failures": failures()}
    return refilled(PAGE, text, tables)


def draw() -> None:
    """Success in the evaluations during training against frames, a panel for each task."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    tasks = [task for task in TASKS if runs(task)]
    size = (3.8 * len(tasks), 3.4)
    figure, panels = plt.subplots(1, len(tasks), figsize=size, sharey=True, squeeze=False, layout="constrained")
    names = sorted({run.final.label for task in tasks for run in runs(task)})
    for axes, task in zip(panels[0], tasks, strict=True):
        for run in runs(task):
            success, colour = _success(run), f"C{names.index(run.final.label)}"
            axes.plot(
                [line["frames"] / 1e6 for line in run.progress],
                [line["success_rate"]["mean"] for line in run.progress],
                color=colour,
                label=run.final.label,
            )
            interval = [[success["mean"] - success["low"]], [success["high"] - success["mean"]]]
            axes.errorbar([run.final.frames / 1e6], [success["mean"]], interval, fmt="o", ms=3, color=colour)
        axes.set(title=task, xlabel="million frames", ylim=(-0.02, 1.02))
        axes.legend(frameon=False, fontsize=7)
        axes.spines[["top", "right"]].set_visible(False)
    panels[0, 0].set_ylabel("success rate, deterministic")
    figure.savefig(PICTURE, dpi=150)


def main() -> None:
    """Make both."""
    PAGE.write_text(page(PAGE.read_text()))
    draw()
    print(f"written: {PAGE.relative_to(ROOT)}, {PICTURE.relative_to(ROOT)}")


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(str(error)) from error
