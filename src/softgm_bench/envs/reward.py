"""The paper's reward (section "Distributed Control Policy"): eight named terms, one team reward."""

import torch
from torch import Tensor

from softgm_bench.envs.tasks.base import RewardConfig


def reward_terms(
    config: RewardConfig,
    distance: Tensor,
    previous_distance: Tensor,
    action: Tensor,
    previous_action: Tensor,
    contact_nodes: Tensor,
    new_bins: Tensor,
    success: Tensor,
    contact_failure: Tensor | None = None,
    pushed: Tensor | None = None,
) -> dict[str, Tensor]:
    """All terms with their signs, so that the reward is their sum.

    Args:
        config: coefficients.
        distance: d_t, tip to target after the step, m, ``(num_envs,)``.
        previous_distance: d_{t-1}, ``(num_envs,)``.
        action: a_t, ``(num_envs, n_agents, 2)``.
        previous_action: a_{t-1}, of the same shape, zero at an episode's first step.
        contact_nodes: C_t, rod nodes in contact, ``(num_envs,)``.
        new_bins: N_t^new, bins discovered in this step, ``(num_envs,)``.
        success: d_t below the success radius, ``(num_envs,)`` bool.
        contact_failure: whether too much contact has ended the episode, ``(num_envs,)`` bool; None: it cannot.
        pushed: whether an obstacle pushed the arm within the step, which is contact too, ``(num_envs,)`` bool; None:
            nodes in contact alone count (the paper).

    Returns:
        Terms by the names in ``entries.REWARD_TERM_NAMES``, ``(num_envs,)`` each.
    """
    progress = previous_distance - distance
    in_contact = contact_nodes > 0 if pushed is None else (contact_nodes > 0) | pushed
    touching = in_contact.to(distance.dtype)
    still = (progress.abs() < config.epsilon).to(distance.dtype)
    collision = config.lambda_c * touching + config.lambda_cn * contact_nodes
    if contact_failure is not None:
        collision = collision - config.lambda_fail * contact_failure.to(distance.dtype)
    change = (action - previous_action).to(distance.dtype).square().mean(dim=(-2, -1))
    return {
        "distance": -distance,
        "progress": config.lambda_p * progress,
        "smoothness": -config.lambda_da * change,
        "time": torch.full_like(distance, -config.lambda_t),
        "collision": collision,
        "discovery": config.lambda_d * new_bins.clamp(max=config.k_max).to(distance.dtype),
        "stuck": -config.lambda_s * touching * still,
        "success": config.lambda_succ * success.to(distance.dtype),
    }
