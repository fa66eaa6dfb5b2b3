"""Is a success one in PyElastica too? ``python experiments/replay_check.py`` replays episodes of a policy there.

Of an evaluation, the first ``--successes`` successful episodes of at most ``--longest`` steps, and ``--steps`` steps of
the ``--failures`` others that touch longest, are recorded and replayed by PyElastica in float64, without and with its
bounding boxes. Raw numbers, also the largest difference of a position after every step, go to
``experiments/replays/<policy>.json``.
"""

import argparse
import json
import shlex
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torchrl.envs import EnvBase

from softgm_bench.assembly import build_env
from softgm_bench.episodes import policy, recording, trajectory
from softgm_bench.episodes.evaluation import evaluate_in_parts
from softgm_bench.episodes.replay import compare, replay
from softgm_bench.storage.files import to_json
from softgm_bench.storage.versions import versions

ROOT = Path(__file__).parents[1]


def main() -> None:
    """Record, replay, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--policy", type=Path, default=Path("experiments/policies/wall_softgm.pt"))
    parser.add_argument("--episodes", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--successes", type=int, default=10)
    parser.add_argument("--longest", type=int, default=200)
    parser.add_argument("--failures", type=int, default=1)
    parser.add_argument("--steps", type=int, default=500)
    options = parser.parse_args()
    torch.set_num_threads(1)
    trained = policy.load(options.policy)
    rows = []
    for episode, horizon in chosen(trained, options):
        one = recording.record(trained, options.seed, episode, horizon, episodes=options.episodes)
        rows.append(check(one))
        print(line(rows[-1]), flush=True)
    out = ROOT / "experiments" / "replays" / f"{options.policy.stem}.json"
    out.parent.mkdir(exist_ok=True)
    result = {
        "command": shlex.join(["python", "experiments/replay_check.py", *sys.argv[1:]]),
        "policy": options.policy.as_posix(),
        "frames": trained.frames,
        "evaluation_seed": options.seed,
        "evaluation_episodes": options.episodes,
        "versions": versions() | {"pyelastica": version("pyelastica")},
    }
    text = json.dumps(result, indent=1)[:-2] + ',\n "rows": [\n  ' + ",\n  ".join(map(to_json, rows)) + "\n ]\n}\n"
    out.write_text(text)


def chosen(trained: policy.TrainedPolicy, options: argparse.Namespace) -> list[tuple[int, int]]:
    """Number and longest length of the episodes that are replayed, successes first."""
    records = evaluate_in_parts(
        trained.policy,
        lambda count, seed: cast(EnvBase, build_env(trained.config, count, seed)),
        options.episodes,
        deterministic=True,
        seed=options.seed,
    )
    assert records["success"] is not None
    assert records["contact_steps"] is not None
    succeeded = np.flatnonzero(records["success"] & (records["length"] <= options.longest))[: options.successes]
    failed = np.flatnonzero(~records["success"])
    failed = failed[np.argsort(-records["contact_steps"][failed], kind="stable")][: options.failures]
    horizon = trained.config.task.horizon
    return [(int(episode), horizon) for episode in succeeded] + [(int(episode), options.steps) for episode in failed]


def check(recorded: trajectory.Trajectory) -> dict[str, Any]:
    """One row: the recording, and its replays by PyElastica with every pair of bodies and as shipped."""
    row: dict[str, Any] = {
        "episode": recorded.info["episode"],
        "steps": recorded.steps,
        "success": recorded.success,
        "touching_steps": int(recorded.contact.any(axis=1).sum()),
    }
    for name, pruning in (("every_pair", False), ("as_shipped", True)):
        began = time.perf_counter()
        replayed = replay(recorded, "pyelastica", pruning)
        result = compare(recorded, replayed)
        forces = replayed.contact_force
        assert forces is not None
        row["recorded"] = result["recorded"]
        row[name] = {
            "seconds": round(time.perf_counter() - began, 1),
            "missed_contacts": replayed.missed,
            "largest_contact_force_N": float(forces.max()),
            "largest_difference": result["largest"],
            **result["replayed"],
            "position_difference_m": [float(f"{value:.2e}") for value in result["position"]],
        }
    return row


def line(row: dict[str, Any]) -> str:
    """A row for a reader."""
    sides = "  ".join(
        f"{name}: {row[name]['largest_difference']['position']:.1e} m, tip {row[name]['final_distance']:.4f} m, "
        f"reached {row[name]['reached']}, missed {row[name]['missed_contacts']}"
        for name in ("every_pair", "as_shipped")
    )
    own = row["recorded"]
    return (
        f"episode {row['episode']:>3}, {row['steps']} steps, {row['every_pair']['largest_contact_force_N']:.0f} N, "
        f"tip {own['final_distance']:.4f} m, reached {own['reached']}; {sides}"
    )


if __name__ == "__main__":
    main()
