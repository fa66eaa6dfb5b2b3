"""How frames are laid out in a data set's files: observations once, flags of slots as bits, obstacles once an episode.

A frame is what an environment shows at a time, with the action that was taken there and what the step paid under
``next``, where TorchRL looks for it. An episode of T steps has T + 1 frames; the last one, ``FINAL``, has no action and
pays nothing. So the next observation of a frame is the observation of the frame behind it, which is stored anyway.

Graph observations have many slots for obstacles, of which few are in use. A file holds the rows of descriptors in
``TABLE``, and a frame says where its own begin and how many they are. Frames of an episode share rows: slots are only
added, so the last frame's rows are all of them. Where an obstacle moves, a frame has rows of its own.
"""

from collections.abc import Iterable, Mapping

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from torch import Tensor
from torchrl.envs import EnvBase

from softgm_bench.envs import entries
from softgm_bench.envs.interface import GRAPH, Sizes

FRAMES, TABLE, EPISODES = "frames", "obstacles", "episodes"  # the parts of a file
EPISODE, POLICY, FINAL = "episode", "policy", "final"  # entries of frames beside those of the environment
# Of graph observations, in place of descriptors, active slots and edges.
EDGE_BITS = ("agents", "edge_bits")  # (N, ceil(M / 8)) uint8; bit k % 8 of byte k // 8 is the agent's edge to slot k
SLOT_BEGIN, SLOT_COUNT = ("slots", "begin"), ("slots", "count")  # int64, int16: rows of ``TABLE``
PACKED = (entries.EDGE, entries.SLOT_ACTIVE, entries.SLOT_DESCRIPTOR)

DESCRIPTOR = 9  # numbers in a row of ``TABLE``
PAID = (entries.REWARD, entries.TERMINATED, entries.TRUNCATED, entries.DONE)  # under "next", where there are no terms


def observed(env: EnvBase) -> list[NestedKey]:
    """Give the entries that an environment shows, without metrics and terms of the reward."""
    keys = env.observation_spec.keys(include_nested=True, leaves_only=True)
    return [key for key in keys if key[0] not in ("info", entries.REWARD_TERMS)]


def paid(env: EnvBase) -> list[NestedKey]:
    """Give the entries of a step's end: ``PAID``, and terms of the reward where there are any."""
    keys = env.observation_spec.keys(include_nested=True, leaves_only=True)
    return [*PAID, *(key for key in keys if key[0] == entries.REWARD_TERMS)]


def under_next(key: NestedKey) -> tuple[str, ...]:
    """Give the key of an entry of a step's end."""
    return ("next", key) if isinstance(key, str) else ("next", *key)


def bits(flags: Tensor) -> Tensor:
    """Pack ``(..., M)`` bool into ``(..., ceil(M / 8))`` uint8, the first flag in the lowest bit."""
    missing = -flags.shape[-1] % 8
    padded = torch.nn.functional.pad(flags, (0, missing)).unflatten(-1, (-1, 8))
    return (padded * _powers(flags.device)).sum(-1, dtype=torch.uint8)


def flags(packed: Tensor, count: int) -> Tensor:
    """Give the ``count`` flags, ``(..., count)`` bool, that ``bits`` packed."""
    return (packed.unsqueeze(-1) & _powers(packed.device)).bool().flatten(-2)[..., :count]


def unpack(frames: TensorDictBase, table: Tensor, sizes: Sizes) -> dict[NestedKey, Tensor]:
    """Give frames ``(size,)`` of a file as the environment shows them, by key, without what a step's end pays.

    Args:
        frames: entries as they are stored.
        table: the file's rows of descriptors, ``(rows, 9)``.
        sizes: of the environment.
    """
    values = {
        key: value
        for key, value in frames.items(include_nested=True, leaves_only=True)
        if key[0] != "next" and key not in (EDGE_BITS, SLOT_BEGIN, SLOT_COUNT)
    }
    if sizes.layout != GRAPH:
        return values
    if not sizes.n_slots:
        return values | {
            key: torch.zeros((len(frames), *entries.shape_of(key, sizes)), dtype=entries.TABLE[key].dtype)
            for key in PACKED
        }
    count, slots = frames[SLOT_COUNT], torch.arange(sizes.n_slots)
    active = slots < count.unsqueeze(-1)
    rows = torch.where(active, frames[SLOT_BEGIN].unsqueeze(-1) + slots, 0)
    size = (*active.shape, DESCRIPTOR)
    descriptor = torch.where(active.unsqueeze(-1), table[rows], 0.0) if len(table) else torch.zeros(size)
    return values | {
        entries.EDGE: flags(frames[EDGE_BITS], sizes.n_slots),
        entries.SLOT_ACTIVE: active,
        entries.SLOT_DESCRIPTOR: descriptor,
    }


def joined(parts: Iterable[TensorDictBase]) -> TensorDict:
    """Put contents of files one behind the other, as the content of one file."""
    parts = list(parts)
    moved, frame, row = [], 0, 0
    for part in parts:
        copy = part.clone(recurse=False)
        copy[EPISODES, "begin"] = part[EPISODES, "begin"] + frame
        if part.get(TABLE, None) is not None:
            copy[FRAMES] = part[FRAMES].clone(recurse=False)
            copy[FRAMES].set(SLOT_BEGIN, part[FRAMES, *SLOT_BEGIN] + row)
            row += len(part[TABLE])
        frame += len(part[FRAMES])
        moved.append(copy)
    return TensorDict({name: torch.cat([part[name] for part in moved]) for name in sorted(parts[0].keys())})


def nested(values: Mapping[NestedKey, Tensor], size: int) -> TensorDict:
    """Put entries ``(size, ...)`` into one nested tensordict whose every level has the batch size ``(size,)``."""
    td = TensorDict({}, [size])
    for key, value in values.items():
        td.set(key, value)
    return td


def _powers(device: torch.device) -> Tensor:
    return (2 ** torch.arange(8, device=device)).to(torch.uint8)
