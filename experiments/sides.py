"""To which side do policies go on ``wall_sense``? ``python experiments/sides.py [NAME=POLICY.pt ...]``.

Kept policies, and those that are named, play the same episodes. Where the tip is after some control steps is held
against the side of the opening that leads through, which nothing but senses can tell, and against the side of the
target, which tells nothing on this task, but told all of it in the first stages of the curriculum. Figures go to
``experiments/sides/<name>.json``; what lies there is not played again. Then the table in ``docs/choosing.md`` between
``<!-- sides -->`` and ``<!-- end -->`` is made of all of them.
"""

import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from tensordict import TensorDictBase
from torch import Tensor

from softgm_bench import api
from softgm_bench.analysis.markdown import refilled
from softgm_bench.assembly import build_env
from softgm_bench.envs import entries
from softgm_bench.episodes.policy import TrainedPolicy, fingerprint, load
from softgm_bench.errors import UserError
from softgm_bench.runs.machine import set_threads

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "experiments" / "sides"
PAGE = ROOT / "docs" / "choosing.md"
CAMPAIGN = ROOT / "experiments" / "campaign" / "wall_sense"
POLICIES = {
    "SoftGM, seed 0": CAMPAIGN / "softgm" / "seed0" / "policy.pt",
    "SoftGM, seed 1": CAMPAIGN / "softgm" / "seed1" / "policy.pt",
    "SoftGM without stage 1, seed 0": CAMPAIGN / "softgm_no_stage1" / "seed0" / "policy.pt",
}
EPISODES, SEED, LENGTH = 500, 20_261_129, 120
STEPS = (8, 12, 30)  # after so many control steps
COLUMNS = (
    *(f"target's side after {step} steps" for step in STEPS),
    *(f"open side after {step}" for step in STEPS),
    "success, target on the open side",
    "on the other",
    "failures by contact",
)


def share(of: Tensor) -> float | None:
    """How much of a mask is set; None of an empty one."""
    return float(of.double().mean()) if len(of) else None


def first_episodes(after: TensorDictBase) -> Tensor:
    """Of each environment's steps those of its first episode, ``(num_envs, steps)`` bool."""
    ends = after[entries.DONE].squeeze(-1)
    return (ends.cumsum(1) - ends.long()) == 0


def play(trained: TrainedPolicy) -> list[float | None]:
    """One number for each of ``COLUMNS``; sides are those of episodes that are under way."""
    frames = api.rollout(build_env(trained.config, EPISODES, SEED), trained, LENGTH)
    after = frames["next"]
    first = first_episodes(after)
    ever = {key: (after[key].squeeze(-1) & first).any(1) for key in (entries.SUCCESS, entries.CONTACT_FAILURE)}
    tip, told, target = (
        values[..., 1] > 0.0 for values in (after[entries.TIP], frames[entries.PRIVILEGED], frames[entries.TARGET])
    )
    open_side, targets_side = told[:, 0], target[:, 0]
    same, success = open_side == targets_side, ever[entries.SUCCESS]
    return [
        *(
            share((tip[:, step - 1] == side)[first[:, step - 1]])
            for side in (targets_side, open_side)
            for step in STEPS
        ),
        share(success[same]),
        share(success[~same]),
        share(ever[entries.CONTACT_FAILURE][~success]),
    ]


def table(folder: Path, columns: Sequence[str]) -> str:
    """All figures of a folder as Markdown, two decimals each."""
    lines = ["| policy | " + " | ".join(columns) + " |", "|" + " --- |" * (len(columns) + 1)]
    for file in sorted(folder.glob("*.json")):
        held = json.loads(file.read_text())
        lines.append(f"| {held['name']} | {' | '.join('' if x is None else f'{x:.2f}' for x in held['shares'])} |")
    return "\n".join(lines)


def page(text: str) -> str:
    """``docs/choosing.md`` with the table made anew."""
    return refilled(PAGE, text, {"sides": table(FOLDER, COLUMNS)})


def fill(folder: Path, policies: dict[str, Path], played: Callable[[TrainedPolicy], list[float | None]]) -> None:
    """Have those policies play of whom the folder has no figures."""
    set_threads(1, None)
    folder.mkdir(exist_ok=True)
    for name, path in policies.items():
        file = folder / f"{name.replace('`', '').replace(', ', '_').replace(' ', '-')}.json"
        if not file.exists():
            trained = load(path)
            told = {"name": name, "parameters": fingerprint(trained), "seed": SEED, "episodes": EPISODES}
            file.write_text(json.dumps(told | {"shares": played(trained)}, indent=1) + "\n")
            print(f"written: {file.relative_to(ROOT)}", flush=True)


def named(arguments: Sequence[str]) -> dict[str, Path]:
    """The policies that a command line names.

    Raises:
        UserError: an argument is no name and path.
    """
    unread = next((argument for argument in arguments if "=" not in argument), None)
    if unread is not None:
        raise UserError(f"{unread}: policies are given as NAME=POLICY.pt")
    return {name: Path(path) for name, _, path in (argument.partition("=") for argument in arguments)}


def main(
    folder: Path,
    policies: dict[str, Path],
    played: Callable[[TrainedPolicy], list[float | None]],
    page: Callable[[str], str],
) -> None:
    """Play what is missing, of these policies and of those that the command line names, and rewrite the page.

    Raises:
        SystemExit: a policy is not there, or an argument cannot be read.
    """
    try:
        fill(folder, policies | named(sys.argv[1:]), played)
    except UserError as error:
        raise SystemExit(str(error)) from error
    PAGE.write_text(page(PAGE.read_text()))


if __name__ == "__main__":
    main(FOLDER, POLICIES, play, page)
