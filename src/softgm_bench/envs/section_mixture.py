"""A mixture of numbers of sections in one run: ``task.n_agents=[4, 6, 8]``.

Each number has environments of its own, with a dimension of agents of its own length, side by side with the others'.
So there is nothing to pad or mask in environments, models and losses: what is computed for arms of one number is, bit
by bit, what a run with that number alone would compute.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from softgm_bench.errors import UserError


def numbers_of(task: Any) -> tuple[int, ...]:
    """Give the numbers of sections that a task's configuration mixes, in their order; none where it has one number."""
    given = getattr(task, "n_agents", None)
    return tuple(given) if isinstance(given, list | tuple) else ()


def check_numbers(given: Any) -> None:
    """Refuse what is neither a number of sections nor a list of different ones.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    numbers = given if isinstance(given, list | tuple) else [given]
    if any(isinstance(number, bool) or not isinstance(number, int) for number in numbers):
        raise ValueError(f"task.n_agents is {given}: it must be a whole number, or a list of several as in [4, 6, 8]")
    if not numbers or min(numbers) < 1:
        raise ValueError(f"task.n_agents is {given}: it must be at least 1")
    if len(set(numbers)) < len(numbers):
        raise ValueError(f"task.n_agents is {given}: every number may stand there once")


def refuse_mixture(task: Any) -> None:
    """Refuse a task's configuration that mixes numbers of sections, where one arm is wanted.

    Raises:
        UserError: with one line.
    """
    if numbers := numbers_of(task):
        raise UserError(
            f"task.n_agents={list(numbers)}: this is for arms of one number of sections; "
            f"name one, as in task.n_agents={numbers[0]}"
        )


def members(settings: Any) -> dict[int, Any]:
    """Give the settings for each number of sections by that number; none where ``settings.task`` has one number."""
    task = settings.task
    return {number: replace(settings, task=replace(task, n_agents=number)) for number in numbers_of(task)}


def shares(total: int, parts: int) -> list[int]:
    """Share ``total`` as evenly as whole numbers allow, larger shares first."""
    return [total // parts + (part < total % parts) for part in range(parts)]


class SectionMixture:
    """An ``Environment`` in everything but its steps: those are its members', each of which is stepped by itself.

    Attributes:
        members: environments by their number of sections.
        sizes: of the member with most sections.
        horizon: control steps until an episode is truncated.
        device: of all entries.
        batch_size: none, for members have nothing in common but their control step.
    """

    def __init__(self, members: Mapping[int, Any]) -> None:
        """Put environments side by side, each an ``EnvBase`` that is an ``Environment``."""
        self.members = dict(members)
        largest = self.members[max(self.members)]
        self.sizes, self.horizon, self.device = largest.sizes, largest.horizon, largest.device
        self.batch_size = torch.Size([])

    def generator_state(self) -> Tensor:
        """Give the states of all members' generators, one row each."""
        states = [member.generator_state() for member in self.members.values()]
        return torch.cat([state.reshape(-1, state.shape[-1]) for state in states])

    def set_generator_state(self, state: Tensor) -> None:
        """Continue drawing from what ``generator_state`` returned."""
        for member, rows in zip(self.members.values(), state.chunk(len(self.members)), strict=True):
            member.set_generator_state(rows)

    def simulation_state(self) -> TensorDict:
        """Give a copy of all episodes as they stand, nested by ``n<number>``."""
        return TensorDict({f"n{number}": member.simulation_state() for number, member in self.members.items()}, [])

    def load_simulation_state(self, state: TensorDictBase) -> None:
        """Continue from what ``simulation_state`` returned for as many environments of the same mixture."""
        for number, member in self.members.items():
            own = state.get(f"n{number}").to_dict()
            member.load_simulation_state(TensorDict(own, member.batch_size, device=member.device))
