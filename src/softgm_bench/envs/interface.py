"""The interface of environments: all that the rest of the package knows of one, whichever it is.

A task's configuration says which environment plays it (``kind_of``). Networks and memories are built from ``Sizes``,
so that an actor can be built without an environment.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

GRAPH, VECTOR = "graph", "vector"  # layouts of an observation


@dataclass(frozen=True)
class Sizes:
    """The numbers by which networks and memories are built.

    Attributes:
        n_agents: N.
        action: numbers in one agent's action, A.
        n_slots: obstacle slots of a graph observation, M; 0 without obstacles.
        n_features: length of an agent's observation where it is a plain vector, F; 0 for a graph observation.
        n_privileged: numbers that the task knows of a scene beyond the observation, P.
        n_points: points among them, m; the first ``3 n_points`` numbers are their coordinates.
        privileged_image: what a mirror in the plane y = 0 makes of them: for each number of the image the index of the
            number that is there, and the sign that it gets. Empty where that is not known.
    """

    n_agents: int
    action: int
    n_slots: int = 0
    n_features: int = 0
    n_privileged: int = 0
    n_points: int = 0
    privileged_image: tuple[tuple[int, float], ...] = ()

    @property
    def layout(self) -> str:
        """The layout of observations: ``GRAPH`` (``entries.OBSERVATION``) or ``VECTOR`` (a vector an agent)."""
        return VECTOR if self.n_features else GRAPH


@runtime_checkable
class Environment(Protocol):
    """A batched TorchRL environment whose state can be kept and returned to.

    Attributes:
        sizes: of its actions and observations.
        horizon: control steps until an episode is truncated.
        device: of its entries.
        batch_size: ``(num_envs,)``.
    """

    sizes: Sizes
    horizon: int
    device: torch.device
    batch_size: torch.Size

    def generator_state(self) -> Tensor:
        """Give the state of the generators that episodes are drawn from."""

    def set_generator_state(self, state: Tensor) -> None:
        """Continue drawing from what ``generator_state`` returned."""

    def simulation_state(self) -> TensorDict:
        """Give a copy of all episodes as they stand, ``(num_envs,)``."""

    def load_simulation_state(self, state: TensorDictBase) -> None:
        """Continue from what ``simulation_state`` returned for as many environments of the same task."""


class Settings(Protocol):
    """The settings that an environment is built from; a run's ``Config`` has them.

    Attributes:
        task: a configuration that ``kind_of`` knows.
        rod: the arm's ``RodParameters``.
        perturbation: a ``PerturbationConfig``.
        randomise: a ``RandomiseConfig``.
        device: ``cpu``, ``cuda`` or ``cuda:<index>``.
        backend: name of the rod's implementation; None: the device's fused kernel.
        dtype: ``float64`` or ``float32``, of the rod's state.
        oracle: actors are told what they would have to discover.
    """

    task: Any
    rod: Any
    perturbation: Any
    randomise: Any
    device: str
    backend: str | None
    dtype: str

    @property
    def oracle(self) -> bool:
        """Tell whether actors read the privileged entry."""


@dataclass(frozen=True)
class Kind:
    """The way in which the tasks of one kind are played.

    Attributes:
        base: class of their configurations.
        configs: gives the configuration dataclass of every task of this kind by name.
        build: makes an environment of ``(settings, num_envs, seed, horizon, training)``; ``horizon`` None is the task's
            own, ``training`` staggers clocks and follows the task's curriculum.
        sizes: gives those of a task's configuration.
        check: raises ValueError, one line, for settings that such a task cannot have.
        has_arm: whether there is an arm whose states can be recorded and drawn.
    """

    base: type
    configs: Callable[[], Mapping[str, type]]
    build: Callable[[Any, int, int, int | None, bool], Any]
    sizes: Callable[[Any], Sizes]
    check: Callable[[Any], None]
    has_arm: bool


_kinds: list[Kind] = []


def register_kind(kind: Kind) -> Kind:
    """Let tasks whose configurations are of type ``kind.base`` be played as ``kind`` says; returns it."""
    _kinds.append(kind)
    return kind


def task_configs() -> dict[str, type]:
    """Give the configuration dataclass of every task by name."""
    arms_first = sorted(_kinds, key=lambda kind: not kind.has_arm)
    return {name: config for kind in arms_first for name, config in kind.configs().items()}


def kind_of(config: Any) -> Kind:
    """Give how the task of a configuration is played.

    Raises:
        ValueError: if no environment is registered for it.
    """
    for kind in _kinds:
        if isinstance(config, kind.base):
            return kind
    raise ValueError(f"{type(config).__name__} is no task's configuration; tasks: {', '.join(task_configs())}")
