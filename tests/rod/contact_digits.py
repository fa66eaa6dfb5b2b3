"""Prints a digest of arms that lean on posts, for every contact model, precision and friction; a process of its own."""

import hashlib

import numba
import torch

from softgm_bench.envs.tasks.base import upright_cylinders
from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import CONTACT_MODELS, RodParameters
from softgm_bench.rod.state import Cylinders, straight_rods

NUM_ENVS, STEPS, LEAN = 2, 60, 16.0  # LEAN: N m per m, towards the posts


def posts(dtype: torch.dtype) -> Cylinders:
    """Three columns that the leaning arm rests on."""
    xy = torch.tensor([[0.3, 0.0], [0.3, 0.08], [0.3, -0.08]], dtype=torch.float64).expand(NUM_ENVS, 3, 2)
    bottom = torch.full((NUM_ENVS, 3), -0.2, dtype=torch.float64)
    found = upright_cylinders(xy, bottom, bottom + 1.4, 0.04, torch.ones(NUM_ENVS, 3, dtype=torch.bool))
    return found.apply(lambda value: value.to(dtype) if value.is_floating_point() else value)


def digest(model: str, dtype: torch.dtype, friction: float) -> str:
    """Of everything that moves, after ``STEPS`` control steps."""
    arm = RodParameters(n_elements=20, contact_model=model, friction_coefficient=friction)
    state, rod = straight_rods(arm, NUM_ENVS, dtype), make_backend("numba", arm)
    couple = torch.zeros(NUM_ENVS, 3, arm.n_elements, dtype=dtype)
    couple[:, 0] = LEAN / arm.n_elements
    for _ in range(STEPS):
        state = rod.control_step(state, couple, cylinders=posts(dtype))
    assert state.position[:, 0].max() > 0.15  # it has come to the posts
    fields = (state.position, state.director, state.velocity, state.omega)
    return hashlib.sha256(b"".join(field.numpy().tobytes() for field in fields)).hexdigest()


if __name__ == "__main__":
    numba.set_num_threads(1)
    for model in CONTACT_MODELS:
        for dtype in (torch.float64, torch.float32):
            for friction in (0.0, 0.5):
                print(model, dtype, friction, digest(model, dtype, friction))
