"""Why fewer sections reach less: ``python experiments/coarse_torque.py POLICY SECTIONS OUT HORIZON``.

The policy keeps all that it was trained with, its agents, what they sense and what they read, but its torque field is
sampled at the control points of ``SECTIONS`` sections and interpolated from there, as theirs would be. What is lost so
is what the actuation of so few sections costs. What an evaluation with ``task.n_agents=SECTIONS`` loses beyond that is
what sensing and networks cost. The scenes are those of ``softgm_bench.evaluate`` with ``episodes=200``.
"""

import sys
from pathlib import Path
from typing import Any

import torch

from softgm_bench.assembly import build_env
from softgm_bench.episodes import folder, policy
from softgm_bench.episodes.evaluation import evaluate_in_parts
from softgm_bench.episodes.policy import TrainedPolicy
from softgm_bench.episodes.protocol import Protocol
from softgm_bench.rod.actuation import Actuation, control_points, torque_basis


def coarse_matrix(trained: TrainedPolicy, sections: int) -> torch.Tensor:
    """The couple of every element for every agent's action, by way of so many control points, N m."""
    task, rod = trained.config.task, trained.config.rod
    points, basis = control_points(sections, rod.base_length), task.actuation.basis
    sampled = torch.as_tensor(torque_basis(task.n_agents, points, rod.base_length, basis))
    return sampled @ Actuation(rod, sections, task.actuation.max_torque, basis, task.actuation.scaling).matrix


def coarse_env(trained: TrainedPolicy, sections: int, count: int, seed: int, horizon: int) -> Any:
    """An environment in which the policy's torque field is that of ``sections`` sections."""
    env = build_env(trained.config, count, seed, horizon)
    env.simulator._actuation.matrix = coarse_matrix(trained, sections)
    return env


def main() -> None:
    """Play and write."""
    source, sections, out, horizon = sys.argv[1:]
    torch.set_num_threads(1)
    trained = policy.load(Path(source))
    protocol = Protocol(episodes=200, horizon=int(horizon))
    records = evaluate_in_parts(
        trained.policy,
        lambda count, seed: coarse_env(trained, int(sections), count, seed, int(horizon)),
        protocol.episodes,
        deterministic=True,
        seed=protocol.seed,
        gamma=protocol.gamma,
        at_once=None,
    )
    settings = protocol.describe(trained, []) | {"torque_sections": int(sections)}
    folder.check(Path(out), overwrite=False)
    folder.write(Path(out), records, folder.describe(trained, records, settings))
    print(f"success rate {records['success'].mean():.3f}, written to {out}")


if __name__ == "__main__":
    main()
