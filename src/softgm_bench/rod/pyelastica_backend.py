"""PyElastica itself is a backend too: each arm in a simulator of its own, one after the other, on one core."""

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from softgm_bench.errors import UserError
from softgm_bench.rod.bodies import Bodies
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, RodState, check_inputs, refuse_gradients


class PyElasticaBackend:
    """This backend has PyElastica 1.0.0 move the rods, in float64 on the CPU, and equals ``TorchBackend`` to round-off.

    It is for confirming what the others say: a loop in Python over environments and substeps, some hundred times as
    slow as ``NumbaBackend``.

    Attributes:
        parameters: of the arm.
        contact_force: the largest force of the cylinders on any node within the last step, N, ``(num_envs,)`` float64.
        missed: contacts (cylinder and substep) that PyElastica's bounding boxes did not, or would not, let through, in
            all steps until now.
    """

    def __init__(self, parameters: RodParameters, pruning: bool = False) -> None:
        """Prepare for one arm; PyElastica compiles at the first step.

        Args:
            parameters: of the arm.
            pruning: PyElastica skips cylinders by its bounding boxes as it is shipped, which may miss contacts.

        Raises:
            UserError: PyElastica is not installed, or has no such contact.
        """
        try:
            import softgm_bench.rod.pyelastica_oracle as oracle
        except ImportError as error:
            raise UserError("backend=pyelastica needs PyElastica: pip install '.[pyelastica]'") from error
        if parameters.contact_model != "pyelastica":
            raise UserError(
                f"rod.contact_model={parameters.contact_model} with backend=pyelastica: PyElastica has no such "
                "contact; choose rod.contact_model=pyelastica, or another backend"
            )
        self.parameters, self.missed = parameters, 0
        self.contact_force = torch.zeros(0, dtype=torch.float64)
        self._oracle, self._pruning = oracle, pruning
        self._arms: dict[tuple[RodParameters, tuple[oracle.Post, ...]], oracle.Arm] = {}

    def control_step(
        self,
        state: RodState,
        couple: Tensor,
        force: Tensor | None = None,
        cylinders: Cylinders | None = None,
        active: Tensor | None = None,
        substeps: int | None = None,
        cylinder_velocity: Tensor | None = None,
        bodies: Bodies | None = None,
        touched: Tensor | None = None,
    ) -> RodState:
        """Advance every rod by one control step.

        A simulator is built where a body, or cylinders of some lengths, radii and directions, are met for the first
        time and kept while they are met. It is told before the step where they are, how they move and each rod's
        state, so equal rods among such cylinders share it.

        Args:
            state: not changed; float64 on the CPU.
            couple: external couple on elements in the material frame, N m, ``(num_envs, 3, n_elements)``.
            force: external force on nodes in the world frame, N, ``(num_envs, 3, n_nodes)``; gravity is added.
            cylinders: what the rods may touch.
            active: ``(num_envs,)`` bool; rods that are not come back as they were.
            substeps: of this step, the parameters' number by default.
            cylinder_velocity: with which the cylinders move on from where they are now, m/s, without turning,
                ``(num_envs, n_cylinders, 3)``; constant in the step. By default they stand still.
            bodies: factors on the parameters, an arm for each environment; by default all are the nominal one.
            touched: ``(num_envs,)`` bool, in which rods that a cylinder pushes in any substep are marked; entries of
                others stay as they are. By default nobody is told.

        Returns:
            A new state.

        Raises:
            ValueError: if the arguments' shapes do not fit together, the state is not float64 on the CPU, or a gradient
                is asked for.
        """
        check_inputs(self.parameters, state, couple, force, cylinders, active, cylinder_velocity, bodies, touched)
        refuse_gradients("pyelastica", state, couple, force, bodies)
        if state.position.dtype != torch.float64 or state.position.device.type != "cpu":
            raise ValueError(
                f"the state is {state.position.dtype} on {state.position.device}: the pyelastica backend computes in "
                "float64 on the CPU"
            )
        new = state.clone()
        num_envs = len(couple)
        rows = range(num_envs) if active is None else active.nonzero().flatten().tolist()
        posts = {row: () if cylinders is None else self._oracle.posts_of(cylinders, row) for row in rows}
        kinds = {
            row: (
                self.parameters if bodies is None else bodies.arm(self.parameters, row),
                tuple(post._replace(start=(0.0, 0.0, 0.0)) for post in met),
            )
            for row, met in posts.items()
        }
        self._arms = {kind: self._arms.get(kind) or self._oracle.Arm(*kind, carried=True) for kind in kinds.values()}
        self.contact_force = torch.zeros(num_envs, dtype=torch.float64)
        couples = couple.detach().double().numpy()
        forces = None if force is None else force.detach().double().numpy()
        with self._oracle.watched_pruning(self._pruning) as watched:
            for row, met in posts.items():
                arm = self._arms[kinds[row]]
                arm.carry([post.start for post in met], _velocity(cylinders, cylinder_velocity, row))
                fields = [field[row].numpy() for field in (new.position, new.director, new.velocity, new.omega)]
                for theirs, ours in zip(arm.state, fields, strict=True):
                    theirs[...] = ours
                push = None if forces is None else forces[row]
                self.contact_force[row] = arm.control_step(couples[row], push, substeps)
                for theirs, ours in zip(arm.state, fields, strict=True):
                    ours[...] = theirs
        self.missed += watched.missed
        if touched is not None:
            touched |= self.contact_force > 0.0
        return new


def _velocity(cylinders: Cylinders | None, velocity: Tensor | None, row: int) -> NDArray[np.float64]:
    """Velocities of the cylinders that exist in one environment, m/s, ``(posts, 3)``."""
    if cylinders is None or velocity is None:
        count = 0 if cylinders is None else int(cylinders.mask[row].sum())
        return np.zeros((count, 3))
    return velocity[row][cylinders.mask[row]].detach().double().numpy()
