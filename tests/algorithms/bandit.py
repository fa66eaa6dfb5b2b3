"""The smallest problem with a known best answer: each agent's action should be the target's x and y.

One step an episode; the team's reward is minus the mean squared error of all agents.
"""

from types import SimpleNamespace

import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes

NUM_ENVS, N_AGENTS, N_SLOTS = 32, 2, 2
ENV = SimpleNamespace(
    sizes=Sizes(N_AGENTS, 2, n_slots=N_SLOTS), batch_size=torch.Size([NUM_ENVS]), device=torch.device("cpu")
)

# 32 random iterations of 32 frames, then 8 gradient steps an iteration.
LEARNS_FAST = {
    "batch_size": 128,
    "replay_capacity": 4000,
    "updates_per_frame": 0.25,
    "random_frames": 32 * NUM_ENVS,
    "actor_lr": 1e-3,
    "critic_lr": 1e-2,
    "tau": 0.05,
}


def observation():
    """Random targets, all else at rest, ``(NUM_ENVS,)``."""
    lead = (NUM_ENVS,)
    values = {
        entries.AGENT_POSITION: torch.zeros(*lead, N_AGENTS, 3),
        entries.AGENT_VELOCITY: torch.zeros(*lead, N_AGENTS, 3),
        entries.PREVIOUS_ACTION: torch.zeros(*lead, N_AGENTS, 2),
        entries.EDGE: torch.zeros(*lead, N_AGENTS, N_SLOTS, dtype=torch.bool),
        entries.SLOT_DESCRIPTOR: torch.zeros(*lead, N_SLOTS, 9),
        entries.SLOT_ACTIVE: torch.zeros(*lead, N_SLOTS, dtype=torch.bool),
        entries.TIP: torch.zeros(*lead, 3),
        entries.TARGET: torch.rand(*lead, 3) * 1.4 - 0.7,
    }
    td = TensorDict({}, lead)
    for key, value in values.items():
        td[key] = value
    return td


def act(policy, exploration):
    """One step of every environment: ``(NUM_ENVS, 1)`` frames, and the mean squared error."""
    frame = observation()
    after = frame.clone()
    with torch.no_grad(), set_exploration_type(exploration):
        policy(frame)
    error = (frame[entries.ACTION] - frame[entries.TARGET][:, None, :2]).square().mean(dim=(-2, -1))
    ended = torch.ones(NUM_ENVS, 1, dtype=torch.bool)
    after.update({entries.REWARD: -error.unsqueeze(-1), entries.DONE: ended, entries.TERMINATED: ended})
    frame["next"] = after
    return frame.unsqueeze(1), error.mean().item()


def error_after_learning(algorithm, iterations):
    """Mean squared error of the deterministic policy; zero everywhere would give 0.163."""
    for _ in range(iterations):
        algorithm.update(act(algorithm.policy, ExplorationType.RANDOM)[0])
    return sum(act(algorithm.policy, ExplorationType.DETERMINISTIC)[1] for _ in range(10)) / 10
