"""A policy with fresh networks, as a training keeps one."""

import torch

from softgm_bench.assembly import build_policy, configure
from softgm_bench.envs import kind_of
from softgm_bench.episodes.policy import TrainedPolicy


def untrained(*overrides):
    """Not trained at all, but every term of its networks counts, so that its actions depend on all that it reads."""
    config = configure(list(overrides))
    sizes = kind_of(config.task).sizes(config.task)
    torch.manual_seed(0)
    actor = build_policy(config, sizes)
    with torch.no_grad():
        for parameter in actor.parameters():
            parameter.add_(0.2 * torch.randn_like(parameter))
    return TrainedPolicy(actor, sizes, config, 0, {}, config)
