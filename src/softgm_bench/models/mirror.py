"""Heads of actors that commute with the mirror in the plane y = 0.

M mirrors the observation, S what a head f says of actions, whose binormal part changes its sign. On every task of the
arm a scene is as likely as its mirror image, so there is a best policy g with ``g(M o) = S g(o)``. An ordinary network
has to learn each side by itself, and may settle on one. There are two ways to have it so for any f:

- ``average``: ``g(o) = (f(o) + S f(M o)) / 2``, at the price of two passes of the network. It bends to neither side
  where both look the same. (Frame averaging over the whole group, Puny et al. 2022.)
- ``canonical``: f only ever sees targets on the arm's left (y >= 0): ``g(o) = f(o)`` there and ``S f(M o)`` where the
  target is on the right. One pass. (Canonicalisation, Kaba et al. 2023.)
"""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn

from softgm_bench.envs import entries
from softgm_bench.models import graph
from softgm_bench.rod.sync import constant

if TYPE_CHECKING:
    from softgm_bench.models.heads import AgentHead
    from softgm_bench.models.memory import Memory

AVERAGE, CANONICAL = "average", "canonical"


def check_mirror(mirror: str | None) -> None:
    """Refuse what is no way to mirror.

    Raises:
        ValueError: with one line naming the key, its value and what would be right.
    """
    if mirror is not None and mirror not in WAYS:
        raise ValueError(f"algo.actor.mirror is {mirror}: choose {', '.join(WAYS)} or null")


class MirroredHead(nn.Module):
    """What both ways share; subclasses say what the head sees and what becomes of its answers.

    Attributes:
        head: f.
        in_keys: the entries that are read.
        states: hidden states that an agent has side by side, if f has a memory.
    """

    states = 1

    def __init__(self, head: "AgentHead", privileged_image: Sequence[tuple[int, float]] = ()) -> None:
        """Mirror ``head``, whose outputs are an agent's action and, where there are more, even functions.

        One that reads privileged numbers needs their ``privileged_image`` (``interface.Sizes``).
        """
        super().__init__()
        self.head, self.in_keys = head, head.in_keys
        self.privileged_image = tuple(privileged_image) if head.n_privileged else ()
        signs = graph.MIRRORED[entries.PREVIOUS_ACTION]
        self.signs = (*signs, *[1.0] * (head.out_features - len(signs)))

    @property
    def function(self) -> nn.Sequential:
        """The head's."""
        return self.head.function

    @property
    def memory(self) -> "Memory | None":
        """The head's."""
        return self.head.memory

    def inputs(self, td: TensorDictBase) -> Tensor:
        """What the head reads of what is there; an average's of its image would come second."""
        return self.head.inputs(self.views(td)[0])

    def views(self, td: TensorDictBase) -> list[TensorDictBase]:
        """What the head sees, once or more often, each with the hidden state that belongs to it."""
        views = self.sights(td)
        if self.memory is None:
            return views
        state = td.get(entries.MEMORY, None)
        if state is None:
            agents = td.get(entries.AGENT_POSITION)
            state = agents.new_zeros(*agents.shape[:-1], self.states * self.memory.size)
            td.set(entries.MEMORY, state)
        known = td.get(entries.IS_INIT)
        return [
            view.select(*self.in_keys, strict=False).set(entries.IS_INIT, known).set(entries.MEMORY, part)
            for view, part in zip(views, state.chunk(self.states, dim=-1), strict=True)
        ]

    def sights(self, td: TensorDictBase) -> list[TensorDictBase]:
        """What the head sees, but for what it remembers; not to be written to."""
        raise NotImplementedError

    def mirrored(self, answer: Tensor) -> Tensor:
        """S f of an answer f, ``(..., N, outputs)``."""
        return answer * constant(self.signs, answer.device, torch.float32)

    def answers(self, td: TensorDictBase) -> list[Tensor]:
        """The head's, ``(..., N, outputs)`` for each view; what it remembers of one step is written to ``td``."""
        views = self.views(td)
        answers = [self.head(view) for view in views]
        states = [view.get(entries.NEXT_MEMORY, None) for view in views]
        if states[0] is not None:  # of a sequence of steps there is none
            td.set(entries.NEXT_MEMORY, torch.cat(states, dim=-1))
        return answers


class Averaged(MirroredHead):
    """``(f(o) + S f(M o)) / 2``. With a memory there are two hidden states, of what is there and of its image."""

    states = 2

    def forward(self, td: TensorDictBase) -> Tensor:
        """``(..., N, outputs)``."""
        here, there = self.answers(td)
        return 0.5 * (here + self.mirrored(there))

    def sights(self, td: TensorDictBase) -> list[TensorDictBase]:
        """What is there, and its image."""
        return [td, graph.mirrored(td, self.privileged_image)]


class Canonical(MirroredHead):
    """``f(o)`` where the target is on the left, ``S f(M o)`` where it is on the right."""

    def forward(self, td: TensorDictBase) -> Tensor:
        """``(..., N, outputs)``."""
        (answer,) = self.answers(td)
        return torch.where(self._turned(td).unsqueeze(-2), self.mirrored(answer), answer)

    def sights(self, td: TensorDictBase) -> list[TensorDictBase]:
        """What is there, or its image where the target is on the right."""
        return [graph.mirrored(td, self.privileged_image, where=self._turned(td))]

    def _turned(self, td: TensorDictBase) -> Tensor:
        """Where the target is on the right, ``(..., 1)``."""
        return td.get(entries.TARGET)[..., 1:2] < 0.0


def seen(policy: nn.Module, td: TensorDictBase) -> TensorDictBase:
    """What a policy's network is asked about in these frames: the frames themselves, or of some a mirror image.

    An average asks about every frame and its image; the frames are given.
    """
    head = next((module for module in policy.modules() if isinstance(module, MirroredHead)), None)
    return td if head is None else head.sights(td)[0]


WAYS: dict[str, type[MirroredHead]] = {AVERAGE: Averaged, CANONICAL: Canonical}
