"""Online discovery: obstacles cut into bins, bins found by agents, a table of slots that remembers them.

Paper, section "Graph Construction". Everything is batched over environments; a bin is a (cylinder, index) pair.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import torch
from tensordict import TensorClass
from torch import Tensor

from softgm_bench.envs import sensing_kernel
from softgm_bench.rod import sync
from softgm_bench.rod.state import Cylinders


class Bins(TensorClass):
    """All bins of all cylinders, known to the simulator alone; ``batch_size`` is ``(num_envs,)``.

    Attributes:
        descriptor: centre, axis, and (radius, cylinder length, normalised axial position of the centre):
            ``(num_envs, n_bins, 9)``.
        mask: which exist, ``(num_envs, n_bins)`` bool.
    """

    descriptor: Tensor
    mask: Tensor


class SlotTable(TensorClass):
    """The obstacle slots of the observation graph; ``batch_size`` is ``(num_envs,)``.

    Attributes:
        bin_of_slot: index of the bin in each slot, -1 for PAD, ``(num_envs, n_slots)`` int64.
        known: bins that were met before, stored or dropped, ``(num_envs, n_bins)`` bool.
        count: slots in use, ``(num_envs,)`` int64.
        dropped: bins that found no free slot, ``(num_envs,)`` int64.
    """

    bin_of_slot: Tensor
    known: Tensor
    count: Tensor
    dropped: Tensor


class Sight(NamedTuple):
    """All that the agents of ``num_envs`` environments sense and have discovered, after one sensing.

    Attributes:
        table: with what has just been discovered.
        new: bins that were stored by this look, ``(num_envs,)`` int64.
        descriptor: of the slots, zero for PAD, ``(num_envs, n_slots, 9)`` float32.
        active: slots that hold a bin, ``(num_envs, n_slots)`` bool.
        edge: agent senses the slot's bin now, ``(num_envs, n_agents, n_slots)`` bool.
    """

    table: SlotTable
    new: Tensor
    descriptor: Tensor
    active: Tensor
    edge: Tensor


def bins_per_cylinder(max_length: float, bin_length: float) -> int:
    """Count the bins that the longest cylinder is cut into; the last one may be shorter."""
    return math.ceil(max_length / bin_length - 1e-9)


def cut_into_bins(cylinders: Cylinders, bin_length: float, max_length: float) -> Bins:
    """Cut every cylinder along its axis into bins of ``bin_length`` m from its start.

    Args:
        cylinders: ``n_cylinders`` an environment.
        bin_length: m; the last bin of a cylinder ends where the cylinder does.
        max_length: of any cylinder, m; fixes the number of bins.

    Returns:
        ``n_cylinders * bins_per_cylinder(max_length, bin_length)`` bins, cylinder by cylinder.
    """
    length = cylinders.length.unsqueeze(-1)  # (num_envs, n_cylinders, 1)
    near, end = _bounds(bins_per_cylinder(max_length, bin_length), bin_length, length.dtype, length.device)
    far = torch.minimum(end, length)
    mask = cylinders.mask.unsqueeze(-1) & (near < length - 1e-9)
    middle = (0.5 * (near + far)).unsqueeze(-1)  # (num_envs, n_cylinders, n, 1)
    axis = cylinders.axis.unsqueeze(-2).expand(*mask.shape, 3)
    centre = cylinders.start.unsqueeze(-2) + middle * axis
    length = length.unsqueeze(-1).expand_as(middle)
    radius = cylinders.radius.unsqueeze(-1).unsqueeze(-1).expand_as(middle)
    descriptor = torch.cat([centre, axis, radius, length, middle / length], dim=-1) * mask.unsqueeze(-1)
    return Bins(descriptor=descriptor.flatten(1, 2), mask=mask.flatten(1, 2), batch_size=cylinders.batch_size)


@lru_cache
def _bounds(n: int, bin_length: float, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Where the bins of a long cylinder begin and end along its axis, m, ``(n,)`` each; not to be changed."""
    near = bin_length * torch.arange(n, dtype=dtype, device=device)
    return near, near + bin_length


def empty_table(num_envs: int, n_slots: int, n_bins: int, device: torch.device) -> SlotTable:
    """Make a table in which nothing has been discovered."""
    count = torch.zeros(num_envs, dtype=torch.int64, device=device)
    return SlotTable(
        bin_of_slot=torch.full((num_envs, n_slots), -1, dtype=torch.int64, device=device),
        known=torch.zeros((num_envs, n_bins), dtype=torch.bool, device=device),
        count=count,
        dropped=count.clone(),
        batch_size=[num_envs],
    )


def look(
    agent_position: Tensor,
    cylinders: Cylinders,
    bins: Bins,
    table: SlotTable,
    sensing_radius: float,
    bin_length: float,
) -> Sight:
    """Sense, discover, observe: a compiled loop on the CPU, a kernel on a GPU, ``look_dense`` elsewhere.

    Args:
        agent_position: m, ``(num_envs, n_agents, 3)``.
        cylinders: what was cut into ``bins``.
        bins: of the same environments, ``cut_into_bins(cylinders, bin_length, ...)``.
        table: not changed.
        sensing_radius: rho, m.
        bin_length: m.

    Returns:
        What the agents see; equal, bit by bit, to ``look_dense``.
    """
    device = agent_position.device
    if not bins.mask.shape[1]:
        return _nothing(agent_position, table)
    if sync.is_free(device):
        return _look_compiled(agent_position, cylinders, bins, table, sensing_radius, bin_length)
    if sync.runs_kernels(device) and table.bin_of_slot.shape[1]:  # kernels take no empty arrays
        return _look_on_gpu(agent_position, bins, table, sensing_radius)
    return look_dense(agent_position, bins, table, sensing_radius)


def _nothing(agent_position: Tensor, table: SlotTable) -> Sight:
    """What is seen where there are no bins."""
    shape, device = table.bin_of_slot.shape, table.count.device
    return Sight(
        table=table,
        new=torch.zeros_like(table.count),
        descriptor=torch.zeros((*shape, 9), dtype=torch.float32, device=device),
        active=torch.zeros(shape, dtype=torch.bool, device=device),
        edge=torch.zeros((shape[0], agent_position.shape[1], shape[1]), dtype=torch.bool, device=device),
    )


def _look_compiled(
    agent_position: Tensor,
    cylinders: Cylinders,
    bins: Bins,
    table: SlotTable,
    sensing_radius: float,
    bin_length: float,
) -> Sight:
    seen = _nothing(agent_position, table)
    updated = [value.clone() for value in (table.bin_of_slot, table.known, table.count, table.dropped)]
    scene = (cylinders.start, cylinders.axis, cylinders.length, cylinders.radius, cylinders.mask)
    read = sync.arrays(agent_position, *scene, bins.descriptor, bins.mask)
    real = read[0].dtype.type
    written = sync.arrays(*updated, seen.new, seen.descriptor, seen.active, seen.edge)
    arguments = [*read, real(sensing_radius), real(bin_length), *written]
    sensing_kernel.look(*arguments)
    return seen._replace(table=SlotTable(*updated, batch_size=table.batch_size))


def _look_on_gpu(agent_position: Tensor, bins: Bins, table: SlotTable, sensing_radius: float) -> Sight:
    from softgm_bench.envs import cuda_sensing  # only where Numba's CUDA target is

    known = (table.bin_of_slot, table.known, table.count, table.dropped)
    seen = cuda_sensing.look(agent_position, bins.descriptor, bins.mask, known, sensing_radius)
    return Sight(SlotTable(*seen[:4], batch_size=table.batch_size), *seen[4:])


def look_dense(agent_position: Tensor, bins: Bins, table: SlotTable, sensing_radius: float) -> Sight:
    """``look`` by testing every agent against every bin."""
    sensed = sense(agent_position, bins, sensing_radius)
    table, new = discover(table, sensed)
    descriptor, active, edge = observe_slots(table, bins, sensed)
    return Sight(table, new, descriptor.to(torch.float32), active, edge)


def sense(agent_position: Tensor, bins: Bins, sensing_radius: float) -> Tensor:
    """Sense bins by the paper's test, ``||p_i - c_k|| - r_k < rho``.

    Args:
        agent_position: m, ``(num_envs, n_agents, 3)``.
        bins: of the same environments.
        sensing_radius: rho, m.

    Returns:
        ``(num_envs, n_agents, n_bins)`` bool.
    """
    x, y, z = (agent_position[..., i].unsqueeze(-1) - bins.descriptor[..., i].unsqueeze(1) for i in range(3))
    # in the compiled loops' order; torch.cdist takes 22 ms on an H200 where these take under 1
    distance = x.mul_(x).add_(z.mul_(z)).add_(y.mul_(y)).sqrt_()
    return (distance - bins.descriptor[..., 6].unsqueeze(1) < sensing_radius) & bins.mask.unsqueeze(1)


def discover(table: SlotTable, sensed: Tensor) -> tuple[SlotTable, Tensor]:
    """Put newly sensed bins into the first free slots, in the order of their index.

    Args:
        table: not changed.
        sensed: ``(num_envs, n_agents, n_bins)`` bool.

    Returns:
        The table after this step, and the number of bins stored by it, ``(num_envs,)`` int64.
    """
    new = sensed.any(dim=1) & ~table.known
    slot = table.count.unsqueeze(-1) + new.cumsum(dim=-1) - 1
    n_slots = table.bin_of_slot.shape[1]
    stored = new & (slot < n_slots)
    # what is not stored goes to one slot too many, which is cut off again
    bin_of_slot = torch.nn.functional.pad(table.bin_of_slot, (0, 1))
    index = torch.arange(new.shape[1], device=new.device).expand_as(slot)
    bin_of_slot = bin_of_slot.scatter_(1, torch.where(stored, slot, n_slots), index)[:, :n_slots]
    n_stored = stored.sum(dim=-1)
    return (
        SlotTable(
            bin_of_slot=bin_of_slot.contiguous(),
            known=table.known | new,
            count=table.count + n_stored,
            dropped=table.dropped + new.sum(dim=-1) - n_stored,
            batch_size=table.batch_size,
        ),
        n_stored,
    )


def observe_slots(table: SlotTable, bins: Bins, sensed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Show the graph's obstacle slots.

    Returns:
        Descriptors ``(num_envs, n_slots, 9)``, zero for PAD; active slots ``(num_envs, n_slots)``; edges from slot to
        agent ``(num_envs, n_agents, n_slots)``, which exist while the agent senses the slot's bin.
    """
    active = table.bin_of_slot >= 0
    index = table.bin_of_slot.clamp(min=0)
    descriptor = bins.descriptor.gather(1, index.unsqueeze(-1).expand(-1, -1, 9)) * active.unsqueeze(-1)
    edge = sensed.gather(2, index.unsqueeze(1).expand(-1, sensed.shape[1], -1)) & active.unsqueeze(1)
    return descriptor, active, edge
