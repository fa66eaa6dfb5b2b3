"""The arm for Gymnasium: one agent that chooses every section's action, alone or batched in one simulation."""

import math
import operator
import re
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from hydra.errors import HydraException
from numpy.typing import NDArray
from omegaconf.errors import OmegaConfBaseException
from tensordict import TensorDictBase

from softgm_bench import plugins
from softgm_bench.adapters.film import RENDER_MODES, Film, check_render_mode
from softgm_bench.assembly import build_env, configure
from softgm_bench.envs import entries
from softgm_bench.envs.soft_arm import SoftArmEnv
from softgm_bench.envs.tasks import TASKS
from softgm_bench.errors import UserError

Array = NDArray[Any]
# what an environment alone depends on
SETTINGS = ("task", "rod", "perturbation", "randomise", "device", "backend", "dtype")


def build_arm(
    task: str, num_envs: int, seed: int | None = None, horizon: int | None = None, overrides: Sequence[str] = ()
) -> SoftArmEnv:
    """The environment behind the adapters, with settings from ``conf/``.

    Args:
        task: a name in ``TASKS``.
        num_envs: environments simulated at once.
        seed: of the scenes; None: the adapter gives one from the operating system in its first reset (``Seeding``).
        horizon: control steps until truncation, the task's by default.
        overrides: settings as on the command line, of ``SETTINGS`` only.

    Raises:
        ValueError, UserError: with one line that says what is wrong and what would be right.
    """
    plugins.load()
    if task not in TASKS:
        raise ValueError(f"task is {task!r}: choose one of {', '.join(TASKS)}")
    for name, value in (("num_envs", num_envs), ("horizon", horizon)):
        if value is not None and value < 1:
            raise ValueError(f"{name} is {value}: it must be at least 1")
    if isinstance(overrides, str):
        raise ValueError(f"overrides is {overrides!r}: it must be a list of settings")
    for override in overrides:
        key = re.split(r"[=@]", override, maxsplit=1)[0].lstrip("+~")
        if re.split(r"[./]", key, maxsplit=1)[0] not in SETTINGS or key == "task":
            raise ValueError(
                f"overrides holds {override!r}: settings of {', '.join(SETTINGS)}; the task is an argument"
            )
    try:
        config = configure([f"task={task}", *overrides])
    except (HydraException, OmegaConfBaseException) as error:
        raise UserError(_one_line(error)) from error
    return build_env(config, num_envs, 0 if seed is None else checked_seed(seed), horizon)


class Seeding:
    """Which seed a reset begins with, so that one seed means one set of scenes wherever it is given.

    An environment that nobody has seeded draws from the operating system in its first reset and not before: copies of
    one, as vector wrappers make them, then play scenes of their own.
    """

    def __init__(self, seed: int | None) -> None:
        """Note the seed that the environment was built with."""
        self._open = seed is None

    def __call__(self, seed: int | None) -> int | None:
        """Give the seed to set now, for what ``reset`` was given; None: go on drawing as before."""
        if seed is None and self._open:
            (word,) = np.random.SeedSequence().generate_state(1, np.uint64)
            seed = int(word >> np.uint64(1))
        self._open = False
        return None if seed is None else checked_seed(seed)


def checked_seed(seed: int) -> int:
    """The seed, if it is one.

    Raises:
        ValueError: otherwise.
    """
    number = operator.index(seed)
    if not 0 <= number < 2**63:
        raise ValueError(f"seed is {number}: it must be a whole number from 0 to 2**63 - 1")
    return number


def joint_view(td: TensorDictBase) -> Array:
    """``entries.OBSERVATION`` one after another, row by row, ``(num_envs, joint_size(env))`` float32."""
    parts = [td[key].reshape(td.batch_size[0], -1).to(torch.float32) for key in entries.OBSERVATION]
    return torch.cat(parts, dim=-1).cpu().numpy()


def joint_size(env: SoftArmEnv) -> int:
    """Length of the joint observation."""
    return sum(math.prod(env.observation_spec[key].shape[1:]) for key in entries.OBSERVATION)


def real_space(*shape: int) -> spaces.Box:
    """Any float32 numbers."""
    return spaces.Box(-np.inf, np.inf, shape, np.float32)


def action_size(env: SoftArmEnv) -> int:
    """Length of the joint action."""
    return math.prod(env.action_spec[entries.ACTION].shape[1:])


def checked_action(action: Any, shape: tuple[int, ...]) -> Array:
    """An action as float32.

    Raises:
        ValueError: another shape, or something that is not finite.
    """
    array = np.asarray(action, dtype=np.float32)
    if array.shape != shape:
        raise ValueError(f"action has shape {array.shape}: it must be {shape}")
    if not np.isfinite(array).all():
        raise ValueError("action holds a value that is not finite: it must lie in [-1, 1]")
    return array


def put_action(td: TensorDictBase, action: Array, env: SoftArmEnv) -> TensorDictBase:
    """Write a joint action of all environments, in any shape, to what the environment's step reads."""
    joint = torch.tensor(action, device=env.device)
    return td.set(entries.ACTION, joint.reshape(env.action_spec[entries.ACTION].shape))


def ends(td: TensorDictBase) -> tuple[float, bool, bool]:
    """Give reward, terminated and truncated of one environment's step."""
    return td[entries.REWARD].item(), td[entries.TERMINATED].item(), td[entries.TRUNCATED].item()


def info_columns(td: TensorDictBase) -> dict[str, Array]:
    """Everything under ``info`` by name, reward terms as ``reward_<name>``: ``(num_envs,)`` bool or float64 each."""
    named = {key[1]: key for key in entries.INFO}
    named |= {f"reward_{name}": (entries.REWARD_TERMS, name) for name in entries.REWARD_TERM_NAMES}
    columns = {name: td[key].squeeze(-1).cpu().numpy() for name, key in named.items()}
    return {name: column if column.dtype == bool else column.astype(np.float64) for name, column in columns.items()}


def info_row(columns: Mapping[str, Array], row: int) -> dict[str, Any]:
    """One environment's part of ``info_columns`` in Python's bool and float."""
    return {name: column[row].item() for name, column in columns.items()}


class SoftArmGymnasiumEnv(gymnasium.Env[Array, Array]):
    """One arm, all of its sections one agent.

    Observation: ``joint_view``. Action: (normal, binormal) of section 0, of section 1, ..., in [-1, 1]. An episode that
    is over does not move until ``reset``.
    """

    metadata: dict[str, Any] = {"render_modes": list(RENDER_MODES)}  # noqa: RUF012

    def __init__(
        self,
        task: str = "wall",
        seed: int | None = None,
        horizon: int | None = None,
        overrides: Sequence[str] = (),
        render_mode: str | None = None,
    ) -> None:
        """Build the environment; arguments as of ``build_arm``; ``render_mode``: ``rgb_array`` or None."""
        check_render_mode(render_mode)
        self._arm, self._seeding = build_arm(task, 1, seed, horizon, overrides), Seeding(seed)
        self.observation_space = real_space(joint_size(self._arm))
        self.action_space = spaces.Box(-1.0, 1.0, (action_size(self._arm),), np.float32)
        self.render_mode = render_mode
        self.metadata = {**self.metadata, "render_fps": 1.0 / self._arm.backend.parameters.control_dt}
        self._film = None if render_mode is None else Film(self._arm)
        self._td: TensorDictBase | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Array, dict[str, Any]]:
        """Begin an episode; with a seed, the same one each time."""
        drawn_from = self._seeding(seed)
        super().reset(seed=seed)
        self._td = self._arm.reset(seed=drawn_from)
        if self._film is not None:
            self._film.begin(self._td)
        return joint_view(self._td)[0], info_row(info_columns(self._td), 0)

    def step(self, action: Array) -> tuple[Array, float, bool, bool, dict[str, Any]]:
        """One control step; the reward is the team's."""
        if self._td is None:
            raise ValueError("step before the first reset: call reset()")
        checked = checked_action(action, (action_size(self._arm),))
        self._td = td = self._arm.step(put_action(self._td, checked, self._arm))["next"]
        if self._film is not None:
            self._film.step(td)
        reward, terminated, truncated = ends(td)
        return joint_view(td)[0], reward, terminated, truncated, info_row(info_columns(td), 0)

    def render(self) -> Array | None:
        """Draw the arm as it stands, ``(height, width, 3)`` uint8; None without a ``render_mode``."""
        if self._film is None or self._td is None:
            return None
        return self._film.picture()


class SoftArmVectorEnv(VectorEnv[Array, Array, Array]):
    """``num_envs`` arms in one simulation, each of its own one agent as in ``SoftArmGymnasiumEnv``.

    An episode that ends begins again in the same step (``AutoresetMode.SAME_STEP``): the observation is the new
    episode's first, ``infos["final_obs"]`` and ``infos["final_info"]`` hold the last of the old one. With
    ``AutoresetMode.NEXT_STEP``, which Gymnasium's normalising wrappers ask for, it begins in the step after, whose
    action is not heeded and whose reward is 0.
    """

    metadata: dict[str, Any] = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        task: str = "wall",
        num_envs: int = 1,
        seed: int | None = None,
        horizon: int | None = None,
        overrides: Sequence[str] = (),
        render_mode: str | None = None,
        autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP,
    ) -> None:
        """Build the environments; arguments as of ``build_arm``, and when an episode that has ended begins again."""
        _refuse_rendering(render_mode)
        modes = (AutoresetMode.SAME_STEP, AutoresetMode.NEXT_STEP)
        if autoreset_mode not in modes:
            raise ValueError(f"autoreset_mode is {autoreset_mode!r}: choose {' or '.join(map(str, modes))}")
        self.metadata = {**self.metadata, "autoreset_mode": autoreset_mode}
        self._ended: NDArray[np.bool_] | None = None  # episodes that begin again in the next step; None: none waits
        self._arm, self._seeding = build_arm(task, num_envs, seed, horizon, overrides), Seeding(seed)
        self.num_envs = num_envs
        self.single_observation_space = real_space(joint_size(self._arm))
        self.single_action_space = spaces.Box(-1.0, 1.0, (action_size(self._arm),), np.float32)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._td: TensorDictBase | None = None

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Array, dict[str, Any]]:
        """Begin an episode in every environment.

        Args:
            seed: of all environments together; or one for each, whose first scene is then that of an environment alone
                with this seed.
            options: nothing.
        """
        if options is not None and "reset_mask" in options:
            raise ValueError("options holds reset_mask: episodes begin again by themselves, in the step that ends them")
        if seed is None or isinstance(seed, int | np.integer):
            drawn_from = self._seeding(seed)
            super().reset(seed=seed)
            self._td = self._arm.reset(seed=drawn_from)
        else:
            self._td = self._reset_each(list(seed))
        everywhere, self._ended = np.ones(self.num_envs, dtype=bool), None
        return joint_view(self._td), _masked(info_columns(self._td), everywhere)

    def _reset_each(self, seeds: Sequence[int | None]) -> TensorDictBase:
        """Begin every environment's episode with its own seed; what is drawn later belongs to all seeds together."""
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed has {len(seeds)} numbers: it must be one, or one for each of {self.num_envs}")
        own = [seed for seed in (Seeding(seed)(seed) for seed in seeds) if seed is not None]
        (together,) = np.random.SeedSequence(own).generate_state(1)
        super().reset(seed=int(together))
        td = self._arm.reset()
        for row, seed in enumerate(own):
            mask = torch.zeros_like(td[entries.DONE])
            mask[row] = True
            td = self._arm.reset(td.clone().set("_reset", mask), seed=seed)
        self._seeding(int(together))
        self._arm.set_seed(int(together))
        return td

    def step(self, actions: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One control step of every environment."""
        if self._td is None:
            raise ValueError("step before the first reset: call reset()")
        checked = checked_action(actions, (self.num_envs, action_size(self._arm)))
        if self.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP:
            return self._step_and_wait(checked)
        frame, self._td = self._arm.step_and_maybe_reset(put_action(self._td, checked, self._arm))
        last = frame["next"]
        reward, terminated, truncated = (
            last[key].squeeze(-1).cpu().numpy() for key in (entries.REWARD, entries.TERMINATED, entries.TRUNCATED)
        )
        done = terminated | truncated
        infos = _masked(info_columns(self._td), np.ones_like(done))
        if done.any():
            observation = joint_view(last)
            final = np.full(self.num_envs, None, dtype=object)
            for row in done.nonzero()[0]:
                final[row] = observation[row]
            infos |= {"final_obs": final, "_final_obs": done.copy()}
            infos |= {"final_info": _masked(info_columns(last), done), "_final_info": done.copy()}
        return joint_view(self._td), reward.astype(np.float64), terminated.copy(), truncated.copy(), infos

    def _step_and_wait(self, action: Array) -> tuple[Array, Array, Array, Array, dict[str, Any]]:
        """One step in which what had ended before begins again, and what ends now stays as it is."""
        assert self._td is not None
        td = self._arm.step(put_action(self._td, action, self._arm))["next"]
        reward = td[entries.REWARD].squeeze(-1).cpu().numpy().astype(np.float64)
        if self._ended is not None and self._ended.any():
            mask = torch.as_tensor(self._ended, device=self._arm.device).unsqueeze(-1)
            td = self._arm.reset(td.clone().set("_reset", mask))
            reward[self._ended] = 0.0
        terminated, truncated = (td[key].squeeze(-1).cpu().numpy() for key in (entries.TERMINATED, entries.TRUNCATED))
        self._td, self._ended = td, terminated | truncated
        infos = _masked(info_columns(td), np.ones_like(self._ended))
        return joint_view(td), reward, terminated.copy(), truncated.copy(), infos


def register() -> None:
    """Make ``gymnasium.make`` and ``gymnasium.make_vec`` know ``SoftArm-<task>-v0`` for every task."""
    plugins.load()
    for task in TASKS:
        gymnasium.register(
            f"SoftArm-{task}-v0",
            entry_point=f"{__name__}:SoftArmGymnasiumEnv",
            vector_entry_point=f"{__name__}:SoftArmVectorEnv",
            kwargs={"task": task},
        )


def _masked(columns: Mapping[str, Array], mask: Array) -> dict[str, Any]:
    """Gymnasium's form of infos: zero outside of the mask, which stands beside each under ``_<name>``."""
    infos: dict[str, Any] = {}
    for name, column in columns.items():
        infos[name] = np.where(mask, column, np.zeros_like(column))
        infos[f"_{name}"] = mask.copy()
    return infos


def _refuse_rendering(render_mode: str | None) -> None:
    if render_mode is not None:
        raise ValueError(
            f"render_mode is {render_mode!r}: softgm_bench.adapters.pettingzoo renders, this adapter does not"
        )


def _one_line(error: Exception) -> str:
    message = str(error).splitlines()[0]
    key = getattr(error, "full_key", None)
    return f"{key}: {message}" if key else message
