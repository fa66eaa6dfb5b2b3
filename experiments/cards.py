"""Cards of the kept policies: ``python experiments/cards.py`` writes ``experiments/policies/README.md``.

Each policy is the actor of a run whose data are committed; what its card says is read from both.
"""

import os
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from softgm_bench.analysis.runs import Run, find
from softgm_bench.config.schema import model_name
from softgm_bench.episodes import policy
from softgm_bench.episodes.policy import TrainedPolicy

ROOT = Path(__file__).parents[1]
POLICIES = ROOT / "experiments" / "policies"
PAGE = POLICIES / "README.md"
RUNS = ("campaign", "trained")  # folders of experiments that hold runs; a policy is of the first that has its run
INTRODUCTION = """# Trained policies

Each file is an actor with the settings of its run. In a clone, `softgm-bench evaluate FILE` plays it, `softgm-bench
render FILE out=arm.html` shows it, and `softgm_bench.api.load(FILE)` gives it to a program
([Python](../../docs/api_tour.md)). An actor reads [what agents observe](../../docs/environment.md) and writes couples
for each section. It was trained in simulation alone and has moved no real arm. MIT licence, as the software.

Success is that of the run's final evaluation: deterministic actions, targets that training never saw, tip within 5 cm.
Runs of `trained` had [recipes of their time](../../docs/results.md#earlier-runs); their settings are in their folders,
and a run with today's is another one."""


class Card(NamedTuple):
    """A kept policy and the run that it is of.

    Attributes:
        file: below ``experiments/policies``.
        trained: what it holds.
        folder: of the run, below ``experiments``.
        run: the run's data.
    """

    file: Path
    trained: TrainedPolicy
    folder: Path
    run: Run


def cards() -> Iterator[Card]:
    """Give the card of every policy.

    Raises:
        SystemExit: a policy is of no run whose data are here.
    """
    for file in sorted(POLICIES.glob("*.pt")):
        trained = policy.load(file)
        cell = Path(trained.run.task.name, trained.label, f"seed{trained.run.seed}")
        for folder in (Path(runs) / cell for runs in RUNS):
            run = run_of(trained, ROOT / "experiments" / folder)
            if run is not None:
                yield Card(file, trained, folder, run)
                break
        else:
            raise SystemExit(f"{file.name}: no run of {cell} in {' or '.join(RUNS)} has {trained.frames} frames")


def run_of(trained: TrainedPolicy, folder: Path) -> Run | None:
    """Give the run that a folder holds, if it is the policy's: as long, and with no other policy kept in it."""
    found = find(folder).runs if folder.exists() else []
    kept = folder / "policy.pt"
    if not found or found[0].final.frames != trained.frames:
        return None
    if kept.exists() and policy.fingerprint(policy.load(kept)) != policy.fingerprint(trained):
        return None
    return found[0]


def written(card: Card) -> str:
    """Write a card as Markdown."""
    result, run = card.run.summary["final_evaluation"], card.run
    success, final = result["success_rate"], card.run.final
    place = os.path.relpath(ROOT / "experiments" / card.folder, POLICIES)
    lines = [
        f"## {card.file.name}",
        "",
        f"- **Task**: [`{final.task}`](../../docs/tasks.md), {run.config['task']['n_agents']} agents",
        f"- **Algorithm**: {final.label}, seed {final.seed}, {final.frames:,} frames, {run.minutes:.0f} minutes",
        f"- **Success**: {success['mean']:.3f}, 95 % interval [{success['low']:.3f}, {success['high']:.3f}], "
        f"{result['episodes']} episodes of at most {final.horizon:,} control steps",
        f"- **Run**: [experiments/{card.folder.as_posix()}]({place})",
    ]
    if card.folder.parts[0] == "campaign":
        lines.append(f"- **Command**: `{command(card)}`")
    return "\n".join(lines)


def command(card: Card) -> str:
    """Give the command that trained a policy of the campaign, which asks for nothing but its cell and its machine."""
    run = card.trained.run
    memory = getattr(run.algo.actor, "memory", None)
    words = {
        "algo": run.algo.name,
        "model": model_name(run.model),
        "observation": run.observation,
        "task": run.task.name,
    }
    words |= {} if memory is None else {"algo.actor.memory": f"{{cell:{memory.cell},size:{memory.size}}}"}
    words |= {"seed": run.seed, "threads": run.threads, "matmul": run.matmul}
    return f"python -m softgm_bench {shlex.join(f'{key}={value}' for key, value in words.items())}"


def page() -> str:
    """Write all cards."""
    return "\n\n".join([INTRODUCTION, *map(written, cards())]) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page())
    print(f"written: {PAGE.relative_to(ROOT)}")
