"""One episode of one arm as arrays: recorded from a policy, saved to and loaded from one ``.npz`` file."""

import io
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from softgm_bench.errors import UserError
from softgm_bench.rod.actuation import control_points
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.storage.files import read_where_asked, write_where_asked

FORMAT = 1
CYLINDER_FIELDS = ("start", "axis", "length", "radius")
PATH = "path"  # of cylinders that move
# Members of a file, besides the groups: those of the rod have its type, float64 or float32.
ROD = ("position", "director", "velocity", "omega")
ARRAYS = (*ROD, "contact", "action", "tip_force", "reward", "target")
GROUPS = ("observation", "reward_terms", "cylinders", "attention")
PLAIN = ("success", "diverged", "config", "info")

Array = NDArray[Any]


@dataclass(frozen=True)
class Trajectory:
    """An episode of T control steps: T + 1 states, from the reset to the end, and T actions between them.

    Attributes:
        position: nodes, m, ``(T + 1, 3, n_nodes)``, of the rod's type as are the next three.
        director: rows d1, d2, d3 of every element's material frame, ``(T + 1, 3, 3, n_elements)``.
        velocity: of nodes, m/s, ``(T + 1, 3, n_nodes)``.
        omega: angular velocity in the material frame, rad/s, ``(T + 1, 3, n_elements)``.
        contact: which nodes touch a cylinder, ``(T + 1, n_nodes)`` bool.
        action: as the arm applied them, in [-1, 1], ``(T, N, 2)`` float32.
        tip_force: external force on the tip, N, ``(T, 3)`` float64; zeros without a disturbance.
        reward: the team's, ``(T,)`` float32.
        target: m, ``(3,)`` float64.
        observation: what the policy was shown, by key joined with "/": ``(T + 1, ...)``.
        reward_terms: by name, ``(T,)`` float32.
        cylinders: ``start`` (C, 3), ``axis`` (C, 3), ``length`` (C,), ``radius`` (C,) of the C that exist, float64, m;
            where they move also ``path`` (T + 1, C, 3), their starts at each state, of which ``start`` is the first.
        attention: empty, or ``stage1`` ``(T, L, H, N, N + M)`` and ``stage2`` ``(T, L, H, N, N)`` float32.
        success: whether the tip reached the target.
        diverged: whether the simulation broke in the last step; its state is then that before the step.
        config: of the simulation and the policy, plain values.
        info: label, task, frames, seed, episode, episodes, deterministic, backend, versions; where bodies are drawn
            also ``body``, the episode's factors on the nominal arm's parameters by name.
    """

    position: Array
    director: Array
    velocity: Array
    omega: Array
    contact: Array
    action: Array
    tip_force: Array
    reward: Array
    target: Array
    observation: dict[str, Array]
    reward_terms: dict[str, Array]
    cylinders: dict[str, Array]
    attention: dict[str, Array]
    success: bool
    diverged: bool
    config: dict[str, Any] = field(repr=False)
    info: dict[str, Any] = field(repr=False)

    def __post_init__(self) -> None:
        """Refuse arrays that don't belong together.

        Raises:
            ValueError: naming the first one and the shape that it should have.
        """
        steps, n_agents, n = self.steps, self.n_agents, self.position.shape[-1] - 1
        shapes = {
            "position": (steps + 1, 3, n + 1),
            "director": (steps + 1, 3, 3, n),
            "velocity": (steps + 1, 3, n + 1),
            "omega": (steps + 1, 3, n),
            "contact": (steps + 1, n + 1),
            "action": (steps, n_agents, self.action.shape[-1]),
            "tip_force": (steps, 3),
            "reward": (steps,),
            "target": (3,),
        }
        for name, shape in shapes.items():
            if getattr(self, name).shape != shape:
                raise ValueError(f"{name} has shape {getattr(self, name).shape}: it must be {shape}")
        leading = {"observation": steps + 1, "reward_terms": steps, "attention": steps}
        for group, size in leading.items():
            for name, values in getattr(self, group).items():
                if len(values) != size:
                    raise ValueError(f"{group}/{name} has {len(values)} entries: it must have {size}")
        count = len(self.cylinders["start"])
        for name, shape in zip(CYLINDER_FIELDS, ((count, 3), (count, 3), (count,), (count,)), strict=True):
            if self.cylinders[name].shape != shape:
                raise ValueError(f"cylinders/{name} has shape {self.cylinders[name].shape}: it must be {shape}")
        path = self.cylinders.get(PATH)
        if path is not None and path.shape != (steps + 1, count, 3):
            raise ValueError(f"cylinders/{PATH} has shape {path.shape}: it must be {(steps + 1, count, 3)}")

    @property
    def steps(self) -> int:
        """T, control steps."""
        return len(self.action)

    @property
    def n_agents(self) -> int:
        """N."""
        return self.action.shape[1]

    @cached_property
    def rod(self) -> RodParameters:
        """The nominal arm's physical parameters."""
        values = self.config["rod"]
        return RodParameters(**values | {"gravity": tuple(values["gravity"])})

    @property
    def body(self) -> dict[str, float]:
        """The factors that made this episode's arm of the nominal one, by name; empty if it is that."""
        return self.info.get("body", {})

    @cached_property
    def arm(self) -> RodParameters:
        """The physical parameters of the arm that this episode had."""
        return self.rod.times({name: factor for name, factor in self.body.items() if hasattr(self.rod, name)})

    @cached_property
    def agent_nodes(self) -> NDArray[np.int64]:
        """Index of each agent's node, ``(N,)``."""
        rod = self.rod
        return np.round(control_points(self.n_agents, rod.base_length) * (rod.n_elements / rod.base_length)).astype(int)

    def starts(self, step: float) -> NDArray[np.float64]:
        """Starts of the cylinders at a time in control steps, m, ``(C, 3)``: between two steps on a straight line."""
        path = self.cylinders.get(PATH)
        if path is None:
            return self.cylinders["start"]
        k = min(int(step), self.steps)
        part = step - k
        return path[k] if part == 0.0 else (1.0 - part) * path[k] + part * path[k + 1]

    def radius(self) -> NDArray[np.float64]:
        """Radius of every element, m, ``(T + 1, n_elements)``: an element keeps its volume when it is stretched."""
        length = np.linalg.norm(np.diff(self.position.astype(np.float64), axis=-1), axis=1)
        return np.sqrt(rod_constants(self.arm).volume / (np.pi * length))


def save(trajectory: Trajectory, path: Path) -> None:
    """Write a trajectory; the format is described in ``docs/trajectories.md``.

    Raises:
        UserError: the file's name does not end in ``.npz``, or it cannot be written.
    """
    if path.suffix != ".npz":
        raise UserError(f"{path}: a trajectory's file ends in .npz")
    arrays = {name: getattr(trajectory, name) for name in ARRAYS}
    for group in GROUPS:
        arrays |= {f"{group}/{name}": values for name, values in getattr(trajectory, group).items()}
    plain = {"format": FORMAT} | {name: getattr(trajectory, name) for name in PLAIN}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, metadata=np.array(json.dumps(plain)), **arrays)
    write_where_asked(path, buffer.getvalue())


def load(path: Path) -> Trajectory:
    """Read what ``save`` wrote, without running any code in it.

    Raises:
        UserError: the file is missing, damaged or no trajectory of this version.
    """
    content = read_where_asked(path)
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as members:
            arrays: dict[str, Any] = {name: members[name] for name in members.files}  # reading compares checksums
        plain = json.loads(str(arrays.pop("metadata")))
        if plain.pop("format") != FORMAT:
            raise UserError(f"{path}: a trajectory of another version of this program; record it again")
        groups: dict[str, Any] = {group: {} for group in GROUPS}
        for name in [name for name in arrays if "/" in name]:
            group, _, member = name.partition("/")
            groups[group][member] = arrays.pop(name)
        return Trajectory(**arrays, **groups, **plain)
    except UserError:
        raise
    except Exception as error:  # damage shows as a BadZipFile, zlib.error, ValueError, KeyError, TypeError and more
        raise UserError(f"{path}: damaged or no trajectory; record it again") from error


def describe(info: Mapping[str, Any]) -> str:
    """A trajectory's ``info`` in a few words, for titles: ``softgm on wall, seed 0, episode 3 of 100``."""
    return f"{info['label']} on {info['task']}, seed {info['seed']}, episode {info['episode']} of {info['episodes']}"
