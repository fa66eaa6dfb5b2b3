# Compiled callees reach a function as globals (see rod.callees), out of the linters' sight.
# ruff: noqa: F821
# mypy: disable-error-code="name-defined"
"""``softgm_bench.envs.verdict`` as one CUDA kernel: a thread an environment."""

import math
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from numba import cuda
from torch import Tensor

from softgm_bench.envs.tasks.base import TaskConfig
from softgm_bench.rod.callees import with_callees
from softgm_bench.rod.cuda_kernel import device
from softgm_bench.rod.cuda_launch import REAL, launch

THREADS = 64  # of a block
N_NUMBERS, N_FLAGS, N_CLOCKS = 14, 5, 2


class Coefficients(NamedTuple):
    """A task's constants in the kernel's precision, named as in its configuration."""

    success_radius: Any
    max_torque: Any
    lambda_p: Any
    lambda_da: Any
    lambda_t: Any
    lambda_c: Any
    lambda_cn: Any
    lambda_d: Any
    k_max: Any
    lambda_s: Any
    epsilon: Any
    lambda_succ: Any
    lambda_fail: Any


def judge(
    step: Sequence[Tensor], config: TaskConfig, horizon: int
) -> tuple[tuple[Tensor, ...], tuple[Tensor, ...], tuple[Tensor, ...]]:
    """Judge a step of every environment, in one launch.

    Args:
        step: the fields of ``verdict.Step``.
        config: of the task.
        horizon: control steps until truncation.

    Returns:
        The numbers in the order of ``verdict.NUMBERS``, ``(num_envs, 1)`` float32 each; success, ended, terminated,
        truncated and failure by contact, ``(num_envs,)`` bool each; the steps and those in contact, ``(num_envs,)``
        int64 each.
    """
    num_envs, _, n_nodes = step[0].shape
    here = step[0].device
    numbers = torch.empty((N_NUMBERS, num_envs), dtype=torch.float32, device=here)
    flags = torch.empty((N_FLAGS, num_envs), dtype=torch.bool, device=here)
    clocks = torch.empty((N_CLOCKS, num_envs), dtype=torch.int64, device=here)
    limit = -1 if config.max_contact_steps is None else config.max_contact_steps
    real = REAL[step[0].dtype]
    settings = vars(config.reward) | {"success_radius": config.success_radius}
    settings |= {"max_torque": config.actuation.max_torque}
    launch(
        make_judge(n_nodes, step[3].shape[1], real),
        -(-num_envs // THREADS),
        THREADS,
        [*(value.contiguous() for value in step), numbers, flags, clocks],
        Coefficients(*(real(settings[name]) for name in Coefficients._fields)),
        horizon,
        limit,
    )
    return numbers.unsqueeze(-1).unbind(0), flags.unbind(0), clocks.unbind(0)


@lru_cache
def make_judge(n_nodes: int, n_agents: int, real: type) -> Callable[..., Any]:
    """Build the kernel for one size of arm and one precision; launch with ``THREADS`` environments a block.

    Arguments: the fields of ``verdict.Step``, the three results of ``judge``, ``Coefficients``, the horizon,
    the most steps in contact, negative without a limit.
    """

    def kernel(
        before, after, target, action, previous_action, touching, pushed, new_bins, broken, terminated, truncated,
        steps, contact_steps, numbers, flags, clocks, c, horizon, limit,
    ):  # fmt: skip
        b = cuda.blockIdx.x * cuda.blockDim.x + cuda.threadIdx.x
        if b < steps.shape[0]:
            active = not (terminated[b] or truncated[b])
            distance = tip_to(after[b], target[b])
            contacts = 0
            for k in range(n_nodes):
                contacts += 1 if touching[b, k] else 0
            clocks[0, b] = steps[b] + (1 if active else 0)
            in_contact = contacts > 0 or pushed[b]
            clocks[1, b] = contact_steps[b] + (1 if active and in_contact else 0)
            failure = active and limit >= 0 and clocks[1, b] > limit
            success = distance < c.success_radius and not broken[b] and not failure
            over = terminated[b] or (active and (success or broken[b] or failure))
            late = truncated[b] or (active and clocks[0, b] >= horizon and not over)
            flags[0, b], flags[1, b], flags[2, b], flags[3, b] = success, active and (over or late), over, late
            flags[4, b] = failure
            numbers[0, b], numbers[1, b], numbers[2, b] = distance, tip_step(before[b], after[b]), contacts
            numbers[3, b], numbers[4, b] = torques(c, action[b])
            change = effort_change(action[b], previous_action[b])
            progress = tip_to(before[b], target[b]) - distance
            reward(c, numbers[5:, b], distance, progress, change, contacts, in_contact, new_bins[b], success, failure)

    callees = {
        "tip_to": device(_make_tip_to(n_nodes, real)),
        "tip_step": device(_make_tip_step(n_nodes, real)),
        "torques": device(_make_torques(n_agents, real)),
        "effort_change": device(_make_effort_change(n_agents, real)),
        "reward": device(_make_reward(real)),
    }
    return cuda.jit(with_callees(kernel, callees))


def _make_tip_to(n_nodes: int, real: type) -> Callable[..., Any]:
    last = n_nodes - 1

    def tip_to(position, point):
        x, y, z = position[0, last] - point[0], position[1, last] - point[1], position[2, last] - point[2]
        return real(math.sqrt(x * x + y * y + z * z))

    return tip_to


def _make_tip_step(n_nodes: int, real: type) -> Callable[..., Any]:
    last = n_nodes - 1

    def tip_step(before, after):
        x, y = after[0, last] - before[0, last], after[1, last] - before[1, last]
        z = after[2, last] - before[2, last]
        return real(math.sqrt(x * x + y * y + z * z))

    return tip_step


def _make_torques(n_agents: int, real: type) -> Callable[..., Any]:
    zero, count = real(0.0), real(n_agents)

    def torques(c, action):
        """Mean over agents of the torque's norm, and the norm over all of them, N m."""
        total, square = zero, zero
        for i in range(n_agents):
            x, y = c.max_torque * real(action[i, 0]), c.max_torque * real(action[i, 1])
            own = x * x + y * y
            total += real(math.sqrt(own))
            square += own
        return total / count, real(math.sqrt(square))

    return torques


def _make_effort_change(n_agents: int, real: type) -> Callable[..., Any]:
    zero, count = real(0.0), real(2 * n_agents)

    def effort_change(action, previous):
        """Mean square of the actions' change."""
        total = zero
        for i in range(n_agents):
            for j in range(2):
                change = real(action[i, j] - previous[i, j])
                total += change * change
        return total / count

    return effort_change


def _make_reward(real: type) -> Callable[..., Any]:
    zero, one = real(0.0), real(1.0)

    def reward(c, out, distance, progress, change, contacts, in_contact, new_bins, success, failure):
        """The reward, and behind it its terms as in ``reward.reward_terms``."""
        touching = one if in_contact else zero
        still = one if abs(progress) < c.epsilon else zero
        found = real(new_bins)
        found = c.k_max if c.k_max < found else found
        first = -distance
        second = c.lambda_p * progress
        third = -c.lambda_da * change
        fourth = -c.lambda_t
        fifth = c.lambda_c * touching + c.lambda_cn * real(contacts) - (c.lambda_fail if failure else zero)
        sixth = c.lambda_d * found
        seventh = -c.lambda_s * touching * still
        eighth = c.lambda_succ if success else zero
        out[0] = first + second + third + fourth + fifth + sixth + seventh + eighth
        out[1], out[2], out[3], out[4] = first, second, third, fourth
        out[5], out[6], out[7], out[8] = fifth, sixth, seventh, eighth

    return reward
