"""Tables and learning curves of all committed runs: ``python experiments/results.py``.

Reads ``experiments/trained/<task>/<algorithm>/seed<seed>/`` and rewrites ``docs/learning_curves.png`` and the tables in
``docs/results.md``, each between a line ``<!-- task -->`` and ``<!-- end -->``.
"""

import re
from functools import cache
from pathlib import Path

from softgm_bench.analysis.runs import Run, find

ROOT = Path(__file__).parents[1]
RUNS = ROOT / "experiments" / "trained"
PAGE = ROOT / "docs" / "results.md"
PICTURE = ROOT / "docs" / "learning_curves.png"
TASKS = ("basic", "structured", "wall")
HEADER = (
    "| algorithm | seed | frames | minutes | threads | success | 95 % interval | episodes | mean length "
    "| discounted return | torque, joint |"
)


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
            f"{summary['wall_time'] / 60:.0f}",
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


def page(text: str) -> str:
    """``docs/results.md`` with its tables made anew."""
    for task in TASKS:
        made = f"<!-- {task} -->\n\n{table(task)}\n\n<!-- end -->"
        text, count = re.subn(rf"<!-- {task} -->.*?<!-- end -->", lambda _, made=made: made, text, flags=re.DOTALL)
        if count != 1:
            raise SystemExit(f"{PAGE}: one place for the table of {task} expected, found {count}")
    return text


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
    main()
