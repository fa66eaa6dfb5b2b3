"""Short recorded episodes of policies that need no training."""

from functools import cache

import torch
from tensordict.nn import TensorDictModuleBase

from softgm_bench.assembly import build_policy
from softgm_bench.config import compose
from softgm_bench.envs import entries, kind_of
from softgm_bench.episodes import policy, recording, trajectory

WALL = ("task=wall", "task.wall_x=0.2")  # near enough to be touched by the arm's middle soon
SEEN = ("task=wall", "task.sensing_radius=0.4")  # near enough to be sensed before the arm moves


class Leaning(TensorDictModuleBase):
    """Pushes towards +x, where the walls are, by torques that change with the arm's shape."""

    in_keys = [entries.AGENT_POSITION]  # noqa: RUF012
    out_keys = [entries.ACTION]  # noqa: RUF012

    def forward(self, data):
        place = data[entries.AGENT_POSITION]
        sideways = 0.1 * torch.sin(20.0 * place.sum(dim=-1))
        return data.set(entries.ACTION, torch.stack([0.9 + sideways, sideways], dim=-1))


@cache
def leaning(*overrides: str) -> policy.TrainedPolicy:
    config = compose([*overrides])
    return policy.TrainedPolicy(Leaning(), kind_of(config.task).sizes(config.task), config, 0, {}, config)


@cache
def untrained(*overrides: str) -> policy.TrainedPolicy:
    config = compose([*overrides])
    with torch.random.fork_rng([]):
        torch.manual_seed(0)
        sizes = kind_of(config.task).sizes(config.task)
        return policy.TrainedPolicy(build_policy(config, sizes), sizes, config, 0, {}, config)


@cache
def recorded(*overrides: str, horizon: int = 30) -> trajectory.Trajectory:
    """Episode 1 of two, of the policy that leans; it touches ``WALL`` within 20 steps."""
    return recording.record(leaning(*overrides), seed=0, episode=1, horizon=horizon)


@cache
def watched(*overrides: str, horizon: int = 30) -> trajectory.Trajectory:
    """The same of an untrained policy, which hardly moves, with attention if it has any."""
    return recording.record(untrained(*overrides), seed=0, episode=1, horizon=horizon, attention=True)
