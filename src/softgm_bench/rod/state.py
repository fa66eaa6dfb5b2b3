"""The rods' state and the cylinders that they may touch are batched over environments."""

from functools import lru_cache

import torch
from tensordict import TensorClass
from torch import Tensor

from softgm_bench.rod.bodies import Bodies
from softgm_bench.rod.parameters import RodParameters, rod_constants


class RodState(TensorClass):
    """This is the kinematic state of ``num_envs`` rods; ``batch_size`` is ``(num_envs,)``.

    Attributes:
        position: nodes in the world frame, m, ``(num_envs, 3, n_nodes)``.
        director: rows d1, d2, d3 of each element's material frame, ``(num_envs, 3, 3, n_elements)``.
        velocity: of nodes in the world frame, m/s, ``(num_envs, 3, n_nodes)``.
        omega: angular velocity in the material frame, rad/s, ``(num_envs, 3, n_elements)``.
    """

    position: Tensor
    director: Tensor
    velocity: Tensor
    omega: Tensor


class Cylinders(TensorClass):
    """These are rigid cylinders, padded to one number per environment; ``batch_size`` is ``(num_envs,)``.

    They stand still, or move as the ``cylinder_velocity`` of a control step says.

    Attributes:
        start: centre of one end, m, ``(num_envs, n_cylinders, 3)``.
        axis: unit vector from start to the other end, ``(num_envs, n_cylinders, 3)``.
        length: m, ``(num_envs, n_cylinders)``; positive also where masked.
        radius: m, ``(num_envs, n_cylinders)``.
        mask: whether the cylinder exists, ``(num_envs, n_cylinders)``.
    """

    start: Tensor
    axis: Tensor
    length: Tensor
    radius: Tensor
    mask: Tensor


def straight_rods(
    parameters: RodParameters,
    num_envs: int,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str = "cpu",
) -> RodState:
    """Return ``num_envs`` rods at rest, straight along +z from the origin with d1 = +y."""
    position, director = (
        one.expand(num_envs, *one.shape).clone() for one in _straight(parameters, dtype, torch.device(device))
    )
    return RodState(
        position=position,
        director=director,
        velocity=torch.zeros_like(position),
        omega=torch.zeros_like(director[:, 0]),
        batch_size=[num_envs],
    )


@lru_cache(maxsize=8)
def _straight(parameters: RodParameters, dtype: torch.dtype, device: torch.device) -> tuple[Tensor, Tensor]:
    """Nodes and directors of one straight rod, copied to the device once."""
    constants = rod_constants(parameters)
    position = torch.as_tensor(constants.position, dtype=dtype, device=device)
    return position, torch.as_tensor(constants.director, dtype=dtype, device=device)


def dilatation(position: Tensor, rest_length: Tensor) -> Tensor:
    """Return element lengths over rest lengths, ``(num_envs, n_elements)`` (Gazzola et al. 2018, eq. 3.3).

    ``position`` holds the nodes in m, ``(num_envs, 3, n_nodes)``; ``rest_length`` broadcasts with the result.
    """
    edges = position[..., 1:] - position[..., :-1]
    return edges.norm(dim=-2) / rest_length


def refuse_gradients(
    backend: str, state: RodState, couple: Tensor, force: Tensor | None, bodies: Bodies | None = None
) -> None:
    """Refuse a step whose gradient would be asked for, in a kernel that has none.

    Raises:
        ValueError: naming what would do.
    """
    tensors = (couple, force, state.position, state.director, state.velocity, state.omega, *(bodies or ()))
    if torch.is_grad_enabled() and any(tensor is not None and tensor.requires_grad for tensor in tensors):
        raise ValueError(
            f"the action, force, state or body requires a gradient, and backend={backend} has none: "
            "choose backend=torch, or step under torch.no_grad()"
        )


def check_inputs(
    parameters: RodParameters,
    state: RodState,
    couple: Tensor,
    force: Tensor | None,
    cylinders: Cylinders | None,
    active: Tensor | None,
    cylinder_velocity: Tensor | None = None,
    bodies: Bodies | None = None,
    touched: Tensor | None = None,
) -> None:
    """Refuse arguments that do not fit together before any kernel reads them.

    Raises:
        ValueError: naming the first argument whose shape is wrong, and the right one.
    """
    num_envs, n = state.position.shape[0], parameters.n_elements
    if cylinder_velocity is not None and cylinders is None:
        raise ValueError("cylinder_velocity is given without cylinders: it is theirs, so give both")
    n_cylinders = 0 if cylinders is None else cylinders.mask.shape[-1]
    expected = {
        "state.position": (state.position, (num_envs, 3, n + 1)),
        "state.director": (state.director, (num_envs, 3, 3, n)),
        "state.velocity": (state.velocity, (num_envs, 3, n + 1)),
        "state.omega": (state.omega, (num_envs, 3, n)),
        "couple": (couple, (num_envs, 3, n)),
        "force": (force, (num_envs, 3, n + 1)),
        "active": (active, (num_envs,)),
        "touched": (touched, (num_envs,)),
        "cylinders.mask": (None if cylinders is None else cylinders.mask, (num_envs, -1)),
        "cylinder_velocity": (cylinder_velocity, (num_envs, n_cylinders, 3)),
    }
    if bodies is not None:
        expected |= {f"bodies.{name}": (factor, (num_envs,)) for name, factor in bodies._asdict().items()}
    for name, (tensor, shape) in expected.items():
        if tensor is None:
            continue
        fits = len(tensor.shape) == len(shape)
        if not fits or any(size not in (-1, found) for found, size in zip(tensor.shape, shape, strict=True)):
            raise ValueError(f"{name} has shape {tuple(tensor.shape)}: it must be {shape} for this rod and state")
