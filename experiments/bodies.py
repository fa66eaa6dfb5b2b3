"""How much of their success do policies keep with other bodies? ``python experiments/bodies.py`` plays and counts.

Kept policies, none of which was trained with drawn bodies, play the same scenes with the nominal arm, with bodies of
``randomise=moderate`` and with bodies of ``randomise=wide``; and fewer episodes with the same bodies once more in our
kernel and in PyElastica. Raw episodes go to ``experiments/bodies/<task>/<algorithm>/<bodies>/``; what lies there is not
played again. Then the tables in ``docs/randomisation.md`` are made of them, each between its ``<!-- name -->`` and
``<!-- end -->``.
"""

import csv
import json
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softgm_bench.analysis.markdown import compared, refilled
from softgm_bench.episodes import folder, policy
from softgm_bench.episodes.protocol import Protocol
from softgm_bench.errors import UserError
from softgm_bench.rod.randomise import FACTORS
from softgm_bench.runs.machine import set_threads

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "experiments" / "bodies"
PAGE = ROOT / "docs" / "randomisation.md"


class Subject(NamedTuple):
    """A policy, and how long the episodes are in which it is tested: in our kernel, and beside PyElastica."""

    file: str
    horizon: int
    short: int


POLICIES = {
    "basic/softgm": Subject("policies/basic_softgm.pt", 200, 200),
    "basic/mappo": Subject("policies/basic_mappo.pt", 200, 200),
    "wall/softgm": Subject("campaign/wall/softgm/seed0/policy.pt", 200, 50),
}
BODIES = ("none", "moderate", "wide")
PLACES = ("numba", "pyelastica")
MANY, FEW = 200, 10
SPLITS = {  # of wide bodies: a number of theirs, in units of the nominal arm's, and borders of it
    "`max_torque` / (E r^4)": (
        lambda one: one["body_max_torque"] / (one["body_youngs_modulus"] * one["body_base_radius"] ** 4),
        (0.5, 0.8, 1.25, 2.0),
    ),
    "`damping_constant`": (lambda one: one["body_damping_constant"], (0.7, 1.4)),
}


def play(subject: str, bodies: str, place: str, few: bool) -> None:
    """Evaluate a kept policy as ``softgm_bench.evaluate`` does."""
    file, horizon, short = POLICIES[subject]
    overrides = [f"randomise={bodies}", f"backend={place}"]
    trained = policy.load(ROOT / "experiments" / file, overrides=overrides)
    protocol = Protocol(episodes=FEW if few else MANY, horizon=short if few else horizon)
    records = protocol.play(trained)
    target = where(subject, bodies, place, few)
    target.mkdir(parents=True)
    folder.write(target, records, folder.describe(trained, records, protocol.describe(trained, overrides)))
    print(f"{target.relative_to(FOLDER)}: {records['success'].mean():.3f}", flush=True)


def where(subject: str, bodies: str, place: str, few: bool) -> Path:
    """Folder of an evaluation."""
    return FOLDER / subject / (f"{bodies}_{place}" if few else bodies)


def wanted() -> list[tuple[str, str, str, bool]]:
    """Arguments of ``play`` for all that is wanted, what takes long last."""
    many = [(subject, bodies, "numba", False) for subject in POLICIES for bodies in BODIES]
    return many + [(subject, bodies, place, True) for place in PLACES for subject in POLICIES for bodies in BODIES[1:]]


def columns(subject: str, bodies: str, place: str = "numba", few: bool = False) -> dict[str, NDArray[np.float64]]:
    """An evaluation's ``episodes.csv`` by column."""
    with (where(subject, bodies, place, few) / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    number = {"True": 1.0, "False": 0.0}
    return {name: np.array([float(number.get(row[name], row[name])) for row in rows]) for name in rows[0]}


def summary(subject: str, bodies: str, place: str = "numba", few: bool = False) -> dict[str, Any]:
    """An evaluation's ``summary.json``."""
    return json.loads((where(subject, bodies, place, few) / "summary.json").read_text())


def table() -> str:
    """Success with other bodies, each beside the same scenes with the nominal arm."""
    lines = [
        "| policy | bodies | success | 95 % interval | lost, won | p | mean length of successes | diverged |",
        "| --- | --- | --- | --- | --- | --- | --- | --- |",
    ]
    for subject in POLICIES:
        nominal = columns(subject, "none")["success"]
        for bodies in BODIES:
            one = columns(subject, bodies)
            success = one["success"]
            cells = [subject, f"`{bodies}`", *compared(success, None if bodies == "none" else nominal)]
            cells += [f"{one['length'][success == 1].mean():.0f}", f"{one['diverged'].sum():.0f}"]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def splits() -> str:
    """Success with wide bodies, by numbers that tell them apart."""
    lines = [f"| bodies with | episodes | {' | '.join(POLICIES)} |", "|" + " --- |" * (2 + len(POLICIES))]
    wide = [columns(subject, "wide") for subject in POLICIES]
    for what, (number, borders) in SPLITS.items():
        for low, high in pairwise((0.0, *borders, np.inf)):
            here = [(low <= number(one)) & (number(one) < high) for one in wide]
            assert all(
                np.array_equal(here[0], other) for other in here
            )  # the same bodies, whatever the policy and task
            word = f"below {high:g}" if low == 0.0 else f"{low:g} or more" if high == np.inf else f"{low:g} to {high:g}"
            shares = [f"{one['success'][mask].mean():.2f}" for one, mask in zip(wide, here, strict=True)]
            lines.append(f"| {' | '.join([f'{what} {word}', str(here[0].sum()), *shares])} |")
    return "\n".join(lines)


def in_pyelastica() -> str:
    """The same bodies in our kernel and in PyElastica."""
    lines = [
        "| policy | bodies | success: ours | PyElastica | same success | same length too "
        "| largest difference of their final distance, m |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for subject in POLICIES:
        for bodies in BODIES[1:]:
            ours, theirs = (columns(subject, bodies, place, few=True) for place in PLACES)
            assert all(np.array_equal(ours[f"body_{name}"], theirs[f"body_{name}"]) for name in FACTORS)
            alike = ours["success"] == theirs["success"]
            equal = alike & (ours["length"] == theirs["length"])
            apart = np.abs(ours["final_distance"] - theirs["final_distance"])[equal].max(initial=0.0)
            cells = [subject, f"`{bodies}`"]
            cells += [f"{one['success'].sum():.0f} of {len(one['success'])}" for one in (ours, theirs)]
            cells += [f"{alike.sum()}", f"{equal.sum()}", f"{apart:.0e}" if apart else "0"]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def page(text: str) -> str:
    """Make the page's tables anew."""
    return refilled(PAGE, text, {"bodies": table(), "wide bodies": splits(), "bodies in pyelastica": in_pyelastica()})


def main() -> None:
    """Play and write."""
    set_threads(1)
    for one in wanted():
        if not where(*one).exists():
            play(*one)
    PAGE.write_text(page(PAGE.read_text()))


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(str(error)) from error
