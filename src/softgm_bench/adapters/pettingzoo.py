"""The arm as a PettingZoo environment: one agent per section, one environment."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeAlias

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded

from softgm_bench.adapters.film import RENDER_MODES, Film, check_render_mode
from softgm_bench.adapters.gymnasium_vector import (
    Seeding,
    build_arm,
    checked_action,
    ends,
    info_columns,
    info_row,
    joint_size,
    joint_view,
    put_action,
    real_space,
)
from softgm_bench.envs import entries
from softgm_bench.envs.soft_arm import SoftArmEnv
from softgm_bench.envs.views import flat_features, flat_observation

Array = NDArray[Any]
Observation = Array | dict[str, Array]


def parallel_env(
    task: str = "wall",
    seed: int | None = None,
    render_mode: str | None = None,
    horizon: int | None = None,
    overrides: Sequence[str] = (),
    observation: str = "flat",
) -> "SoftArmParallelEnv":
    """Build one arm with settings from ``conf/``.

    Args:
        task: ``basic``, ``structured``, ``wall``, ``wall_narrow``, ``wall_fixed``, ``wall_touch``, ``wall_search``,
            ``wall_decoy``, ``wall_sense``, ``wall_sliding`` or ``swinging_posts``.
        seed: of the scenes until ``reset(seed=...)`` gives another; None: from the operating system.
        render_mode: ``rgb_array`` or None.
        horizon: control steps until truncation, the task's by default.
        overrides: settings as on the command line, e.g. ``["task.n_agents=4", "perturbation=noise"]``.
        observation: ``flat``, one vector for an MLP, or ``dict``, the same content by name.

    Raises:
        ValueError, UserError: with one line that says what is wrong and what would be right.
    """
    if observation not in _VIEWS:
        raise ValueError(f"observation is {observation!r}: choose one of {', '.join(_VIEWS)}")
    check_render_mode(render_mode)
    return SoftArmParallelEnv(build_arm(task, 1, seed, horizon, overrides), observation, render_mode, seed)


class SoftArmParallelEnv(ParallelEnv[str, Observation, Array]):
    """A ``SoftArmEnv`` of one environment, whose steps it repeats bit by bit.

    Agents are ``section_0``, nearest to the base, to ``section_<N - 1>``. All receive the team's reward, end together,
    and are gone then until ``reset``. ``step`` needs an action of every agent; what lies outside of [-1, 1] is clipped.
    """

    def __init__(self, arm: SoftArmEnv, observation: str, render_mode: str | None, seed: int | None = None) -> None:
        """Wrap an environment with ``num_envs`` 1 that was built with ``seed``; use ``parallel_env``."""
        self.arm, self._seeding = arm, Seeding(seed)
        self.render_mode = render_mode
        self.metadata = {
            "name": "soft_arm_v0",
            "render_modes": list(RENDER_MODES),
            "render_fps": 1.0 / arm.backend.parameters.control_dt,
            "is_parallelizable": True,
        }
        self.possible_agents = [f"section_{index}" for index in range(arm.sizes.n_agents)]
        self.agents: list[str] = []
        space, self._observe = _VIEWS[observation]
        self.observation_spaces = {agent: space(arm) for agent in self.possible_agents}
        own = (arm.sizes.action,)
        self.action_spaces = {agent: spaces.Box(-1.0, 1.0, own, np.float32) for agent in self.possible_agents}
        self.state_space = real_space(joint_size(arm))
        self._film = None if render_mode is None else Film(arm)
        self._td: TensorDictBase | None = None
        self.np_random = np.random.default_rng(seed)  # for wrappers, such as SuperSuit's; nothing here draws from it

    def observation_space(self, agent: str) -> spaces.Space:
        """Give one agent's space; the same object each time, so that it can be seeded."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> spaces.Box:
        """(normal, binormal) in [-1, 1]; the same object each time."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Observation], dict[str, dict[str, Any]]]:
        """Begin an episode; with a seed, the same one each time. There are no options."""
        drawn_from = self._seeding(seed)
        if drawn_from is not None:
            self.np_random = np.random.default_rng(drawn_from)
        self._td = self.arm.reset(seed=drawn_from)
        self.agents = list(self.possible_agents)
        if self._film is not None:
            self._film.begin(self._td)
        return self._observations(), self._infos()

    def step(
        self, actions: Mapping[str, Array]
    ) -> tuple[dict[str, Observation], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, Any]]]:
        """One control step.

        Raises:
            ValueError: there is no episode under way, or the actions are not one finite ``(2,)`` for each agent.
        """
        if self._td is not None and not self.agents and not actions:
            return {}, {}, {}, {}, {}  # wrappers that keep dead agents (SuperSuit's black death) do not stop here
        if self._td is None or not self.agents:
            raise ValueError("step outside of an episode: call reset()")
        if set(actions) != set(self.agents):
            raise ValueError(f"actions are of {', '.join(map(str, actions))}: they must be of {', '.join(self.agents)}")
        joint = np.stack([checked_action(actions[agent], (self.arm.sizes.action,)) for agent in self.agents])
        self._td = td = self.arm.step(put_action(self._td, joint, self.arm))["next"]
        if self._film is not None:
            self._film.step(td)
        reward, terminated, truncated = ends(td)
        if terminated or truncated:
            self.agents = []
        every = self.possible_agents
        return (
            self._observations(),
            dict.fromkeys(every, reward),
            dict.fromkeys(every, terminated),
            dict.fromkeys(every, truncated),
            self._infos(),
        )

    def state(self) -> Array:
        """For centralised critics: the entries of ``entries.OBSERVATION`` one after another, float32."""
        return joint_view(self._frame())[0]

    def render(self) -> Array | None:
        """The arm as it stands, ``(height, width, 3)`` uint8."""
        if self.render_mode is None:
            gymnasium.logger.warn("render() without a render_mode: build the environment with render_mode='rgb_array'")
            return None
        assert self._film is not None
        self._frame()
        return self._film.picture()

    def close(self) -> None:
        """Nothing is held that would have to be released."""
        self.arm.close()

    def _frame(self) -> TensorDictBase:
        if self._td is None:
            raise ValueError("there is nothing to see before the first reset: call reset()")
        return self._td

    def _observations(self) -> dict[str, Observation]:
        return dict(zip(self.possible_agents, self._observe(self._frame()), strict=True))

    def _infos(self) -> dict[str, dict[str, Any]]:
        columns = info_columns(self._frame())
        return {agent: info_row(columns, 0) for agent in self.possible_agents}


def _flat_space(arm: SoftArmEnv) -> spaces.Box:
    return real_space(flat_features(arm.sizes.n_slots))


def _flat_rows(td: TensorDictBase) -> list[Observation]:
    return list(flat_observation(td)[0].cpu().numpy())


def _dict_space(arm: SoftArmEnv) -> spaces.Dict:
    """Spaces of ``_dict_rows``; those of slots are absent where a task has none."""
    acted = arm.observation_spec[entries.PREVIOUS_ACTION]
    bounded = isinstance(acted, Bounded)  # noise goes beyond
    own = (arm.sizes.action,)
    found: dict[str, spaces.Space] = {
        "position": real_space(3),
        "velocity": real_space(3),
        "previous_action": spaces.Box(-1.0, 1.0, own, np.float32) if bounded else real_space(*own),
        "tip": real_space(3),
        "target": real_space(3),
    }
    if arm.sizes.n_slots:
        found["slot_descriptor"] = real_space(*arm.observation_spec[entries.SLOT_DESCRIPTOR].shape[1:])
        found["slot_active"] = spaces.MultiBinary(arm.sizes.n_slots)
        found["edge"] = spaces.MultiBinary(arm.sizes.n_slots)
    return spaces.Dict(found)


def _dict_rows(td: TensorDictBase) -> list[Observation]:
    """Give each agent's row of its own entries, and those that all share; arrays that nothing else refers to."""
    own = {
        "position": entries.AGENT_POSITION,
        "velocity": entries.AGENT_VELOCITY,
        "previous_action": entries.PREVIOUS_ACTION,
    }
    shared: dict[str, Any] = {"tip": entries.TIP, "target": entries.TARGET}
    if td[entries.SLOT_ACTIVE].shape[-1]:
        own |= {"edge": entries.EDGE}
        shared |= {"slot_descriptor": entries.SLOT_DESCRIPTOR, "slot_active": entries.SLOT_ACTIVE}

    def array(value: Tensor) -> Array:
        return np.array(value.cpu().numpy(), dtype=np.int8 if value.dtype == torch.bool else np.float32)

    return [
        {name: array(td[key][0, agent]) for name, key in own.items()}
        | {name: array(td[key][0]) for name, key in shared.items()}
        for agent in range(td[entries.EDGE].shape[-2])
    ]


_View: TypeAlias = tuple[Callable[[SoftArmEnv], spaces.Space], Callable[[TensorDictBase], list[Observation]]]
_VIEWS: dict[str, _View] = {"flat": (_flat_space, _flat_rows), "dict": (_dict_space, _dict_rows)}
