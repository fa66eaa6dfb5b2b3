"""A recorded episode once more: its actions and forces, against its cylinders, by any implementation of the rod."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from softgm_bench.episodes.trajectory import CYLINDER_FIELDS, PATH, ROD, Array, Trajectory
from softgm_bench.errors import UserError
from softgm_bench.rod import backend as rod_backend
from softgm_bench.rod.actuation import Actuation
from softgm_bench.rod.bodies import Bodies
from softgm_bench.rod.divergence import diverged
from softgm_bench.rod.parameters import rod_constants
from softgm_bench.rod.pyelastica_backend import PyElasticaBackend
from softgm_bench.rod.state import Cylinders, RodState

BACKENDS = tuple(name for name in rod_backend.BACKENDS if rod_backend.runs_on(name, "cpu"))


@dataclass(frozen=True)
class Replay:
    """States as in ``Trajectory``; from PyElastica also what its cylinders did, otherwise None.

    Attributes:
        position: m, ``(T + 1, 3, n_nodes)``.
        director: ``(T + 1, 3, 3, n_elements)``.
        velocity: m/s, ``(T + 1, 3, n_nodes)``.
        omega: rad/s, ``(T + 1, 3, n_elements)``.
        contact_force: the largest force of the cylinders on any node within each step, N, ``(T,)``.
        missed: contacts (cylinder and substep) that PyElastica's bounding boxes did not, or would not, let through.
    """

    position: Array
    director: Array
    velocity: Array
    omega: Array
    contact_force: Array | None = None
    missed: int | None = None


def replay(
    trajectory: Trajectory, backend: str, pruning: bool = False, watch: Callable[[], None] | None = None
) -> Replay:
    """Simulate a trajectory's actions and forces from its first state.

    Args:
        trajectory: what was recorded.
        backend: one of ``BACKENDS``. PyElastica computes in float64, the others in the recording's type.
        pruning: PyElastica skips cylinders by its bounding boxes as it is shipped, which may miss contacts.
        watch: called before each step.

    Raises:
        UserError: no such backend, one that cannot simulate this arm, or PyElastica is not installed.
    """
    if backend not in BACKENDS:
        raise UserError(f"backend={backend}: choose one of {', '.join(BACKENDS)}")
    if pruning and backend != "pyelastica":
        raise UserError(f"pruning=true: only backend=pyelastica has bounding boxes, not backend={backend}")
    if backend == "pyelastica":
        return _by_pyelastica(trajectory, PyElasticaBackend(trajectory.rod, pruning), watch)
    return _replayed(trajectory, rod_backend.make_backend(backend, trajectory.rod), watch)


def compare(trajectory: Trajectory, replayed: Replay) -> dict[str, Any]:
    """Measure how far a replay is from the recording.

    Returns:
        ``identical``: whether all bits are equal. ``largest``: the largest difference of a component over the episode,
        by quantity. ``position``: that of nodes at each state, m, ``T + 1`` numbers. ``recorded`` and ``replayed``: the
        tip's ``final_distance`` to the target, m, and ``reached``, the first step after which it is within the task's
        radius, None if there is none.
    """
    differences = {name: np.abs(getattr(replayed, name) - getattr(trajectory, name)) for name in ROD}
    sides: dict[str, Trajectory | Replay] = {"recorded": trajectory, "replayed": replayed}
    radius = trajectory.config["task"]["success_radius"]
    return {
        "identical": all(np.array_equal(getattr(replayed, name), getattr(trajectory, name)) for name in ROD),
        "largest": {name: float(values.max()) for name, values in differences.items()},
        "position": differences["position"].max(axis=(1, 2)).tolist(),
        **{name: _outcome(side.position, trajectory.target, radius) for name, side in sides.items()},
    }


def _outcome(position: Array, target: Array, radius: float) -> dict[str, Any]:
    distance = np.linalg.norm(position[1:, :, -1] - target, axis=1)
    reached = np.flatnonzero(distance < radius)
    return {"final_distance": float(distance[-1]), "reached": int(reached[0]) + 1 if len(reached) else None}


def _by_pyelastica(trajectory: Trajectory, backend: PyElasticaBackend, watch: Callable[[], None] | None) -> Replay:
    forces: list[float] = []
    states = _replayed(trajectory, backend, watch, torch.float64, lambda: forces.append(float(backend.contact_force)))
    return replace(states, contact_force=np.array(forces), missed=backend.missed)


def _replayed(
    trajectory: Trajectory,
    backend: rod_backend.Backend,
    watch: Callable[[], None] | None,
    dtype: torch.dtype | None = None,
    note: Callable[[], None] | None = None,
) -> Replay:
    """Move the arm; in the recording's type unless ``dtype`` says another. ``note`` is called after each step."""
    dtype = dtype or torch.from_numpy(trajectory.position).dtype
    couple, force = _couple(trajectory, dtype), _force(trajectory)
    task = trajectory.config["task"]
    rest_length = torch.as_tensor(rod_constants(trajectory.rod).rest_length, dtype=dtype)
    bodies = _bodies(trajectory)
    first = {name: torch.from_numpy(getattr(trajectory, name)[:1].copy()).to(dtype) for name in ROD}
    state = RodState(**first, batch_size=[1])
    states = [state]
    for step in range(trajectory.steps):
        if watch is not None:
            watch()
        push = None if force is None else torch.from_numpy(force(step)).to(dtype).unsqueeze(0)
        cylinders, velocity = _cylinders(trajectory, step, dtype)
        moved = backend.control_step(
            state, couple(step), force=push, cylinders=cylinders, cylinder_velocity=velocity, bodies=bodies
        )
        if note is not None:
            note()
        # the environment keeps the last state of an arm whose simulation breaks
        broken = diverged(moved, rest_length, task["min_dilatation"], task["max_dilatation"])
        state = state if bool(broken.any()) else moved
        states.append(state)
    arrays: dict[str, Any] = {name: np.concatenate([getattr(state, name).numpy() for state in states]) for name in ROD}
    return Replay(**arrays)


def _couple(trajectory: Trajectory, dtype: torch.dtype) -> Callable[[int], torch.Tensor]:
    """Couple on the elements in a step, N m, ``(1, 3, n_elements)``."""
    settings = trajectory.config["task"]["actuation"]
    actuation = Actuation(
        trajectory.rod,
        trajectory.n_agents,
        settings["max_torque"],
        settings["basis"],
        settings["scaling"],
        dtype=dtype,
    )
    strength = trajectory.body.get("max_torque")

    def couple(step: int) -> torch.Tensor:
        values = actuation.couple(torch.from_numpy(trajectory.action[step : step + 1]))
        return values if strength is None else values * strength

    return couple


def _bodies(trajectory: Trajectory) -> Bodies | None:
    """The factors that made the episode's arm, ``(1,)`` each; None: it is the nominal one."""
    if not trajectory.body:
        return None
    return Bodies(*(torch.tensor([trajectory.body[name]], dtype=torch.float64) for name in Bodies._fields))


def _force(trajectory: Trajectory) -> Callable[[int], NDArray[np.float64]] | None:
    """Force on the nodes in a step, N, ``(3, n_nodes)``; None if there never is one."""
    if not trajectory.tip_force.any():
        return None

    def force(step: int) -> NDArray[np.float64]:
        values = np.zeros((3, trajectory.rod.n_nodes))
        values[:, -1] = trajectory.tip_force[step]
        return values

    return force


def _cylinders(trajectory: Trajectory, step: int, dtype: torch.dtype) -> tuple[Cylinders | None, torch.Tensor | None]:
    """Cylinders as a step begins and, where they move, their velocity in it, as the environment computed it, m/s."""
    count = len(trajectory.cylinders["start"])
    if count == 0:
        return None, None
    given = trajectory.cylinders | {"start": trajectory.starts(step)}
    fields = {name: torch.from_numpy(given[name]).to(dtype).unsqueeze(0) for name in CYLINDER_FIELDS}
    cylinders = Cylinders(**fields, mask=torch.ones((1, count), dtype=torch.bool), batch_size=[1])
    if PATH not in given:
        return cylinders, None
    following = torch.from_numpy(trajectory.starts(step + 1)).to(dtype).unsqueeze(0)
    return cylinders, (following - cylinders.start) / trajectory.rod.control_dt
