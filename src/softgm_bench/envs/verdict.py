"""What a control step amounts to: distances, success, the clock, the reward with its terms, torques.

Tensors on the CPU and wherever else, one kernel on a GPU, which equals them to rounding.
"""

from typing import NamedTuple

import torch
from tensordict import NestedKey
from torch import Tensor

from softgm_bench.envs import entries
from softgm_bench.envs.reward import reward_terms
from softgm_bench.envs.tasks.base import TaskConfig
from softgm_bench.rod import sync


class Step(NamedTuple):
    """A control step that is judged; ``(num_envs, ...)`` each.

    Attributes:
        before: nodes before the step, m, ``(.., 3, n_nodes)``.
        after: and after it.
        target: m, ``(.., 3)``.
        action: as the sections applied it, ``(.., n_agents, 2)``.
        previous_action: that of the step before.
        touching: nodes in contact after the step, ``(.., n_nodes)`` bool.
        pushed: whether an obstacle pushed the arm within the step, where that counts as contact, bool; else False.
        new_bins: discovered in this step, int64.
        broken: whether the simulation broke, bool.
        terminated: before the step, bool.
        truncated: before the step, bool.
        steps: before the step, int64.
        contact_steps: steps of the episode so far that were in contact, int64.
    """

    before: Tensor
    after: Tensor
    target: Tensor
    action: Tensor
    previous_action: Tensor
    touching: Tensor
    pushed: Tensor
    new_bins: Tensor
    broken: Tensor
    terminated: Tensor
    truncated: Tensor
    steps: Tensor
    contact_steps: Tensor


class Verdict(NamedTuple):
    """The verdict on a step; ``(num_envs,)`` each.

    Attributes:
        success: whether the tip is within the task's radius, and contact has not ended the episode, bool.
        ended: episodes that ended with this step, bool.
        terminated: after the step, bool.
        truncated: after the step, bool.
        steps: after the step, int64.
        contact_steps: after the step, int64; without a limit as before it, since nobody counts.
        contact_failure: whether this step's contact was one too many, bool; None without a limit.
        numbers: entries of the frame by key, of any type of numbers, or ``(num_envs, 1)`` float32 already.
    """

    success: Tensor
    ended: Tensor
    terminated: Tensor
    truncated: Tensor
    steps: Tensor
    contact_steps: Tensor
    contact_failure: Tensor | None
    numbers: dict[NestedKey, Tensor]


def judge(step: Step, config: TaskConfig, horizon: int) -> Verdict:
    """Judge a step of every environment; those that had ended do not go on."""
    device = step.after.device
    if sync.is_free(device) or not sync.runs_kernels(device):
        return judge_dense(step, config, horizon)
    from softgm_bench.envs import cuda_verdict  # only where Numba's CUDA target is

    columns, flags, (steps, contact_steps) = cuda_verdict.judge(step, config, horizon)
    success, ended, terminated, truncated, too_much = flags
    limited = config.max_contact_steps is not None
    return Verdict(
        success=success,
        ended=ended,
        terminated=terminated,
        truncated=truncated,
        steps=steps,
        contact_steps=contact_steps if limited else step.contact_steps,
        contact_failure=too_much if limited else None,
        numbers=dict(zip(NUMBERS, columns, strict=True)),
    )


# in the kernel's order
NUMBERS: tuple[NestedKey, ...] = (
    entries.DISTANCE,
    entries.TIP_STEP,
    entries.CONTACT_NODES,
    entries.TORQUE_PER_AGENT,
    entries.TORQUE_JOINT,
    entries.REWARD,
    *((entries.REWARD_TERMS, name) for name in entries.REWARD_TERM_NAMES),
)


def judge_dense(step: Step, config: TaskConfig, horizon: int) -> Verdict:
    """``judge`` in tensors."""
    active = ~(step.terminated | step.truncated)
    tip, previous_tip = step.after[..., -1], step.before[..., -1]
    distance = (tip - step.target).norm(dim=-1)
    success = (distance < config.success_radius) & ~step.broken
    steps = step.steps + active
    touching = step.touching.sum(dim=-1)
    contact_steps, too_much, ends = step.contact_steps, None, step.broken
    if config.max_contact_steps is not None:
        contact_steps = contact_steps + (active & ((touching > 0) | step.pushed))
        too_much = active & (contact_steps > config.max_contact_steps)
        success, ends = success & ~too_much, ends | too_much
    terminated = step.terminated | (active & (success | ends))
    truncated = step.truncated | (active & (steps >= horizon) & ~terminated)
    terms = reward_terms(
        config.reward,
        distance=distance,
        previous_distance=(previous_tip - step.target).norm(dim=-1),
        action=step.action,
        previous_action=step.previous_action,
        contact_nodes=touching,
        new_bins=step.new_bins,
        success=success,
        contact_failure=too_much,
        pushed=step.pushed,
    )
    torque = config.actuation.max_torque * step.action
    numbers = (
        distance,
        (tip - previous_tip).norm(dim=-1),
        touching,
        torque.norm(dim=-1).mean(dim=-1),  # the paper's formula
        torque.flatten(1).norm(dim=-1),  # the scale of the paper's table
        sum(terms.values(), torch.zeros_like(distance)),
        *(terms[name] for name in entries.REWARD_TERM_NAMES),
    )
    return Verdict(
        success=success,
        ended=active & (terminated | truncated),
        terminated=terminated,
        truncated=truncated,
        steps=steps,
        contact_steps=contact_steps,
        contact_failure=too_much,
        numbers=dict(zip(NUMBERS, numbers, strict=True)),
    )
