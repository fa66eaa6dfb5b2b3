"""The small data sets of this repository, and a use: ``python experiments/datasets.py`` writes, clones and evaluates.

Data sets go to ``experiments/datasets/<name>/`` by the command whose settings stand below. Then networks are fitted to
the transitions of ``basic`` (behaviour cloning) and evaluated as any policy; raw episodes go to
``experiments/datasets/cloned/``. What lies there is not made again. Last the table in ``docs/datasets.md`` between
``<!-- cloning -->`` and ``<!-- end -->`` is made of them.
"""

import json
import os
import sys
from pathlib import Path

import torch

from softgm_bench import dataset
from softgm_bench.analysis.markdown import refilled
from softgm_bench.assembly import build_policy, configure
from softgm_bench.datasets.reading import Dataset, load
from softgm_bench.envs import entries
from softgm_bench.episodes import folder, policy
from softgm_bench.episodes.policy import TrainedPolicy
from softgm_bench.episodes.protocol import Protocol
from softgm_bench.errors import UserError
from softgm_bench.runs.machine import set_threads
from softgm_bench.storage.versions import versions

ROOT = Path(__file__).parents[1]
FOLDER = Path("experiments/datasets")  # in the repository, where this is run
POLICIES = "experiments/policies"
EARLIER = "experiments/trained/wall/softgm/seed0/policy.pt"  # acts in the task of wall_mappo.pt
PAGE = ROOT / "docs" / "datasets.md"
PURPOSE = "'to try offline learning and loaders of TorchRL in seconds; too small to learn a wall from'"
SETS = {
    "basic": [f"policies=[random,{POLICIES}/basic_iddpg.pt,{POLICIES}/basic_softgm.pt]", "transitions=3600"],
    "wall": [f"policies=[random,{POLICIES}/wall_mappo.pt,{EARLIER}]", "transitions=3300"],
}
COMMON = ["shares=[1,1,2]", "horizon=100", "batch=32", f"purpose={PURPOSE}"]
ORIGINAL = "softgm"
# By name: the settings of the network, and whose transitions of ``basic`` it is fitted to; None: everybody's.
CLONES: dict[str, tuple[list[str], int | None]] = {
    "mlp_of_softgm": (["algo=ippo"], 2),
    "mlp_of_all": (["algo=ippo"], None),
}
STEPS, BATCH, LEARNING_RATE = 500, 256, 2e-3
PROTOCOL = Protocol(episodes=100, horizon=200)
HEADER = "| network | fitted to | transitions | success | 95 % interval | steps of an episode |"


def write(name: str) -> None:
    """Write a data set as the command does."""
    sys.argv = ["dataset", f"out={FOLDER / name}", *SETS[name], *COMMON]
    if dataset.main():
        raise SystemExit(f"{name}: it could not be written")


def clone(data: Dataset, overrides: list[str], number: int | None) -> TrainedPolicy:
    """Fit fresh networks to a data set's actions by their likelihood, on samples of TorchRL's replay buffer."""
    config = configure([*overrides, "task=basic"])
    torch.manual_seed(0)
    actor = build_policy(config, data.sizes)
    optimizer = torch.optim.Adam(actor.parameters(), lr=LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, STEPS)
    buffer = data.replay_buffer(BATCH, policy=number)
    for _ in range(STEPS):
        batch = buffer.sample()
        loss = -actor.get_dist(batch).log_prob(batch[entries.ACTION]).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
    return TrainedPolicy(actor, data.sizes, config, 0, versions(), config)


def evaluate(name: str, trained: TrainedPolicy, about: dict[str, object]) -> None:
    """Play the episodes that all of them play and keep them."""
    records = PROTOCOL.play(trained)
    target = ROOT / FOLDER / "cloned" / name
    target.mkdir(parents=True)
    settings = PROTOCOL.describe(trained, []) | about
    folder.write(target, records, folder.describe(trained, records, settings))


def table() -> str:
    """What the committed episodes say, as a Markdown table."""
    rows = [HEADER, "|" + " --- |" * (HEADER.count(" |"))]
    for name in (ORIGINAL, *CLONES):
        summary = json.loads((ROOT / FOLDER / "cloned" / name / "summary.json").read_text())
        success, length = (summary["metrics"][key] for key in ("success_rate", "episode_length"))
        low, high = (f"{success[end]:.3f}" for end in ("low", "high"))
        cells = [summary["model"], summary["fitted_to"], summary["transitions"], f"{success['mean']:.2f}"]
        rows.append("| " + " | ".join(map(str, [*cells, f"[{low}, {high}]", f"{length['mean']:.1f}"])) + " |")
    return "\n".join(rows)


def page(text: str) -> str:
    """Make the page's table anew."""
    return refilled(PAGE, text, {"cloning": table()})


def main() -> None:
    """Write, clone and evaluate."""
    os.chdir(ROOT)
    for name in SETS:
        write(name)
    set_threads(1)
    data = load(FOLDER / "basic")
    if not (FOLDER / "cloned" / ORIGINAL).exists():
        about = {"fitted_to": "the policy itself", "transitions": ""}
        evaluate(ORIGINAL, policy.load(Path(data.settings["policies"][2]["source"])), about)
    for name, (overrides, number) in CLONES.items():
        if not (FOLDER / "cloned" / name).exists():
            fitted = "all" if number is None else f"policy {number}, {data.settings['policies'][number]['label']}"
            about = {"fitted_to": fitted, "transitions": len(data.storage(number)), "steps": STEPS, "batch_size": BATCH}
            evaluate(name, clone(data, overrides, number), about)
    print(table())
    PAGE.write_text(page(PAGE.read_text()))


if __name__ == "__main__":
    try:
        main()
    except UserError as error:
        raise SystemExit(str(error)) from error
