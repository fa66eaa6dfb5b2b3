"""An episode as it goes on, for those who look at it through an adapter."""

from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tensordict import TensorDictBase
from torch import Tensor

from softgm_bench.envs import entries
from softgm_bench.envs.soft_arm import SoftArmEnv
from softgm_bench.rod.randomise import FACTORS

Array = NDArray[Any]
RENDER_MODES = ("rgb_array",)
WIDTH, HEIGHT = 640, 480  # of pictures, pixels
VIEW_DISTANCE = 5.0  # of the camera, in lengths of the arm: in the picture unless it hangs straight down


def check_render_mode(render_mode: str | None) -> None:
    """Refuse what there is not.

    Raises:
        ValueError: with one line that says what there is.
    """
    if render_mode is not None and render_mode not in RENDER_MODES:
        raise ValueError(f"render_mode is {render_mode!r}: choose {', '.join(RENDER_MODES)} or None")


class Film:
    """An episode until now, for the renderer: it draws the tip's path and when obstacles were discovered."""

    def __init__(self, arm: SoftArmEnv) -> None:
        """Nothing has happened yet."""
        self._arm = arm
        self._states: dict[str, list[Array]] = {}
        self._steps: dict[str, list[Array]] = {}
        self._camera: Any = None  # of the episode: what stands still shall do so in the pictures
        self._td: TensorDictBase | None = None

    def begin(self, td: TensorDictBase) -> None:
        """Forget everything and note the state after a reset."""
        self._states, self._camera, self._td = {}, None, td
        self._steps = {"action": [], "tip_force": [], "reward": []}
        self._note_state(td)

    def step(self, td: TensorDictBase) -> None:
        """Note what a step led to."""
        self._steps["action"].append(_first_row(self._arm.applied_action))
        self._steps["tip_force"].append(_first_row(self._arm.tip_force).astype(np.float64))
        self._steps["reward"].append(_first_row(td[entries.REWARD])[0])
        self._td = td
        self._note_state(td)

    def picture(self) -> Array:
        """The last state, ``(height, width, 3)`` uint8."""
        try:
            from softgm_bench.render.still import PictureSettings, Studio
        except ImportError as error:
            raise ImportError("rendering is not installed: pip install '.[render]'") from error
        trajectory = self._trajectory()
        distance = VIEW_DISTANCE * self._arm.backend.parameters.base_length
        studio = Studio(trajectory, PictureSettings(WIDTH, HEIGHT, distance=distance))
        if self._camera is None:
            self._camera = studio.camera
        studio.camera = self._camera
        return studio.picture(trajectory.steps)

    def _note_state(self, td: TensorDictBase) -> None:
        rod = self._arm.rod
        now = {name: getattr(rod, name) for name in ("position", "director", "velocity", "omega")}
        now |= {"contact": self._arm.contacts(), "starts": self._arm.scene.cylinders.start}
        now |= {"slots/active": td[entries.SLOT_ACTIVE], "slots/descriptor": td[entries.SLOT_DESCRIPTOR]}
        for name, values in now.items():
            self._states.setdefault(name, []).append(_first_row(values))

    def _trajectory(self) -> Any:
        from softgm_bench.episodes.trajectory import CYLINDER_FIELDS, PATH, Trajectory

        assert self._td is not None
        arm, cylinders = self._arm, self._arm.scene.cylinders
        exists = _first_row(cylinders.mask)
        states = {name: np.stack(values) for name, values in self._states.items()}
        path = states.pop("starts")[:, exists].astype(float)
        bodies = {name: _first_row(getattr(cylinders, name))[exists].astype(float) for name in CYLINDER_FIELDS}
        body = dict(zip(FACTORS, arm.body[0].tolist(), strict=False))  # empty if it is the nominal one
        steps = len(self._steps["reward"])
        shapes = {"action": (steps, arm.sizes.n_agents, arm.sizes.action), "tip_force": (steps, 3), "reward": (steps,)}
        return Trajectory(
            observation={name: states.pop(name) for name in tuple(states) if "/" in name},
            **states,
            **{name: np.array(values).reshape(shapes[name]) for name, values in self._steps.items()},
            target=_first_row(arm.scene.target).astype(np.float64),
            reward_terms={},
            cylinders=bodies | ({"start": path[0], PATH: path} if arm.task.moves else {}),
            attention={},
            success=bool(self._td[entries.SUCCESS]),
            diverged=bool(self._td[entries.DIVERGED]),
            config={"rod": asdict(arm.backend.parameters), "task": asdict(arm.task.config)},
            info={"body": body} if body else {},
        )


def _first_row(values: Tensor) -> Array:
    """Of the only environment, an array of its own."""
    return values[0].cpu().numpy().copy()
