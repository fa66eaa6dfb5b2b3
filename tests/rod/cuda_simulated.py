"""The CUDA kernel under Numba's simulator against the PyTorch backend; run by ``test_cuda_backend.py``.

The simulator has to be chosen before Numba is imported, hence a process of its own with NUMBA_ENABLE_CUDASIM=1. It runs
every thread as a Python thread: rods are short here and so are the steps.
"""

from dataclasses import replace

import pytest
import torch
from sharp_bends import beyond_polynomials

from softgm_bench.envs import make_env
from softgm_bench.rod import cuda_step
from softgm_bench.rod.bodies import Bodies, draw
from softgm_bench.rod.cuda_backend import CudaBackend
from softgm_bench.rod.parameters import DAMPING_PROTOCOLS, RodParameters
from softgm_bench.rod.randomise import FACTORS, RandomiseConfig
from softgm_bench.rod.state import Cylinders, RodState, dilatation, straight_rods
from softgm_bench.rod.torch_backend import TorchBackend

FIELDS = ("position", "director", "velocity", "omega")
CYLINDER_FIELDS = ("start", "axis", "length", "radius", "mask")
N = 8
BARE = {"n_elements": N, "base_length": N / 60, "base_radius": 0.01, "substeps": 25, "youngs_modulus": 1e6}
FRICTION = {"friction_coefficient": 0.5, "velocity_damping_coefficient": 5.0}


def arm(**changes) -> RodParameters:
    """A short piece of an arm, so slender that posts beside one node do not touch all others."""
    return RodParameters(**(BARE | changes))


def couple_like(parameters: RodParameters, num_envs: int, seed: int = 0, size: float = 0.5) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    shape = (num_envs, 3, parameters.n_elements)
    return size / parameters.n_elements * (2.0 * torch.rand(shape, generator=generator, dtype=torch.float64) - 0.5)


def force_like(parameters: RodParameters, num_envs: int, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return 0.1 * torch.randn((num_envs, 3, parameters.n_nodes), generator=generator, dtype=torch.float64)


def moving(parameters: RodParameters, num_envs: int = 1, substeps: int = 200) -> RodState:
    """Rods under way, each differently."""
    couple, force = couple_like(parameters, num_envs, seed=7), force_like(parameters, num_envs, seed=8)
    return TorchBackend(parameters).control_step(straight_rods(parameters, num_envs), couple, force, substeps=substeps)


def cylinders_at(start, axis, length, radius, mask=None) -> Cylinders:
    """Of one environment, from nested lists with a row for each cylinder."""
    start, axis, length, radius = (torch.as_tensor(x, dtype=torch.float64)[None] for x in (start, axis, length, radius))
    axis = axis / axis.norm(dim=-1, keepdim=True)
    mask = torch.ones(length.shape, dtype=torch.bool) if mask is None else torch.as_tensor(mask)[None]
    return Cylinders(start=start, axis=axis, length=length, radius=radius, mask=mask, batch_size=[1])


def beside(state: RodState, nodes: list[int], gap: float, radius: float = 0.01, axis=(0.0, 1.0, 0.0)) -> Cylinders:
    """Bars through the plane of the rod, their axes ``gap`` from a node each."""
    shift = torch.tensor([gap, -0.2, 0.0], dtype=torch.float64)
    rows = [(state.position[0, :, node] + shift).tolist() for node in nodes]
    return cylinders_at(rows, [axis] * len(rows), [0.4] * len(rows), [radius] * len(rows))


def side_by_side(*parts: Cylinders) -> Cylinders:
    """The cylinders of all parts in each environment."""
    fields = {name: torch.cat([getattr(part, name) for part in parts], dim=1) for name in CYLINDER_FIELDS}
    return Cylinders(**fields, batch_size=parts[0].batch_size)


def assert_close(found: RodState, expected: RodState, tolerance: float = 1e-11) -> None:
    """Rates, whose round-off contact's stiffness amplifies, are given a hundred times as much."""
    for name in FIELDS:
        a, b = getattr(found, name), getattr(expected, name)
        allowed = tolerance if name in ("position", "director") else 100.0 * tolerance * max(1.0, b.abs().max().item())
        assert torch.allclose(a, b, rtol=0.0, atol=allowed), (name, (a - b).abs().max())


def assert_identical(found: RodState, expected: RodState) -> None:
    for name in FIELDS:
        assert torch.equal(getattr(found, name), getattr(expected, name)), name


def largest_change(first: RodState, second: RodState) -> float:
    return (first.velocity - second.velocity).abs().max().item()


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"damping_protocol": "uniform_damping_constant", "damping_constant": 3.0, "base_radius": 0.05},
        {"gravity": (0.5, 0.3, -9.81)},
        {"n_elements": 2, "base_length": 2 / 60},
        {"n_elements": 3, "base_length": 3 / 60},
        {"n_elements": 60, "base_length": 1.0, "base_radius": 0.05, "youngs_modulus": 5e5, "substeps": 8},
    ],
    ids=str,
)
def test_free_rods_move_as_in_the_torch_backend(changes):
    parameters = arm(**changes)
    state, couple = moving(parameters), couple_like(parameters, 1)
    force = None if changes == {} else force_like(parameters, 1)
    expected = TorchBackend(parameters).control_step(state, couple, force)
    assert largest_change(expected, state) > 1e-3
    assert_close(CudaBackend(parameters).control_step(state, couple, force), expected)


SCENES = {
    "a post": lambda state: beside(state, [5], 0.018),
    "posts on both sides": lambda state: side_by_side(beside(state, [3, 6], 0.017), beside(state, [3], -0.0172)),
    "both ends of the rod": lambda state: beside(state, [0, 8], 0.019),
    "a wall of forty posts": lambda state: beside(state, [k % 9 for k in range(40)], 0.0185),
    "a slanted post's end": lambda state: cylinders_at(
        [(state.position[0, :, 6] + torch.tensor([0.012, 0.004, -0.004], dtype=torch.float64)).tolist()],
        [[0.6, 0.0, 0.8]],
        [0.05],
        [0.012],
    ),
    "a post along the rod": lambda state: cylinders_at([[0.018, 0.0, -0.05]], [[0.0, 0.0, 1.0]], [0.3], [0.01]),
}


@pytest.mark.parametrize("model", ["pyelastica", "exact"])
@pytest.mark.parametrize("friction", [{}, FRICTION], ids=["smooth", "rough"])
@pytest.mark.parametrize("scene", SCENES)
def test_contact_acts_as_in_the_torch_backend(scene, friction, model):
    parameters = arm(**friction, contact_model=model, substeps=15)
    state, couple = moving(parameters), couple_like(parameters, 1)
    cylinders = SCENES[scene](state)
    reference = TorchBackend(parameters)
    expected = reference.control_step(state, couple, cylinders=cylinders)
    assert largest_change(expected, reference.control_step(state, couple)) > 1e-3
    if friction:
        smooth = TorchBackend(arm(contact_model=model, substeps=15)).control_step(state, couple, cylinders=cylinders)
        assert largest_change(expected, smooth) > 1e-5
    assert_close(CudaBackend(parameters).control_step(state, couple, cylinders=cylinders), expected)


@pytest.mark.parametrize("model", ["pyelastica", "exact"])
@pytest.mark.parametrize("friction", [{}, FRICTION], ids=["smooth", "rough"])
@pytest.mark.parametrize("scene", ["posts on both sides", "a wall of forty posts", "a slanted post's end"])
def test_cylinders_that_move_act_as_in_the_torch_backend(scene, friction, model):
    parameters = arm(**friction, contact_model=model, substeps=15)
    state, couple = moving(parameters), couple_like(parameters, 1)
    cylinders = SCENES[scene](state)
    velocity = torch.tensor([-0.4, 0.3, 0.2]) * torch.arange(cylinders.mask.shape[1]).sub(1.5).sign()[None, :, None]
    given = {"cylinders": cylinders, "cylinder_velocity": velocity.double()}
    expected = TorchBackend(parameters).control_step(state, couple, **given)
    assert largest_change(expected, TorchBackend(parameters).control_step(state, couple, cylinders=cylinders)) > 1e-3
    assert_close(CudaBackend(parameters).control_step(state, couple, **given), expected)


@pytest.mark.parametrize("model", ["pyelastica", "exact"])
def test_rods_that_are_pushed_are_marked(model):
    parameters = arm(contact_model=model, substeps=5)
    couple = couple_like(parameters, 3)
    state = straight_rods(parameters, 3)
    # within reach, out of it, within it of a rod that does not move
    where = beside(state[:1], [4], 0.017)
    apart = torch.tensor([[[0.0, 0.0, 0.0]], [[5.0, 0.0, 0.0]], [[0.0, 0.0, 0.0]]], dtype=torch.float64)
    cylinders = where.expand(3).contiguous()
    cylinders.start = cylinders.start + apart
    given = {"cylinders": cylinders, "active": torch.tensor([True, True, False])}
    for before in ([False, False, False], [False, True, True]):
        found, expected = torch.tensor(before), torch.tensor(before)
        CudaBackend(parameters).control_step(state, couple, **given, touched=found)
        TorchBackend(parameters).control_step(state, couple, **given, touched=expected)
        assert found.tolist() == expected.tolist() == [True, *before[1:]]


def test_a_post_that_comes_from_afar_is_not_missed():
    """It comes over twice its reach within the step; the rod is at rest until then."""
    parameters = arm(n_elements=3, base_length=0.05, substeps=60)
    state, couple = straight_rods(parameters, 1), torch.zeros(1, 3, 3, dtype=torch.float64)
    cylinders = cylinders_at([[0.1, -0.2, 0.05]], [[0.0, 1.0, 0.0]], [0.4], [0.01])
    given = {"cylinders": cylinders, "cylinder_velocity": torch.tensor([[[-4.0, 0.0, 0.0]]], dtype=torch.float64)}
    assert_identical(TorchBackend(parameters).control_step(state, couple, **given, substeps=40), state)
    expected = TorchBackend(parameters).control_step(state, couple, **given)
    assert largest_change(expected, state) > 1e-3
    assert_close(CudaBackend(parameters).control_step(state, couple, **given), expected, 1e-9)


def test_a_post_far_away_is_not_forgotten_until_the_rod_arrives():
    """The rod flies 20 radii; nothing is near when the step begins."""
    parameters = arm(n_elements=3, base_length=0.05, substeps=60, youngs_modulus=1e2, shear_modulus=4e1)
    state = straight_rods(parameters, 1)
    state.velocity[:, 0, 1:] = 8.0
    cylinders = cylinders_at([[0.1, -0.2, 0.05]], [[0.0, 1.0, 0.0]], [0.4], [0.01])
    couple = torch.zeros(1, 3, 3, dtype=torch.float64)
    reference = TorchBackend(parameters)
    before = reference.control_step(state, couple, cylinders=cylinders, substeps=15)
    assert_identical(before, reference.control_step(state, couple, substeps=15))
    expected = reference.control_step(state, couple, cylinders=cylinders)
    assert largest_change(expected, reference.control_step(state, couple)) > 1.0
    assert_close(CudaBackend(parameters).control_step(state, couple, cylinders=cylinders), expected, 1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_no_contact_is_missed_whatever_the_cylinders(seed):
    parameters = arm(n_elements=4, base_length=0.2, substeps=40)
    state, couple = moving(parameters), couple_like(parameters, 1, seed)
    generator = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(shape, generator=generator, dtype=torch.float64)

    where = state.position[0].mT[torch.arange(5)] + 0.06 * (draw(5, 3) - 0.5)
    cylinders = cylinders_at(where, draw(5, 3) - 0.5, 0.02 + 0.2 * draw(5), 0.002 + 0.01 * draw(5), draw(5) < 0.8)
    expected = TorchBackend(parameters).control_step(state, couple, cylinders=cylinders)
    assert (dilatation(expected.position, 20.0) < 5.0).all()
    found = CudaBackend(parameters).control_step(state, couple, cylinders=cylinders)
    assert_close(found, expected, 1e-7)


def test_bends_and_turns_beyond_the_polynomials_range_agree_with_the_reference():
    parameters, state = beyond_polynomials()
    couple = torch.zeros(1, 3, 6, dtype=torch.float64)
    found = CudaBackend(parameters).control_step(state, couple, substeps=3)
    expected = TorchBackend(parameters).control_step(state, couple, substeps=3)
    for name in FIELDS:
        assert torch.allclose(getattr(found, name), getattr(expected, name), rtol=1e-10, atol=1e-12), name


def batch():
    """Three environments; cylinders of different number touch the outer two, the rest is masked."""
    parameters = arm(substeps=6)
    state = moving(parameters, 3)
    couple, force = couple_like(parameters, 3), force_like(parameters, 3)
    first, last = beside(state[:1], [5], 0.018), beside(state[2:], [3, 6], -0.018)
    first = side_by_side(first, first)
    first.mask[:, 1] = False
    first.radius[:, 1] = 1.0
    none = first.clone()
    none.mask[:] = False
    return parameters, state, couple, force, torch.cat([first, none, last])


def test_environments_do_not_see_each_other_and_masked_cylinders_do_not_exist():
    parameters, state, couple, force, cylinders = batch()
    backend = CudaBackend(parameters)
    together = backend.control_step(state, couple, force, cylinders)
    assert_close(together, TorchBackend(parameters).control_step(state, couple, force, cylinders))
    for i in range(3):
        one = slice(i, i + 1)
        alone = backend.control_step(state[one], couple[one], force[one], cylinders[one])
        assert_identical(alone, together[one])
    only = cylinders[:1].apply(lambda values: values[:, :1])
    assert_identical(backend.control_step(state[:1], couple[:1], force[:1], only), together[:1])
    assert_identical(backend.control_step(state[1:2], couple[1:2], force[1:2]), together[1:2])


def test_inactive_rods_come_back_bit_for_bit_and_the_input_is_not_changed():
    parameters, state, couple, force, cylinders = batch()
    state.velocity[1, 0, 0] = float("nan")
    copy = state.clone()
    active = torch.tensor([True, False, True])
    after = CudaBackend(parameters).control_step(state, couple, force, cylinders, active)
    for name in FIELDS:
        assert torch.equal(getattr(state, name).view(torch.int64), getattr(copy, name).view(torch.int64))
        assert torch.equal(getattr(after[1], name).view(torch.int64), getattr(copy[1], name).view(torch.int64))
    assert largest_change(after[::2], state[::2]) > 1e-3


def test_nan_in_one_environment_leaves_the_others_identical():
    parameters, state, couple, force, cylinders = batch()
    backend = CudaBackend(parameters)
    expected = backend.control_step(state, couple, force, cylinders)
    state.position[0, :, 4] = float("nan")
    found = backend.control_step(state, couple, force, cylinders)
    assert_identical(found[1:], expected[1:])
    assert found.position[0].isnan().any()


def test_a_control_step_is_as_many_substeps_one_after_another():
    parameters = arm()
    backend, couple = CudaBackend(parameters), couple_like(parameters, 1)
    state = moving(parameters)
    assert_identical(backend.control_step(state, couple, substeps=0), state)
    pieces = state
    for substeps in (1, 4, 5):
        pieces = backend.control_step(pieces, couple, substeps=substeps)
    assert_close(pieces, backend.control_step(state, couple, substeps=10))


@pytest.mark.parametrize("protocol", DAMPING_PROTOCOLS)
def test_each_rod_of_a_batch_may_have_a_body_of_its_own(protocol):
    parameters, state, couple, force, cylinders = batch()
    parameters = replace(parameters, **FRICTION, gravity=(0.5, 0.3, -9.81), damping_protocol=protocol)
    config = RandomiseConfig("x", **dict.fromkeys(FACTORS, (0.6, 1.6)))
    drawn = draw(config, 3, torch.Generator().manual_seed(0))
    bodies = Bodies(*drawn[:, : len(Bodies._fields)].unbind(-1))
    given = (state, couple, force, cylinders)
    expected = TorchBackend(parameters).control_step(*given, bodies=bodies)
    found = CudaBackend(parameters).control_step(*given, bodies=bodies)
    assert largest_change(expected, TorchBackend(parameters).control_step(*given)) > 1e-3
    assert_close(found, expected)
    for i in range(3):
        own = bodies.arm(parameters, i)
        alone = CudaBackend(own).control_step(*(values[i : i + 1] for values in given))
        assert_close(alone, found[i : i + 1])
    single = CudaBackend(parameters).control_step(state.float(), *given[1:], bodies=bodies)
    assert single.position.dtype == torch.float32
    assert (single.position - expected.position).abs().max() < 1e-4


def test_float32_stays_float32_and_follows_float64():
    parameters, state, couple, force, cylinders = batch()
    backend = CudaBackend(parameters)
    double = backend.control_step(state, couple, force, cylinders)
    single = backend.control_step(state.float(), couple, force, cylinders)
    for name in FIELDS:
        assert getattr(single, name).dtype == torch.float32
        difference = (getattr(single, name) - getattr(double, name)).abs().max()
        assert 0.0 < difference < 1e-4 * max(1.0, getattr(double, name).abs().max().item()), name


def test_float32_directors_are_made_orthonormal_again_and_float64_ones_are_not():
    parameters, state, couple, _, _ = batch()
    state.director[..., 1:] *= 1.0 + 1e-3

    def error(after):
        director = after.director.double()
        gram = torch.einsum("bijn,bkjn->bnik", director, director)
        return (gram - torch.eye(3, dtype=torch.float64)).abs().max()

    backend = CudaBackend(parameters)
    assert error(backend.control_step(state.float(), couple)) < 5e-6
    assert error(backend.control_step(state, couple)) > 1e-3


def test_rods_too_long_for_shared_memory_meet_in_global_memory(monkeypatch):
    parameters, state, couple, force, cylinders = batch()
    expected = CudaBackend(parameters).control_step(state, couple, force, cylinders)
    monkeypatch.setattr(cuda_step, "_SHARED_BYTES", 0)
    cuda_step.make_step.cache_clear()
    try:
        assert_identical(CudaBackend(parameters).control_step(state, couple, force, cylinders), expected)
    finally:
        cuda_step.make_step.cache_clear()


def test_no_environments_are_no_error():
    parameters = arm()
    state = straight_rods(parameters, 0)
    assert len(CudaBackend(parameters).control_step(state, couple_like(parameters, 0))) == 0


@pytest.mark.parametrize("task", ["basic", "wall"])
def test_an_environment_moves_as_with_the_torch_backend(settings, task):
    parameters = RodParameters(n_elements=12, substeps=4)
    seen = {}
    for backend in ("cuda", "torch"):
        env = make_env(settings(f"task={task}").task, parameters, 2, seed=0, backend=backend)
        current = env.reset()
        for step in range(2):
            action = torch.full_like(env.rand_action(current)["agents", "action"], 0.5 + 0.1 * step)
            current = env.step(current.set(("agents", "action"), action))["next"]
        seen[backend] = current
    assert seen["torch"]["tip"].isfinite().all()
    assert (seen["torch"]["agents", "velocity"].abs() > 1e-3).any()
    for key in ("tip", ("agents", "position"), ("agents", "velocity"), "reward"):
        assert torch.allclose(seen["cuda"][key], seen["torch"][key], rtol=0.0, atol=1e-6), key
