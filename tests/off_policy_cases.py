"""What the tests of off-policy algorithms share: small settings, frames, and networks that say what they are told."""

import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from softgm_bench.rod.parameters import RodParameters

SHORT = RodParameters(substeps=5)
SMALL = ("algo.batch_size=16", "algo.replay_capacity=200", "algo.random_frames=0", "algo.updates_per_frame=0.1")


def batches(algorithm, env, count=1, steps=8):
    collector = Collector(
        env,
        algorithm.policy,
        frames_per_batch=env.batch_size[0] * steps,
        total_frames=count * env.batch_size[0] * steps,
        exploration_type=ExplorationType.RANDOM,
    )
    yield from collector
    collector.shutdown()


def filled(algorithm, env):
    (batch,) = batches(algorithm, env)
    algorithm.replay.add(batch)
    return algorithm


def says(parameters, value):
    """Make a network with these parameters say ``value`` whatever it reads: all zero but the last bias."""
    leaves = [parameter.data for parameter in parameters]
    for leaf in leaves:
        leaf.zero_()
    leaves[-1].fill_(value)


def three_ends(algorithm):
    """Rewards 1, 3, 5 in a frame that goes on, one that is truncated and one that is terminated."""
    transitions = algorithm.sample()[:3]
    column = (3, 1, 1)
    for name, values in {
        "reward": [1.0, 3.0, 5.0],
        "done": [False, True, True],
        "terminated": [False, False, True],
    }.items():
        transitions["next", "agents", name] = torch.tensor(values).view(column).expand(3, algorithm.n_agents, 1).clone()
    return transitions


def copied(value):
    if isinstance(value, dict):
        return {name: copied(item) for name, item in value.items()}
    return value.clone() if isinstance(value, torch.Tensor | TensorDict) else value
