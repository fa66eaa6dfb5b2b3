"""The CUDA kernel on a GPU; skipped where there is none.

A kernel is compiled for each number of elements, precision and contact model, which takes about 5 s; the CPU's kernel
is too, and takes longer. So tests share variants, and what needs one of its own is held against the PyTorch backend.
"""

from functools import cache

import pytest
import torch

from softgm_bench.rod.cuda_backend import CudaBackend
from softgm_bench.rod.numba_backend import NumbaBackend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, RodState, straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA GPU here")]

FIELDS = ("position", "director", "velocity", "omega")
ROUGH = {"friction_coefficient": 0.5, "velocity_damping_coefficient": 50.0}
UPRIGHT = [[0.0, 0.0, 1.0]]
EXACT = {"contact_model": "exact"}
SCENES = {
    "free": None,
    "wall": ([[0.4, 0.08 * k, -0.2] for k in range(-2, 6)], UPRIGHT * 8, [1.4] * 8, [0.04] * 8),
    # the last eight are the wall: more cylinders than a thread keeps as candidates
    "wall behind others": (
        [[0.4, 2.0 + 0.08 * k, -0.2] for k in range(32)] + [[0.4, 0.08 * k, -0.2] for k in range(-2, 6)],
        UPRIGHT * 40,
        [1.4] * 40,
        [0.04] * 40,
    ),
    "slanted post": ([[0.13, 0.0, 0.7]], [[0.6, 0.0, 0.8]], [0.3], [0.04]),
}


def obstacles(scene: str, num_envs: int) -> Cylinders | None:
    if SCENES[scene] is None:
        return None
    fields = [
        torch.tensor(field, dtype=torch.float64).expand(num_envs, *torch.tensor(field).shape) for field in SCENES[scene]
    ]
    start, axis, length, radius = (field.contiguous() for field in fields)
    mask = torch.ones(length.shape, dtype=torch.bool)
    return Cylinders(start=start, axis=axis, length=length, radius=radius, mask=mask, batch_size=[num_envs])


def random_couple(num_envs: int, n_elements: int, step: int) -> torch.Tensor:
    """Smooth bending that leans towards the obstacles, N m per element."""
    generator = torch.Generator().manual_seed(step)
    values = 10.0 * (2.0 * torch.rand(num_envs, 2, 5, generator=generator, dtype=torch.float64) - 1.0)
    values[:, 0] += 16.0
    bending = torch.nn.functional.interpolate(values, size=n_elements, mode="linear", align_corners=True) / n_elements
    return torch.cat([bending, torch.zeros(num_envs, 1, n_elements, dtype=torch.float64)], dim=1)


def run(backend, parameters, scene, device, steps, num_envs=4, dtype=torch.float64) -> RodState:
    state = straight_rods(parameters, num_envs, dtype, device)
    cylinders = obstacles(scene, num_envs)
    cylinders = None if cylinders is None else cylinders.to(device)
    force = torch.zeros(num_envs, 3, parameters.n_nodes, dtype=dtype, device=device)
    force[:, 1, -1] = 1.0
    for step in range(steps):
        couple = random_couple(num_envs, parameters.n_elements, step).to(device, dtype)
        state = backend.control_step(state, couple, force, cylinders)
    return state


@cache
def expected(parameters: RodParameters, scene: str) -> RodState:
    """A second of motion in the CPU's kernel."""
    return run(NumbaBackend(parameters), parameters, scene, "cpu", steps=25)


@pytest.mark.parametrize(
    "changes", [{}, {"contact_model": "exact"}, ROUGH, ROUGH | {"contact_model": "exact"}], ids=str
)
@pytest.mark.parametrize("scene", SCENES)
def test_a_second_of_motion_equals_the_numba_backend(scene: str, changes: dict):
    parameters = RodParameters(gravity=(0.5, 0.0, -1.0), **changes)
    found = run(CudaBackend(parameters), parameters, scene, "cuda", steps=25)
    right = expected(parameters, scene)
    if scene != "free":
        assert (expected(parameters, "free").position - right.position).abs().max() > 1e-3
    for name in FIELDS:
        tolerance = 1e-10 if name in ("position", "director") else 1e-7
        assert torch.allclose(getattr(found, name).cpu(), getattr(right, name), rtol=0.0, atol=tolerance), name


@pytest.mark.parametrize(
    ("n_elements", "dtype"),
    [
        (2, torch.float64),  # the fewest
        (3, torch.float32),
        (31, torch.float32),  # nodes fill a warp
        (32, torch.float64),  # one is in the next
        (300, torch.float32),  # many warps, neighbours meet on the chip
        (1023, torch.float64),  # the most, with the fewest registers each; neighbours meet in the GPU's memory
        (1023, torch.float32),
    ],
)
def test_any_number_of_elements_agrees_with_the_torch_backend(n_elements: int, dtype: torch.dtype):
    parameters = RodParameters(n_elements=n_elements, base_length=n_elements / 60, substeps=20)
    found = run(CudaBackend(parameters), parameters, "wall", "cuda", steps=1, dtype=dtype)
    right = run(TorchBackend(parameters), parameters, "wall", "cpu", steps=1)
    tolerance = 1e-10 if dtype == torch.float64 else 1e-4 * parameters.base_length
    assert torch.allclose(found.position.cpu().double(), right.position, rtol=0.0, atol=tolerance)


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_environments_do_not_see_each_other(dtype: torch.dtype):
    parameters = RodParameters()
    backend, cylinders = CudaBackend(parameters), obstacles("wall", 300).to("cuda")
    state = straight_rods(parameters, 300, dtype, "cuda")
    couples = [random_couple(300, 60, step).to("cuda", dtype) for step in range(10)]
    one, alone = slice(217, 218), state[217:218]
    for couple in couples:
        state = backend.control_step(state, couple, cylinders=cylinders)
        alone = backend.control_step(alone, couple[one], cylinders=cylinders[one])
    for name in FIELDS:
        assert torch.equal(getattr(state[one], name), getattr(alone, name)), name


def test_a_control_step_never_waits_for_the_gpu():
    parameters = RodParameters()
    backend, state = CudaBackend(parameters), straight_rods(parameters, 64, device="cuda")
    couple, cylinders = random_couple(64, 60, 0).cuda(), obstacles("wall", 64).to("cuda")
    active = torch.ones(64, dtype=torch.bool, device="cuda")
    state = backend.control_step(state, couple, cylinders=cylinders, active=active)
    torch.cuda.synchronize()
    # Work enqueued on torch's stream before the steps is still under way when they have all been enqueued.
    before, after = torch.cuda.Event(), torch.cuda.Event()
    torch.cuda.set_sync_debug_mode("error")
    try:
        torch.cuda._sleep(2_000_000_000)
        before.record()
        for _ in range(5):
            state = backend.control_step(state, couple, cylinders=cylinders, active=active)
        after.record()
        assert not before.query()
    finally:
        torch.cuda.set_sync_debug_mode("default")
    after.synchronize()
    assert state.position.isfinite().all()


def test_steps_run_on_torchs_current_stream():
    parameters = RodParameters()
    backend, couple = CudaBackend(parameters), random_couple(8, 60, 0).cuda()
    expected = backend.control_step(straight_rods(parameters, 8, device="cuda"), couple)
    torch.cuda.synchronize()
    with torch.cuda.stream(torch.cuda.Stream()):
        late = torch.zeros_like(couple)
        torch.cuda._sleep(200_000_000)
        late.copy_(couple)
        found = backend.control_step(straight_rods(parameters, 8, device="cuda"), late)
    torch.cuda.synchronize()
    assert torch.equal(found.position, expected.position)
