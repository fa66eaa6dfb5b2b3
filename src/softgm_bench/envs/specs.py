"""The environment's TorchRL specs; meaning and units of the entries in ``keys``."""

import torch
from torchrl.data import Binary, Bounded, Composite, Unbounded

from softgm_bench.envs import keys

DIRECTIONS = 2  # normal and binormal

INFO = (
    keys.SUCCESS,
    keys.DIVERGED,
    keys.DISTANCE,
    keys.TIP_STEP,
    keys.CONTACT_NODES,
    keys.DISCOVERED,
    keys.DROPPED,
    keys.TORQUE_PER_AGENT,
    keys.TORQUE_JOINT,
)


def make_specs(
    num_envs: int, n_agents: int, n_slots: int, n_privileged: int, curriculum: bool, device: torch.device
) -> dict[str, Composite]:
    """Specs by the name of the ``EnvBase`` attribute, each with the batch dimension.

    Without privileged numbers or without a curriculum, their entries are absent.
    """

    def real(*shape: int) -> Unbounded:
        return Unbounded(shape=(num_envs, *shape), dtype=torch.float32, device=device)

    def flag(*shape: int) -> Binary:
        return Binary(shape=(num_envs, *shape), dtype=torch.bool, device=device)

    def group(entries: dict, *shape: int) -> Composite:
        return Composite(entries, shape=(num_envs, *shape), device=device)

    action = Bounded(-1.0, 1.0, shape=(num_envs, n_agents, DIRECTIONS), dtype=torch.float32, device=device)
    agents = {
        "position": real(n_agents, 3),
        "velocity": real(n_agents, 3),
        "previous_action": action.clone(),
        "edge": flag(n_agents, n_slots),
    }
    info = (*INFO, keys.DIFFICULTY) if curriculum else INFO
    observation = {
        "agents": group(agents, n_agents),
        "slots": group({"descriptor": real(n_slots, 9), "active": flag(n_slots)}, n_slots),
        "tip": real(3),
        "target": real(3),
        "info": group({key[1]: flag(1) if key in (keys.SUCCESS, keys.DIVERGED) else real(1) for key in info}),
        "reward_terms": group({name: real(1) for name in keys.REWARD_TERM_NAMES}),
    }
    if n_privileged:
        observation[keys.PRIVILEGED] = real(n_privileged)
    return {
        "observation_spec": group(observation),
        "action_spec": group({"agents": group({"action": action}, n_agents)}),
        "reward_spec": real(1),
        "done_spec": group({"done": flag(1), "terminated": flag(1), "truncated": flag(1)}),
    }
