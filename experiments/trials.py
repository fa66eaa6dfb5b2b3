"""What was tried on ``wall``, as curves: ``python experiments/trials.py`` rewrites two tables of ``docs/training.md``.

Reads the evaluations in training, ``evaluations.jsonl``, of the runs' folders below ``experiments``.
"""

import json
from collections.abc import Mapping
from pathlib import Path

from softgm_bench.analysis.markdown import refilled

ROOT = Path(__file__).parents[1]
EXPERIMENTS = ROOT / "experiments"
PAGE = ROOT / "docs" / "training.md"
INTERVAL = 250_000  # frames between two evaluations of a run on `wall`
COLUMNS = (1, 2, 3, 4, 5, 6, 7, 8, 10, 12)  # the evaluations that are shown
SMALL_STEPS = {
    "the published run: 512 environments, gamma 0.95": "trained/wall/softgm/seed0",
    "episodes of 60 steps, embeddings normalised": "trials/wall/envs-512",
    "the same, 128 environments": "trials/wall/envs-128",
    "the same, `promote=0.5`": "trials/wall/envs-128_promote-0.5",
    "the same, `entropy_coeff=0.003`": "trials/wall/envs-128_promote-0.5_entropy-0.003",
    "the same, `gamma=0.98`: the recipe": "campaign/wall/softgm/seed0",
    "the recipe, seed 1": "campaign/wall/softgm/seed1",
    "the recipe, `hidden_norm`": "trials/wall/tuned_hidden-norm",
    "the recipe, `gae_lambda=0.95`": "trials/wall/tuned_lambda-0.95",
    "the recipe, `mirror=canonical`": "trials/wall/tuned_mirror-canonical",
}
MLPS = {
    "SoftGM's recipe": "trials/wall/mappo_small-steps",
    "and hidden layers normalised": "trials/wall/mappo_hidden-norm",
    "and `gamma=0.95`": "trials/wall/mappo_gamma-0.95",
    "and 512 environments, minibatches of 1280": "trials/wall/mappo_envs-512",
    "and embeddings not normalised": "trials/wall/mappo_no-embedding-norm",
    "and episodes of 200 steps": "trials/wall/mappo_train-horizon-200",
    "the published run's recipe: an MLP's now": "campaign/wall/mappo/seed0",
    "the published run": "trained/wall/mappo/seed0",
}
TABLES = {"what learns on wall": SMALL_STEPS, "mlps on the wall": MLPS}


def curve(folder: Path) -> dict[int, float]:
    """Success after ``i * INTERVAL`` frames, by ``i``; where a run was evaluated more often, others are left out."""
    found: dict[int, float] = {}
    for line in map(json.loads, (folder / "evaluations.jsonl").read_text().splitlines()):
        found.setdefault(line["frames"] // INTERVAL, line["success_rate"]["mean"])
    return found


def table(rows: Mapping[str, str]) -> str:
    """Write curves as a Markdown table; a column that no run has is left out."""
    curves = {name: curve(EXPERIMENTS / folder) for name, folder in rows.items()}
    columns = [number for number in COLUMNS if any(number in found for found in curves.values())]
    heads = [f"{number * INTERVAL / 1e6:g} M" for number in columns]
    lines = [f"| settings | {heads[0]} frames | {' | '.join(heads[1:])} |", "|" + " --- |" * (len(columns) + 1)]
    for name, found in curves.items():
        cells = [f"{found[number]:.2f}" if number in found else "" for number in columns]
        lines.append(f"| {' | '.join([name, *cells])} |")
    return "\n".join(lines)


def page(text: str) -> str:
    """``docs/training.md`` with its tables made anew."""
    return refilled(PAGE, text, {name: table(rows) for name, rows in TABLES.items()})


if __name__ == "__main__":
    PAGE.write_text(page(PAGE.read_text()))
    print(f"written: {PAGE.relative_to(ROOT)}")
