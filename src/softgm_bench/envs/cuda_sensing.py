# Compiled callees reach a function as globals (see rod.callees), out of the linters' sight.
# ruff: noqa: F821
# mypy: disable-error-code="name-defined"
"""``softgm_bench.envs.sensing`` as one CUDA kernel: a block an environment, its threads share the bins and the slots.

New bins are numbered in the order of their index, whatever order threads run in: every thread has a run of consecutive
bins, and what those before it have found is added up between two barriers. Products are rounded as on the CPU, so that
all that is sensed there is sensed here.
"""

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from numba import cuda
from torch import Tensor

from softgm_bench.envs import sensing_kernel
from softgm_bench.rod.callees import with_callees
from softgm_bench.rod.cuda_kernel import device
from softgm_bench.rod.cuda_launch import REAL, launch, make_product
from softgm_bench.rod.scalar_contact import smaller

THREADS = 128  # of a block


def look(
    agents: Tensor,
    descriptor: Tensor,
    mask: Tensor,
    table: tuple[Tensor, Tensor, Tensor, Tensor],
    sensing_radius: float,
) -> tuple[Tensor, ...]:
    """Sense, discover and show in every environment, in one launch.

    Args:
        agents: m, ``(num_envs, n_agents, 3)``.
        descriptor: of the bins, ``(num_envs, n_bins, 9)``, in the precision of ``agents``.
        mask: which exist, ``(num_envs, n_bins)`` bool.
        table: ``bin_of_slot``, ``known``, ``count`` and ``dropped``; not changed.
        sensing_radius: rho, m.

    Returns:
        The new ``bin_of_slot``, ``known``, ``count`` and ``dropped``, then ``new``, ``descriptor``, ``active`` and
        ``edge`` of ``sensing.Sight``: parts of three buffers.
    """
    num_envs, n_agents, _ = agents.shape
    n_bins, n_slots = mask.shape[1], table[0].shape[1]
    whole = (n_slots, 1, 1, 1)  # bin_of_slot, count, dropped, new
    flags = (n_bins, n_slots, n_agents * n_slots)  # known, active, edge
    integers = torch.empty(num_envs * sum(whole), dtype=torch.int64, device=agents.device)
    truths = torch.empty(num_envs * sum(flags), dtype=torch.bool, device=agents.device)
    shown = torch.empty((num_envs, n_slots, 9), dtype=torch.float32, device=agents.device)
    real = REAL[agents.dtype]
    read = (agents, descriptor, mask, *table)
    launch(
        make_look(n_agents, n_bins, n_slots, real),
        num_envs,
        THREADS,
        [*(value.contiguous() for value in read), integers, truths, shown],
        real(sensing_radius),
    )
    bin_of_slot, count, dropped, new = (
        part.view(num_envs, -1) for part in integers.split([num_envs * size for size in whole])
    )
    known, active, edge = (part.view(num_envs, -1) for part in truths.split([num_envs * size for size in flags]))
    counts = (part.view(num_envs) for part in (count, dropped, new))
    return bin_of_slot, known, *counts, shown, active, edge.view(num_envs, n_agents, n_slots)


@lru_cache
def make_look(n_agents: int, n_bins: int, n_slots: int, real: type) -> Callable[..., Any]:
    """Build the kernel for one size of scene and one precision; launch with a block of ``THREADS`` an environment.

    Arguments: those of ``look``, its three buffers, the radius.
    """
    run = -(-n_bins // THREADS)  # bins of a thread
    senses = device(_senses, senses=device(sensing_kernel.senses, product=make_product(real)))
    meet = device(_make_meet(n_agents), senses=senses)
    store = device(_store)
    show = device(_make_show(n_agents, n_slots, real), senses=senses)

    def look(agents, descriptor, mask, bin_of_slot, known, count, dropped, integers, truths, shown, sensing_radius):
        b, t, num_envs = cuda.blockIdx.x, cuda.threadIdx.x, cuda.gridDim.x
        found = cuda.shared.array(THREADS, np.int32)
        first, last = t * run, smaller(t * run + run, n_bins)
        slots, flags = integers[b * n_slots : (b + 1) * n_slots], truths[b * n_bins : (b + 1) * n_bins]
        found[t] = meet(agents[b], descriptor[b], mask[b], known[b], flags, first, last, sensing_radius)
        for s in range(t, n_slots, THREADS):
            slots[s] = bin_of_slot[b, s]
        cuda.syncthreads()
        before, total = 0, 0
        for other in range(THREADS):
            before += found[other] if other < t else 0
            total += found[other]
        store(slots, known[b], flags, first, last, count[b] + before)
        if t == 0:
            stored = smaller(total, n_slots - count[b])
            integers[num_envs * n_slots + b] = count[b] + stored
            integers[num_envs * (n_slots + 1) + b] = dropped[b] + total - stored
            integers[num_envs * (n_slots + 2) + b] = stored
        cuda.syncthreads()
        active, edge = num_envs * n_bins + b * n_slots, num_envs * (n_bins + n_slots) + b * n_agents * n_slots
        for s in range(t, n_slots, THREADS):
            truths[active + s] = slots[s] >= 0
            show(agents[b], descriptor[b], slots[s], shown[b, s], truths[edge:], s, sensing_radius)

    return cuda.jit(with_callees(look, {"smaller": device(smaller), "meet": meet, "store": store, "show": show}))


def _senses(agents, i, bin, sensing_radius):
    """Tell whether an agent senses a bin that exists."""
    return senses(agents[i, 0], agents[i, 1], agents[i, 2], bin[0], bin[1], bin[2], bin[6], sensing_radius)


def _make_meet(n_agents: int) -> Callable[..., Any]:
    def meet(agents, descriptor, mask, known, flags, first, last, sensing_radius):
        """Note which bins of a run are known now; returns how many are so for the first time."""
        new = 0
        for k in range(first, last):
            met = False
            if mask[k] and not known[k]:
                for i in range(n_agents):
                    met |= senses(agents, i, descriptor[k], sensing_radius)
            flags[k] = known[k] or met
            new += 1 if met else 0
        return new

    return meet


def _store(slots, known, flags, first, last, slot):
    """Put a run's new bins into the slots from ``slot`` on, as far as there are any."""
    for k in range(first, last):
        if flags[k] and not known[k]:
            if slot < slots.shape[0]:
                slots[slot] = k
            slot += 1


def _make_show(n_agents: int, n_slots: int, real: type) -> Callable[..., Any]:
    zero = real(0.0)

    def show(agents, descriptor, k, shown, edge, s, sensing_radius):
        """Describe slot ``s``, which holds bin ``k``, and tell who senses that bin now."""
        for i in range(9):
            shown[i] = descriptor[k, i] if k >= 0 else zero
        for i in range(n_agents):
            edge[i * n_slots + s] = k >= 0 and senses(agents, i, descriptor[k], sensing_radius)

    return show
