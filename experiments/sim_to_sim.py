"""Does a policy that was trained here succeed in PyElastica? ``python experiments/sim_to_sim.py`` plays it there.

Each policy plays the same scenes in our kernel, in PyElastica, and in PyElastica as it is shipped, whose bounding boxes
miss contacts. It acts on the state of what moves the arm. Raw episodes go to ``experiments/sim_to_sim/<task>/softgm/``;
what lies there is not played again. Then the table in ``docs/trajectories.md`` between ``<!-- sim to sim -->`` and
``<!-- end -->`` is made of them.
"""

import csv
import json
from pathlib import Path
from typing import Any

from softgm_bench.analysis.markdown import refilled
from softgm_bench.assembly import build_env
from softgm_bench.episodes import folder, policy
from softgm_bench.episodes.evaluation import evaluate_in_parts
from softgm_bench.episodes.protocol import Protocol
from softgm_bench.errors import UserError
from softgm_bench.rod.pyelastica_backend import PyElasticaBackend
from softgm_bench.runs.machine import set_threads

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "experiments" / "sim_to_sim"
PAGE = ROOT / "docs" / "trajectories.md"
OURS, THEIRS, SHIPPED = "numba", "pyelastica", "pyelastica_as_shipped"
PLAYED = {"basic": None, "structured": None, "wall": 200}  # horizon by task; None: the task's own
POLICIES = {  # below experiments
    "basic": "policies/basic_softgm.pt",
    "structured": "policies/structured_softgm.pt",
    "wall": "trained/wall/softgm/seed0/policy.pt",
}
HEADER = (
    "| task | success: ours | PyElastica | as shipped | ours and PyElastica: same success | same length too "
    "| largest difference of their final distance, m | ours and as shipped: same success | same length too |"
)


def play(task: str, place: str) -> None:
    """Evaluate a committed policy as ``softgm_bench.evaluate`` does."""
    overrides = [f"backend={OURS if place == OURS else THEIRS}"]
    trained = policy.load(ROOT / "experiments" / POLICIES[task], overrides=overrides)
    protocol = Protocol(episodes=20, horizon=PLAYED[task])

    def build(count: int, seed: int) -> Any:
        env = build_env(trained.config, count, seed, protocol.horizon)
        if place == SHIPPED:
            env.simulator.backend = PyElasticaBackend(env.backend.parameters, pruning=True)
        return env

    records = evaluate_in_parts(trained.policy, build, protocol.episodes, deterministic=True, seed=protocol.seed)
    settings = protocol.describe(trained, overrides) | {"pruning": place == SHIPPED}
    target = FOLDER / task / "softgm" / place
    target.mkdir(parents=True)
    folder.write(target, records, folder.describe(trained, records, settings))


def table() -> str:
    """What the committed episodes say, as a Markdown table."""
    rows = [HEADER, "|" + " --- |" * (HEADER.count(" |"))]
    for task in PLAYED:
        places = [episodes(task, place) for place in (OURS, THEIRS, SHIPPED)]
        success = [f"{sum(one['success'] == 'True' for one in place)} of {len(place)}" for place in places]
        close, boxes = (_agreement(places[0], other) for other in places[1:])
        rows.append("| " + " | ".join([f"`{task}`", *success, *close, *boxes[:2]]) + " |")
    return "\n".join(rows)


def _agreement(ours: list[dict[str, str]], theirs: list[dict[str, str]]) -> list[str]:
    """In how many episodes success agrees, in how many the length too, and how far those at most end apart."""
    pairs = list(zip(ours, theirs, strict=True))
    alike = [(one, other) for one, other in pairs if one["success"] == other["success"]]
    equal = [(one, other) for one, other in alike if one["length"] == other["length"]]
    apart = max(abs(float(one["final_distance"]) - float(other["final_distance"])) for one, other in equal)
    return [str(len(alike)), str(len(equal)), f"{apart:.0e}" if apart else "0"]


def page(text: str) -> str:
    """Make the page's table anew."""
    return refilled(PAGE, text, {"sim to sim": table()})


def episodes(task: str, place: str) -> list[dict[str, str]]:
    """Rows of an evaluation's ``episodes.csv``."""
    with (FOLDER / task / "softgm" / place / "episodes.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def summary(task: str, place: str) -> dict[str, Any]:
    """An evaluation's ``summary.json``."""
    return json.loads((FOLDER / task / "softgm" / place / "summary.json").read_text())


def main() -> None:
    """Play and write."""
    set_threads(1)
    for task in PLAYED:
        for place in (OURS, THEIRS, SHIPPED):
            if not (FOLDER / task / "softgm" / place).exists():
                play(task, place)
    print(table())
    PAGE.write_text(page(PAGE.read_text()))


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(str(error)) from error
