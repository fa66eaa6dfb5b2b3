import os
import re
import subprocess
import sys
from pathlib import Path

import numba
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies
from sharp_bends import beyond_polynomials

from pairwise import partly
from softgm_bench.rod.numba_backend import NumbaBackend
from softgm_bench.rod.numba_contact import make_contact, make_touch
from softgm_bench.rod.numba_kernel import FASTMATH, make_kernel
from softgm_bench.rod.numba_layout import make_layout
from softgm_bench.rod.parameters import CONTACT_MODELS, RodParameters
from softgm_bench.rod.state import Cylinders, RodState, dilatation, straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

ARM = RodParameters()
FIELDS = ("position", "director", "velocity", "omega")


def random_couple(num_envs, n_elements=60, seed=0, size=25.0):
    """Smooth couples: five control values per direction and environment, interpolated."""
    generator = torch.Generator().manual_seed(seed)
    values = size / n_elements * (2.0 * torch.rand(num_envs, 2, 5, generator=generator, dtype=torch.float64) - 1.0)
    bending = torch.nn.functional.interpolate(values, size=n_elements, mode="linear", align_corners=True)
    return torch.cat([bending, torch.zeros(num_envs, 1, n_elements, dtype=torch.float64)], dim=1)


def random_cylinders(num_envs, count, seed=0):
    """Oblique cylinders of all sizes around the arm, some of them masked."""
    generator = torch.Generator().manual_seed(seed)

    def draw(low, high, *shape):
        return low + (high - low) * torch.rand(num_envs, count, *shape, generator=generator, dtype=torch.float64)

    axis = draw(-1.0, 1.0, 3)
    return Cylinders(
        start=draw(-0.5, 0.5, 3) + torch.tensor([0.0, 0.0, 0.4], dtype=torch.float64),
        axis=axis / axis.norm(dim=-1, keepdim=True),
        length=draw(0.05, 1.0),
        radius=draw(0.01, 0.08),
        mask=draw(0.0, 1.0) < 0.8,
        batch_size=[num_envs],
    )


def equal(first: RodState, second: RodState) -> bool:
    return all(torch.equal(getattr(first, name), getattr(second, name)) for name in FIELDS)


def swing(backend, num_envs=6, steps=3, cylinders=None, dtype=torch.float64, parameters=ARM):
    state = straight_rods(parameters, num_envs, dtype)
    for step in range(steps):
        couple = random_couple(num_envs, parameters.n_elements, seed=step).to(dtype)
        state = backend.control_step(state, couple, cylinders=cylinders)
    return state


@settings(deadline=None, max_examples=15)
@given(seed=strategies.integers(0, 10_000), friction=strategies.sampled_from([0.0, 0.5]))
def test_no_contact_is_missed_whatever_the_cylinders(seed, friction):
    """The torch backend computes every pair; the fused one skips what it has shown to be out of reach."""
    parameters = RodParameters(
        n_elements=20, substeps=40, friction_coefficient=friction, velocity_damping_coefficient=10.0 * friction
    )
    cylinders = random_cylinders(4, 6, seed)
    fused = swing(NumbaBackend(parameters), 4, 2, cylinders, parameters=parameters)
    reference = swing(TorchBackend(parameters), 4, 2, cylinders, parameters=parameters)
    for name in FIELDS:
        found, expected = getattr(fused, name), getattr(reference, name)
        # a cylinder that starts deep inside the arm may throw it out of the float range in both
        sound = (dilatation(reference.position, 1 / 20) < 5.0).all(dim=-1) & expected.flatten(1).isfinite().all(-1)
        assert torch.allclose(found[sound], expected[sound], rtol=1e-7, atol=1e-7), name


def test_environments_do_not_see_each_other_nor_the_number_of_threads():
    cylinders = random_cylinders(6, 4, seed=5)
    cylinders.start += 0.25
    backend = NumbaBackend(ARM)
    together = swing(backend, cylinders=cylinders)
    threads = numba.get_num_threads()
    try:
        numba.set_num_threads(1)
        assert equal(together, swing(backend, cylinders=cylinders))
    finally:
        numba.set_num_threads(threads)
    order = torch.tensor([3, 0, 5, 1, 4, 2])
    state = straight_rods(ARM, 6)
    for step in range(3):
        state = backend.control_step(state, random_couple(6, seed=step)[order], cylinders=cylinders[order])
    assert equal(state, together[order])
    alone = straight_rods(ARM, 1)
    for step in range(3):
        alone = backend.control_step(alone, random_couple(6, seed=step)[4:5], cylinders=cylinders[4:5])
    assert equal(alone, together[4:5])


def test_inactive_rods_come_back_as_they_were_and_the_input_is_not_changed():
    backend = NumbaBackend(ARM)
    state = swing(backend, 3, 1)
    copy = state.clone()
    after = backend.control_step(state, random_couple(3, seed=9), active=torch.tensor([True, False, True]))
    assert equal(state, copy)
    assert equal(after[1:2], state[1:2])
    assert not torch.equal(after.position[0], state.position[0])


def test_a_control_step_is_as_many_substeps_one_after_another():
    backend = NumbaBackend(ARM)
    couple = random_couple(2)
    at_once = backend.control_step(straight_rods(ARM, 2), couple, substeps=20)
    pieces = straight_rods(ARM, 2)
    for substeps in (1, 7, 12):
        pieces = backend.control_step(pieces, couple, substeps=substeps)
    assert torch.allclose(at_once.position, pieces.position, rtol=0.0, atol=1e-13)
    assert torch.allclose(at_once.omega, pieces.omega, rtol=0.0, atol=1e-9)


def test_the_base_is_clamped_and_directors_stay_orthonormal():
    state = swing(NumbaBackend(ARM), 4, 25)
    assert (state.position[:, :, 0] == 0.0).all()
    assert torch.equal(state.director[..., 0], straight_rods(ARM, 4).director[..., 0])
    gram = torch.einsum("bijn,bkjn->bnik", state.director, state.director)
    assert (gram - torch.eye(3, dtype=torch.float64)).abs().max() < 1e-12


def test_bends_and_turns_beyond_the_polynomials_range_agree_with_the_reference():
    parameters, state = beyond_polynomials()
    couple = torch.zeros(1, 3, 6, dtype=torch.float64)
    found = NumbaBackend(parameters).control_step(state, couple, substeps=3)
    expected = TorchBackend(parameters).control_step(state, couple, substeps=3)
    for name in FIELDS:
        assert torch.allclose(getattr(found, name), getattr(expected, name), rtol=1e-10, atol=1e-12), name


def test_float32_follows_float64_closely_over_a_control_step():
    double = swing(NumbaBackend(ARM), steps=2)
    single = swing(NumbaBackend(ARM), steps=2, dtype=torch.float32)
    assert single.position.dtype == torch.float32
    assert (single.position - double.position).abs().max() < 1e-4


@pytest.mark.parametrize("n_elements", partly([2, 60, 3, 7, 61], [2, 60]))
def test_any_number_of_elements_agrees_with_the_reference(n_elements):
    parameters = RodParameters(n_elements=n_elements, base_length=n_elements / 60, substeps=20)
    cylinders = random_cylinders(3, 3, seed=n_elements)
    cylinders.start += 0.2
    couple = random_couple(3, n_elements)
    found = NumbaBackend(parameters).control_step(straight_rods(parameters, 3), couple, cylinders=cylinders)
    expected = TorchBackend(parameters).control_step(straight_rods(parameters, 3), couple, cylinders=cylinders)
    assert torch.allclose(found.position, expected.position, rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("name", ["couple", "force", "active", "cylinders.mask", "state.position"])
def test_shapes_that_do_not_fit_are_refused_before_the_kernel_reads_them(name):
    backend, state = NumbaBackend(ARM), straight_rods(ARM, 2)
    arguments = {"couple": random_couple(2), "force": None, "active": None, "cylinders": None}
    if name == "state.position":
        backend = NumbaBackend(RodParameters(n_elements=61))
    elif name == "cylinders.mask":
        arguments["cylinders"] = random_cylinders(3, 2)
    else:
        arguments[name] = torch.zeros(2, 3, 59, dtype=torch.float64)
    with pytest.raises(ValueError, match=f"{name} has shape"):
        backend.control_step(state, **arguments)


def double_arithmetic(function, signature) -> list[str]:
    """Lines of the generated code that compute in float64; boxing of Python's own floats is none."""
    compiled = numba.njit(fastmath=FASTMATH, error_model="numpy")(function.py_func)  # code from the cache shows nothing
    compiled.compile(signature)
    arithmetic = re.compile(r"= (fadd|fsub|fmul|fdiv|fneg|fcmp|sitofp)\b.*\bdouble\b|x double>|llvm\.\w+\.f64")
    return [line for line in compiled.inspect_llvm(signature).splitlines() if arithmetic.search(line)]


def test_float32_kernel_computes_nothing_in_float64():
    row, table, real = numba.float32[::1], numba.float32[:, ::1], numba.float32
    layout, kernel = make_layout(11, np.float32), make_kernel(11, np.float32)
    signatures = {
        "stresses": (row,),
        "couples": (row,),
        "spin": (row,),
        "rotate": (row, real),
        "push": (row, real),
        "move": (row, real),
    }
    for name, signature in signatures.items():
        assert double_arithmetic(getattr(kernel, name), signature) == [], name
    for model in CONTACT_MODELS:
        contact = make_contact(layout, np.float32, make_touch(layout, np.float32, model, False))
        assert double_arithmetic(contact.add_contact, (row, table, real, real, row, real)) == []


def test_code_that_computes_in_float64_is_recognised():
    kernel = make_kernel(11, np.float64)
    assert double_arithmetic(kernel.push, (numba.float64[::1], numba.float64))


@pytest.mark.parametrize("backend", [NumbaBackend, TorchBackend])
def test_float32_directors_stay_orthonormal(backend):
    """0.8 s; left to themselves they are off by 1e-5 after 0.2 s and by ever more."""
    parameters = RodParameters(n_elements=20)
    steps = 20 if backend is NumbaBackend else 5
    director = swing(backend(parameters), 2, steps, None, torch.float32, parameters).director.double()
    gram = torch.einsum("bijn,bkjn->bnik", director, director)
    assert (gram - torch.eye(3)).abs().max() < 1e-6
    assert torch.allclose(torch.linalg.det(director.permute(0, 3, 1, 2)), torch.ones(1, dtype=torch.float64))


@pytest.mark.parametrize("backend", [NumbaBackend, TorchBackend])
def test_axes_that_cross_give_no_nan(backend):
    """At distance 0 there is no direction; the axis passes through the point where element 10's segment starts."""
    parameters = RodParameters(n_elements=20, substeps=1)
    cylinder = Cylinders(
        start=torch.tensor([[[-0.5, 0.0, 0.525]]], dtype=torch.float64),
        axis=torch.tensor([[[1.0, 0.0, 0.0]]], dtype=torch.float64),
        length=torch.ones(1, 1, dtype=torch.float64),
        radius=torch.full((1, 1), 0.04, dtype=torch.float64),
        mask=torch.ones(1, 1, dtype=torch.bool),
        batch_size=[1],
    )
    state = backend(parameters).control_step(straight_rods(parameters, 1), torch.zeros(1, 3, 20), cylinders=cylinder)
    assert all(getattr(state, name).isfinite().all() for name in FIELDS)


@pytest.mark.slow
def test_a_process_that_compiles_has_the_digits_of_one_that_reads_the_disk_cache(tmp_path):
    """LLVM may optimise a function that stays a call otherwise where it stands alone: see ``scalar_contact``."""
    command = [sys.executable, Path(__file__).parent / "contact_digits.py"]
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}

    compiled, read = (
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout for _ in range(2)
    )

    assert len(compiled.splitlines()) == 4 * len(CONTACT_MODELS)
    assert compiled == read
