"""What do embeddings know of an opening? ``python experiments/probe.py`` plays, fits linear readouts, makes a table.

Kept policies play episodes of their own walls. After a few control steps, the opening's place is read out of what the
agents have, by ridge regression over episodes: fitted to four fifths of them, tried on the last fifth, five times over.
What is read is the mean of the team's embeddings g_i and that of their last section's alone; against these stand the
agents' own nodes o_i, which say where the arm is and thereby already something about the opening, and the embeddings
that the same encoder makes of the same frames without any obstacle in sight. Where a policy is asked about the mirror
image of a frame, frame and opening are those of the image. Figures go to
``experiments/probes/<task>_<label>.json``; what lies there is not played again. Then the table in ``docs/results.md``
between ``<!-- probes -->`` and ``<!-- end -->`` is made of them.
"""

import json
from pathlib import Path

import torch
from tensordict import TensorDictBase
from torch import Tensor

from softgm_bench import api
from softgm_bench.analysis.markdown import refilled
from softgm_bench.assembly import build_env
from softgm_bench.envs import entries
from softgm_bench.episodes.interventions import blind
from softgm_bench.episodes.policy import TrainedPolicy, fingerprint, load
from softgm_bench.errors import UserError
from softgm_bench.models.mirror import seen
from softgm_bench.models.registry import Encoder
from softgm_bench.runs.machine import set_threads

ROOT = Path(__file__).parents[1]
FOLDER = ROOT / "experiments" / "probes"
PAGE = ROOT / "docs" / "results.md"
POLICIES = {
    f"{task}_{label}": ROOT / "experiments" / "campaign" / task / label / "seed0" / "policy.pt"
    for task, label in (
        ("wall", "softgm"),
        ("wall_touch", "softgm"),
        ("wall_touch", "softgm_no_stage1"),
        ("wall_sense", "softgm"),
        ("wall_sense", "softgm_no_stage1"),
    )
}
EPISODES, SEED, FOLDS = 500, 20_261_128, 5
STEPS = (5, 6, 8, 12, 16)  # after so many control steps
RIDGE = 1e-2  # times the number of episodes, for features of unit variance
SOURCES = {
    "own": "own nodes",
    "hidden": "embeddings, obstacles hidden",
    "embedding": "embeddings",
    "last": "last section's embedding",
}
HEADER = "| policy | control steps | episodes | " + " | ".join(SOURCES.values()) + " |"


def explained(features: Tensor, wanted: Tensor) -> float:
    """The share of the variance of ``wanted`` that a linear readout of ``features`` explains in unseen episodes.

    Args:
        features: ``(episodes, F)``.
        wanted: ``(episodes, D)``.

    Returns:
        R^2 over all episodes and coordinates, each episode predicted by a fit to the others' folds; below 0 where the
        mean would have been better.
    """
    fold = torch.arange(len(features)) % FOLDS
    missed = torch.zeros_like(wanted)
    for held in range(FOLDS):
        known, asked = fold != held, fold == held
        centre, scale = features[known].mean(0), features[known].std(0).clamp_min(1e-9)
        mean = wanted[known].mean(0)
        inputs = (features - centre) / scale
        gram = inputs[known].mT @ inputs[known]
        gram.diagonal().add_(RIDGE * int(known.sum()))
        weights = torch.linalg.solve(gram, inputs[known].mT @ (wanted[known] - mean))
        missed[asked] = wanted[asked] - mean - inputs[asked] @ weights
    return 1.0 - float(missed.square().sum() / (wanted - wanted.mean(0)).square().sum())


def features(trained: TrainedPolicy, frame: TensorDictBase) -> dict[str, Tensor]:
    """What can be read of every episode, ``(episodes, F)``, by the keys of ``SOURCES``."""
    encoder = next(
        module for module in trained.policy.modules() if isinstance(module, Encoder)
    )  # the head's, normalised
    with torch.no_grad():
        embedding, hidden, own = encoder(frame), encoder(blind(frame)), encoder.own(frame)
    found = {"own": own.flatten(-2), "hidden": hidden.mean(-2), "embedding": embedding.mean(-2)}
    return {name: value.double() for name, value in (found | {"last": embedding[..., -1, :]}).items()}


def play(trained: TrainedPolicy) -> list[dict[str, float]]:
    """One row for each of ``STEPS``: how many episodes go on then, and what can be read out of them."""
    env = build_env(trained.config, EPISODES, SEED)
    frames = api.rollout(env, trained, max(STEPS) + 1)
    ended = frames["next", "done"].squeeze(-1).cumsum(1) > 0
    rows = []
    for step in STEPS:
        frame = frames[~ended[:, step - 1], step]
        shown, place = seen(trained.policy, frame), frame[entries.PRIVILEGED][:, 1:3].double()
        place[shown[entries.TARGET][:, 1] != frame[entries.TARGET][:, 1], 0] *= -1.0
        shares = {name: explained(value, place) for name, value in features(trained, shown).items()}
        rows.append({"step": step, "episodes": len(frame)} | shares)
    return rows


def table() -> str:
    """All figures as Markdown."""
    lines = [HEADER, "|" + " --- |" * (HEADER.count("|") - 1)]
    for name in POLICIES:
        for row in json.loads((FOLDER / f"{name}.json").read_text())["rows"]:
            shares = " | ".join(f"{row[source]:.2f}" for source in SOURCES)
            lines.append(f"| {name.replace('_softgm', ', softgm')} | {row['step']} | {row['episodes']} | {shares} |")
    return "\n".join(lines)


def page(text: str) -> str:
    """``docs/results.md`` with the table made anew."""
    return refilled(PAGE, text, {"probes": table()})


def main() -> None:
    """Play what is missing, and rewrite the table."""
    set_threads(1, None)
    FOLDER.mkdir(exist_ok=True)
    for name, path in POLICIES.items():
        file = FOLDER / f"{name}.json"
        if not file.exists():
            trained = load(path)
            told = {"policy": path.relative_to(ROOT).as_posix(), "parameters": fingerprint(trained)}
            file.write_text(json.dumps(told | {"seed": SEED, "rows": play(trained)}, indent=1) + "\n")
            print(f"written: {file.relative_to(ROOT)}", flush=True)
    PAGE.write_text(page(PAGE.read_text()))


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(str(error)) from error
