"""The observation as features of agents and slots, and as the flat view of an MLP: pure functions of its entries.

Shapes: ``...`` are any leading batch dimensions (time, environment), N agents, M obstacle slots.
"""

from collections.abc import Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from softgm_bench.envs import entries
from softgm_bench.rod.sync import constant

CHANNELS = 15  # of an agent or a slot, without the paper's reserved zeros

# What changes its sign in a mirror in the plane y = 0, along an entry's last dimension. A couple is an axial vector and
# its binormal part, which bends the arm sideways, changes; directors at rest are the axes.
MIRRORED: dict[NestedKey, tuple[float, ...]] = {
    entries.AGENT_POSITION: (1.0, -1.0, 1.0),
    entries.AGENT_VELOCITY: (1.0, -1.0, 1.0),
    entries.PREVIOUS_ACTION: (1.0, -1.0),
    entries.SLOT_DESCRIPTOR: (1.0, -1.0, 1.0, 1.0, -1.0, 1.0, 1.0, 1.0, 1.0),
    entries.TIP: (1.0, -1.0, 1.0),
    entries.TARGET: (1.0, -1.0, 1.0),
}


def mirrored(
    td: TensorDictBase, privileged_image: Sequence[tuple[int, float]] = (), where: Tensor | None = None
) -> TensorDictBase:
    """Give the observation in ``td`` as a mirror in the plane y = 0 shows it; slots stay in their places.

    An arm that is moved by mirrored actions among mirrored obstacles observes this, bit by bit. With a
    ``privileged_image`` (``interface.Sizes``) the image has the privileged numbers too. ``where``, bool ``(..., 1)``:
    frames that are mirrored, if not all are; the others stay as they are.
    """
    image = td.select(*entries.OBSERVATION)
    if privileged_image:
        known, (order, signs) = td.get(entries.PRIVILEGED), zip(*privileged_image, strict=True)
        there = known[..., constant(order, known.device, torch.int64)] * constant(signs, known.device, torch.float32)
        image.set(entries.PRIVILEGED, there if where is None else torch.where(where, there, known))
    for key, signs in MIRRORED.items():
        value = image.get(key)
        factor = constant(signs, value.device, torch.float32)
        if where is not None:
            factor = torch.where(where if value.ndim == where.ndim else where.unsqueeze(-2), factor, 1.0)
        image.set(key, value * factor)
    return image


def agent_channels(td: TensorDictBase, velocity_scale: float = 1.0) -> Tensor:
    """Give the agents' features without the reserved zeros, ``(..., N, 15)``.

    In order: position, velocity, previous action (tangential zero, normal, binormal), target - position,
    tip - position. The velocity is multiplied by ``velocity_scale``; 1 is the paper.
    """
    position, velocity, action = td[entries.AGENT_POSITION], td[entries.AGENT_VELOCITY], td[entries.PREVIOUS_ACTION]
    target, tip = td[entries.TARGET].unsqueeze(-2), td[entries.TIP].unsqueeze(-2)
    tangential = action.new_zeros(()).expand(*action.shape[:-1], 1)
    if velocity_scale != 1.0:
        velocity = velocity * velocity_scale
    return torch.cat([position, velocity, tangential, action, target - position, tip - position], dim=-1)


def relative_points(td: TensorDictBase, n_points: int) -> Tensor:
    """Give the privileged points from where each agent is, as it is given the target: ``(..., N, 3 n_points)``."""
    points = td[entries.PRIVILEGED][..., : 3 * n_points].unflatten(-1, (n_points, 3))
    return (points.unsqueeze(-3) - td[entries.AGENT_POSITION].unsqueeze(-2)).flatten(-2)


def slot_channels(td: TensorDictBase) -> Tensor:
    """Give the slots' features without the reserved zeros, ``(..., M, 15)``; an inactive slot (PAD) is exactly zero.

    In order: centre, axis, (radius, length, normalised axial position), target - centre, tip - centre.
    """
    descriptor, active = td[entries.SLOT_DESCRIPTOR], td[entries.SLOT_ACTIVE].unsqueeze(-1)
    target, tip = td[entries.TARGET].unsqueeze(-2), td[entries.TIP].unsqueeze(-2)
    return torch.where(active, obstacle_channels(descriptor, target, tip), 0.0)


def obstacle_channels(descriptor: Tensor, target: Tensor, tip: Tensor) -> Tensor:
    """Give obstacle nodes' features from descriptors ``(..., 9)``, targets and tips that broadcast to ``(..., 3)``."""
    centre = descriptor[..., :3]
    return torch.cat([descriptor, target - centre, tip - centre], dim=-1)


def flat_observation(td: TensorDictBase) -> Tensor:
    """Give the flat view of an MLP, per agent, ``(..., N, F)`` with F = ``flat_features(M)``: the graph's content.

    In order: the agent's own 15 channels, the 15 channels of slot 0, 1, .., M - 1, the agent's own row of M sensed
    edges as 0 or 1. The 7 reserved zeros of each node carry nothing and are left out.
    """
    own, slots = agent_channels(td), slot_channels(td)
    shared = slots.flatten(-2).unsqueeze(-2).expand(*own.shape[:-1], -1)
    return torch.cat([own, shared, td[entries.EDGE].to(own.dtype)], dim=-1)


def flat_features(n_slots: int) -> int:
    """Give the length of one agent's flat observation."""
    return CHANNELS + n_slots * (CHANNELS + 1)
