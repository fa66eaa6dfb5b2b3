"""Interventions: a policy is shown something else than what its agents have found out. The world is left as it is.

What success an intervention costs, on the same scenes, says what a policy makes of the entry that was changed. Each is
a function of the whole frame of an evaluation, ``(episodes,)``, and not of a policy's input: that holds only the
episodes that go on, and another scene must stay the same other scene to an episode's end.
"""

from collections.abc import Callable

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor

from softgm_bench.envs import entries, kind_of
from softgm_bench.episodes.policy import TrainedPolicy
from softgm_bench.errors import UserError

Intervention = Callable[[TensorDictBase], TensorDictBase]

OBSTACLES = (entries.SLOT_DESCRIPTOR, entries.SLOT_ACTIVE, entries.EDGE)
LENGTHS = slice(7, 9)  # of a descriptor: the cylinder's length, the bin's normalised axial position
SWAPS = ("swap_obstacles", "swap_opening")  # take two scenes


def blind(frame: TensorDictBase) -> TensorDictBase:
    """Show no obstacle: no slot is active, no edge exists."""
    return _with(frame, {key: frame.get(key).new_zeros(()).expand_as(frame.get(key)) for key in OBSTACLES})


def swap_obstacles(frame: TensorDictBase) -> TensorDictBase:
    """Show the next environment's slots and edges."""
    return _with(frame, {key: _next_scenes(frame.get(key)) for key in OBSTACLES})


def sensed_only(frame: TensorDictBase) -> TensorDictBase:
    """Show the slots alone that some agent senses now: nothing is remembered."""
    sensed = frame.get(entries.EDGE).any(dim=-2)
    descriptor = frame.get(entries.SLOT_DESCRIPTOR) * sensed.unsqueeze(-1)
    return _with(frame, {entries.SLOT_ACTIVE: sensed, entries.SLOT_DESCRIPTOR: descriptor})


def swap_opening(frame: TensorDictBase) -> TensorDictBase:
    """Tell what the task knows of the next environment's scene."""
    return _with(frame, {entries.PRIVILEGED: _next_scenes(frame.get(entries.PRIVILEGED))})


def hide_lengths(frame: TensorDictBase) -> TensorDictBase:
    """Show a bin without how long its cylinder is and where on it the bin lies: both are 0."""
    descriptor = frame.get(entries.SLOT_DESCRIPTOR).clone()
    descriptor[..., LENGTHS] = 0.0
    return _with(frame, {entries.SLOT_DESCRIPTOR: descriptor})


def forget(frame: TensorDictBase) -> TensorDictBase:
    """Let a policy that remembers begin every step with an empty memory."""
    state = frame.get(entries.MEMORY, None)  # absent before the first step
    return frame if state is None else _with(frame, {entries.MEMORY: torch.zeros_like(state)})


INTERVENTIONS: dict[str, Intervention | None] = {"none": None} | {
    intervention.__name__: intervention
    for intervention in (blind, swap_obstacles, sensed_only, swap_opening, hide_lengths, forget)
}


def check(name: str, episodes: int, batch: int | None) -> None:
    """Refuse an intervention that there is not, or that so many episodes at once cannot have.

    Raises:
        UserError: saying what would be right.
    """
    if name not in INTERVENTIONS:
        raise UserError(f"intervention={name}: choose one of {', '.join(INTERVENTIONS)}")
    size = min(batch or episodes, episodes)
    if name in SWAPS and 1 in (size, episodes % size):
        raise UserError(
            f"intervention={name} takes another scene: episodes={episodes} with batch={batch or 'null'} plays one alone"
        )


def check_fits(name: str, trained: TrainedPolicy) -> None:
    """Refuse an intervention on what neither the policy nor its task has.

    Raises:
        UserError: saying what is missing.
    """
    task = trained.config.task
    if name == "swap_opening":
        if entries.PRIVILEGED not in trained.policy.in_keys:
            raise UserError(f"intervention={name}: this policy is told no opening; an oracle's is, on a wall")
    elif name == "forget":
        if entries.MEMORY not in trained.policy.in_keys:
            raise UserError(f"intervention={name}: this policy has no memory; one of algo.actor.memory has")
    elif name != "none" and not kind_of(task).sizes(task).n_slots:
        raise UserError(f"intervention={name}: task={task.name} shows no obstacles")


def _with(frame: TensorDictBase, changes: dict[NestedKey, Tensor]) -> TensorDictBase:
    """Change entries of a shallow copy."""
    shown = frame.copy()
    for key, value in changes.items():
        shown.set(key, value)
    return shown


def _next_scenes(values: Tensor) -> Tensor:
    """Give every environment the next one's, and the last one the first one's: nobody keeps its own."""
    return values.roll(-1, dims=0)
