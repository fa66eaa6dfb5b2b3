"""What the torch backend promises besides parity: gradients, a clamped base, inactive environments, no side effects."""

import math
import weakref

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from pairwise import partly
from softgm_bench.rod.actuation import Actuation
from softgm_bench.rod.contact import contact_forces, element_radius
from softgm_bench.rod.parameters import DAMPING_PROTOCOLS, RodParameters, rod_constants
from softgm_bench.rod.state import Cylinders, RodState, straight_rods
from softgm_bench.rod.torch_backend import TorchBackend, angle_over_sine, sine_and_cosine_terms

PARAMETERS = RodParameters(n_elements=5, substeps=3, gravity=(0.0, 1.0, -9.81))
FIELDS = ("position", "director", "velocity", "omega")


def random_loads(num_envs: int, seed: int = 0) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    couple = torch.randn(num_envs, 3, 5, dtype=torch.float64, generator=generator)
    force = torch.randn(num_envs, 3, 6, dtype=torch.float64, generator=generator)
    return couple, force


def crossing_post(num_envs: int, distance: float, dtype: torch.dtype = torch.float64) -> Cylinders:
    """A slanted post at this distance in x, and a parallel one on the rod's other side."""
    return Cylinders(
        start=torch.tensor([[distance, -0.3, 0.7], [-distance - 0.05, 0.0, 0.2]]).to(dtype).expand(num_envs, 2, 3),
        axis=torch.tensor([[0.0, 0.96, 0.28], [0.0, 0.0, 1.0]]).to(dtype).expand(num_envs, 2, 3),
        length=torch.tensor([0.8, 0.5]).to(dtype).expand(num_envs, 2),
        radius=torch.tensor([0.05, 0.05]).to(dtype).expand(num_envs, 2),
        mask=torch.ones(num_envs, 2, dtype=torch.bool),
        batch_size=[num_envs],
    )


def moving_state(num_envs: int = 1, seed: int = 0) -> RodState:
    """Bent, twisted and in motion."""
    couple, force = random_loads(num_envs, seed)
    return TorchBackend(PARAMETERS).control_step(straight_rods(PARAMETERS, num_envs), couple, force, substeps=200)


def assert_identical(actual: RodState, expected: RodState) -> None:
    for name in FIELDS:
        torch.testing.assert_close(
            getattr(actual, name), getattr(expected, name), rtol=0.0, atol=0.0, equal_nan=True, msg=name
        )


def stacked(state: RodState) -> Tensor:
    return torch.cat([getattr(state, name).flatten() for name in FIELDS])


def check_gradients(backend: TorchBackend, state: RodState, cylinders: Cylinders | None) -> None:
    couple, force = random_loads(1, seed=1)
    inputs = [couple, force, *(getattr(state, name).detach().clone() for name in FIELDS)]

    def advance(couple: Tensor, force: Tensor, *motion: Tensor) -> Tensor:
        before = RodState(*motion, batch_size=[1])
        return stacked(backend.control_step(before, couple, force, cylinders))

    assert torch.autograd.gradcheck(advance, [x.requires_grad_() for x in inputs], eps=1e-6, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("protocol", partly(DAMPING_PROTOCOLS, ["damping_constant"]))
def test_gradients_of_a_moving_rod_equal_finite_differences(protocol: str):
    parameters = RodParameters(n_elements=5, substeps=3, damping_protocol=protocol)
    check_gradients(TorchBackend(parameters), moving_state(), None)


def test_gradients_of_a_rod_in_contact_equal_finite_differences():
    parameters = RodParameters(n_elements=5, substeps=3, friction_coefficient=0.3, velocity_damping_coefficient=10.0)
    state, cylinders = moving_state(), crossing_post(1, 0.06)
    radius = element_radius(state.position, torch.as_tensor(rod_constants(parameters).volume))
    assert contact_forces(state.position, state.velocity, radius, cylinders, parameters).abs().max() > 10.0
    check_gradients(TorchBackend(parameters), state, cylinders)


@pytest.mark.parametrize("cylinders", [None, crossing_post(1, 0.3)], ids=["alone", "beside parallel post"])
def test_gradients_of_a_straight_rod_at_rest_equal_finite_differences(cylinders: Cylinders | None):
    check_gradients(TorchBackend(PARAMETERS), straight_rods(PARAMETERS, 1), cylinders)


def test_gradient_through_a_whole_control_step_from_rest_is_finite_and_not_zero():
    backend, state = TorchBackend(RodParameters(n_elements=20)), straight_rods(RodParameters(n_elements=20), 1)
    couple = torch.zeros(1, 3, 20, dtype=torch.float64, requires_grad=True)
    tip = backend.control_step(state, couple).position[0, :, -1]
    # d1 = +y: a couple about it moves the tip to +x; one about d2 = -x to +y.
    for component, axis in ((0, 0), (1, 1)):
        (gradient,) = torch.autograd.grad(tip[component], couple, retain_graph=True)
        assert gradient.isfinite().all()
        assert gradient[0, axis].sum() > 0.0


@pytest.mark.parametrize("every", [1, 4, 100])
@pytest.mark.parametrize("model", ["pyelastica", "exact"])
def test_checkpointed_motion_has_the_same_bits_and_gradients_for_every_input(every: int, model: str):
    parameters = RodParameters(n_elements=5, contact_model=model, friction_coefficient=0.3, dt=1e-4)
    state, cylinders, loads = moving_state(), crossing_post(1, 0.06), random_loads(1, seed=1)
    results = []
    for backend in (TorchBackend(parameters), TorchBackend(parameters, checkpoint_every=every)):
        inputs = [getattr(state, name).detach().clone().requires_grad_() for name in FIELDS]
        inputs += [x.clone().requires_grad_() for x in loads]
        inputs += [x.clone().requires_grad_() for x in (cylinders.start, cylinders.length, cylinders.radius)]
        posts = cylinders.replace(start=inputs[-3], length=inputs[-2], radius=inputs[-1])
        motion = backend.control_step(RodState(*inputs[:4], batch_size=[1]), inputs[4], inputs[5], posts, substeps=10)
        weights = torch.linspace(-1.0, 2.0, stacked(motion).numel(), dtype=torch.float64)
        results.append((motion.detach(), torch.autograd.grad((stacked(motion) * weights).sum(), inputs)))
    (plain, expected), (checkpointed, actual) = results
    assert_identical(checkpointed, plain)
    assert expected[-1].abs().max() > 0.0
    for x, y in zip(actual, expected, strict=True):
        torch.testing.assert_close(x, y, rtol=1e-11, atol=1e-12 * y.abs().max().item())


def test_checkpointed_gradient_needs_only_what_some_input_needs():
    backend, state, (couple, _) = TorchBackend(PARAMETERS, checkpoint_every=2), moving_state(2), random_loads(2)
    couple.requires_grad_()
    after = backend.control_step(state, couple, active=torch.tensor([False, True]))
    after.omega.sum().backward()
    assert (couple.grad[0] == 0.0).all()
    assert (couple.grad[1] != 0.0).any()
    assert not backend.control_step(state, couple.detach()).position.requires_grad


def saved_bytes(every: int | None, substeps: int) -> int:
    """What a graph over these substeps keeps for its backward pass."""
    total = 0

    def count(x: Tensor) -> Tensor:
        nonlocal total
        total += x.nbytes
        return x

    couple = random_loads(1)[0].requires_grad_()
    with torch.autograd.graph.saved_tensors_hooks(count, lambda x: x):
        TorchBackend(PARAMETERS, every).control_step(straight_rods(PARAMETERS, 1), couple, substeps=substeps)
    return total


def test_checkpointed_graph_keeps_the_inputs_of_each_segment_and_nothing_else():
    state, (couple, force) = straight_rods(PARAMETERS, 1), random_loads(1)
    inputs = sum(x.nbytes for x in (*(getattr(state, name) for name in FIELDS), couple, force[0]))
    assert saved_bytes(10, 20) == 2 * inputs
    assert saved_bytes(10, 80) == 8 * inputs
    assert saved_bytes(20, 80) == 4 * inputs
    assert saved_bytes(None, 80) > 100 * saved_bytes(20, 80)


class PeakMemory(TorchDispatchMode):
    """The largest number of bytes of tensors alive at once, of those made inside."""

    def __init__(self) -> None:
        super().__init__()
        self.peak, self._live, self._known = 0, 0, set()

    def _forget(self, key: int, size: int) -> None:
        self._live -= size
        self._known.discard(key)

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        result = function(*args, **(kwargs or {}))
        for x in result if isinstance(result, tuple | list) else (result,):
            if isinstance(x, Tensor) and (key := x.untyped_storage()._cdata) not in self._known:
                storage = x.untyped_storage()
                self._known.add(key)
                self._live += storage.nbytes()
                weakref.finalize(storage, self._forget, key, storage.nbytes())
        self.peak = max(self.peak, self._live)
        return result


def peak_of_gradient(every: int | None, substeps: int) -> int:
    """Bytes at the worst moment of the forward and backward pass."""
    couple = random_loads(1)[0].requires_grad_()
    with PeakMemory() as memory:
        after = TorchBackend(PARAMETERS, every).control_step(straight_rods(PARAMETERS, 1), couple, substeps=substeps)
        after.position.sum().backward()
    return memory.peak


@pytest.mark.slow
def test_peak_memory_of_a_checkpointed_gradient_grows_by_segments_and_by_the_length_of_one():
    state = straight_rods(PARAMETERS, 1)
    one_state = sum(getattr(state, name).nbytes for name in FIELDS)
    peak = {key: peak_of_gradient(*key) for key in ((None, 20), (None, 80), (10, 20), (10, 80), (20, 80))}
    a_substep = (peak[None, 80] - peak[None, 20]) / 60.0
    assert peak[10, 80] - peak[10, 20] < 2 * 6 * one_state  # six more segments
    assert peak[20, 80] - peak[10, 80] < 11 * a_substep  # ten more substeps a segment
    assert peak[10, 80] < 0.25 * peak[None, 80]


def test_segment_without_substeps_is_refused():
    with pytest.raises(ValueError, match="checkpoint_every is 0"):
        TorchBackend(PARAMETERS, checkpoint_every=0)


@pytest.mark.parametrize("model", ["pyelastica", "exact"])
def test_gradient_through_a_sequence_of_actions_and_a_contact_equals_a_finite_difference(model: str):
    parameters = RodParameters(n_elements=8, substeps=30, contact_model=model)
    backend, actuation = TorchBackend(parameters, checkpoint_every=10), Actuation(parameters, 3, 25.0)
    post = crossing_post(1, 0.098)  # pressed by 2 mm at rest
    generator = torch.Generator().manual_seed(3)
    actions = torch.rand(4, 1, 3, 2, dtype=torch.float64, generator=generator)

    def final(actions: Tensor, cylinders: Cylinders | None = post) -> RodState:
        state = straight_rods(parameters, 1)
        for action in actions:
            state = backend.control_step(state, actuation.couple(action), cylinders=cylinders)
        return state

    actions.requires_grad_()
    reached = final(actions)
    assert not torch.equal(reached.position, final(actions.detach(), None).position)
    (gradient,) = torch.autograd.grad(reached.position[0, :, -1].sum(), actions)
    direction = torch.randn(actions.shape, dtype=torch.float64, generator=generator)
    ahead, behind = (final(actions.detach() + sign * 1e-6 * direction) for sign in (1.0, -1.0))
    difference = (ahead.position[0, :, -1] - behind.position[0, :, -1]).sum().item() / 2e-6
    assert (gradient * direction).sum().item() == pytest.approx(difference, rel=1e-5)


@pytest.mark.parametrize("with_post", [False, True])
def test_base_is_clamped_from_any_state_under_any_load(with_post: bool):
    state, constants = moving_state(2), rod_constants(PARAMETERS)
    state.position = state.position + 0.1
    state.velocity = state.velocity + 1.0
    state.omega = state.omega + 1.0
    after = TorchBackend(PARAMETERS).control_step(
        state, *random_loads(2), crossing_post(2, 0.06) if with_post else None
    )
    for i in range(2):
        assert torch.equal(after.position[i, :, 0], torch.as_tensor(constants.position[:, 0]))
        assert torch.equal(after.director[i, ..., 0], torch.as_tensor(constants.director[..., 0]))
    assert (after.velocity[..., 0] == 0.0).all()
    assert (after.omega[..., 0] == 0.0).all()


def test_straight_rod_without_loads_stays_at_rest():
    parameters = RodParameters()
    state = straight_rods(parameters, 1)
    after = TorchBackend(parameters).control_step(state, torch.zeros(1, 3, 60, dtype=torch.float64))
    torch.testing.assert_close(after.position, state.position, rtol=0.0, atol=1e-12)
    torch.testing.assert_close(after.director, state.director, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("active", [(True, False, True), (False, False, False), (True, True, True)])
@pytest.mark.parametrize("loaded", [False, True])
def test_inactive_environments_are_unchanged_and_active_ones_move_as_always(active: tuple, loaded: bool):
    backend, state = TorchBackend(PARAMETERS), moving_state(3)
    couple, force = random_loads(3)
    loads = (couple, force, crossing_post(3, 0.06)) if loaded else (couple,)
    moved = backend.control_step(state, *loads)
    after = backend.control_step(state, *loads, active=torch.tensor(active))
    for i, is_active in enumerate(active):
        assert_identical(after[i], moved[i] if is_active else state[i])
    assert not torch.equal(moved.position, state.position)


def test_nan_in_an_inactive_environment_comes_back_and_reaches_no_gradient():
    backend, state = TorchBackend(PARAMETERS), moving_state(2)
    state.position[0] = float("nan")
    couple, force = random_loads(2)
    couple.requires_grad_()
    after = backend.control_step(state, couple, force, active=torch.tensor([False, True]))
    assert_identical(after[0].detach(), state[0])
    after.position[1].sum().backward()
    assert couple.grad.isfinite().all()
    assert (couple.grad[1] != 0.0).any()


@pytest.mark.parametrize("active", [None, (True, False), (False, False)])
def test_input_is_never_mutated_nor_shared_with_the_result(active: tuple | None):
    state, cylinders = moving_state(2), crossing_post(2, 0.06)
    couple, force = random_loads(2)
    inputs = [*(getattr(state, name) for name in FIELDS), couple, force]
    copies = [x.clone() for x in inputs]
    mask = None if active is None else torch.tensor(active)
    after = TorchBackend(PARAMETERS).control_step(state, couple, force, cylinders, mask)
    for name in FIELDS:
        getattr(after, name).fill_(7.0)
    for x, copy in zip(inputs, copies, strict=True):
        assert torch.equal(x, copy)


def test_control_steps_add_up():
    backend, state = TorchBackend(PARAMETERS), moving_state()
    loads = random_loads(1)
    twice = backend.control_step(backend.control_step(state, *loads, substeps=2), *loads, substeps=5)
    assert_identical(twice, backend.control_step(state, *loads, substeps=7))


def test_substeps_default_to_the_parameters():
    backend, state, (couple, _) = TorchBackend(PARAMETERS), moving_state(), random_loads(1)
    assert_identical(backend.control_step(state, couple), backend.control_step(state, couple, substeps=3))


def test_gravity_is_a_force_of_mass_times_gravity():
    weightless = RodParameters(n_elements=5, substeps=3)
    weight = torch.tensor(PARAMETERS.gravity, dtype=torch.float64)[:, None] * torch.as_tensor(
        rod_constants(PARAMETERS).mass
    )
    state, (couple, force) = moving_state(), random_loads(1)
    assert_identical(
        TorchBackend(PARAMETERS).control_step(state, couple, force),
        TorchBackend(weightless).control_step(state, couple, weight + force),
    )


def test_float32_state_stays_float32_and_near_float64():
    state, (couple, force) = moving_state(), random_loads(1)
    exact = TorchBackend(PARAMETERS).control_step(state, couple, force, crossing_post(1, 0.06), substeps=50)
    single = TorchBackend(PARAMETERS).control_step(
        state.float(), couple.float(), force.float(), crossing_post(1, 0.06, torch.float32), substeps=50
    )
    assert single.position.dtype == torch.float32
    torch.testing.assert_close(single.position.double(), exact.position, rtol=0.0, atol=1e-5)


@pytest.mark.parametrize("name", ["couple", "force"])
def test_load_of_the_wrong_shape_is_refused_by_name(name: str):
    state, (couple, force) = moving_state(2), random_loads(2)
    loads = {"couple": couple, "force": force}
    loads[name] = loads[name][:1]
    with pytest.raises(ValueError, match=f"{name} has shape"):
        TorchBackend(PARAMETERS).control_step(state, **loads)


@given(x=st.floats(0.0, 3.0))
def test_sine_and_cosine_terms_equal_their_formulas_to_round_off(x: float):
    sine, cosine = sine_and_cosine_terms(torch.tensor(x * x, dtype=torch.float64))
    half = math.sin(x / 2.0) / (x / 2.0) if x > 1e-8 else 1.0
    assert sine.item() == pytest.approx(math.sin(x) / x if x > 1e-8 else 1.0, abs=4e-16)
    assert cosine.item() == pytest.approx(0.5 * half * half, abs=3e-15)


@given(theta=st.floats(0.0, 3.0))
def test_angle_over_sine_equals_its_formula_to_round_off(theta: float):
    actual = angle_over_sine(torch.tensor(math.sin(theta / 2.0) ** 2, dtype=torch.float64)).item()
    expected = theta / math.sin(theta) if theta > 1e-8 else 1.0
    assert actual == pytest.approx(expected, rel=5e-16 if theta < 0.29 else 1e-13)


def test_angle_over_sine_is_finite_with_finite_gradient_at_both_ends():
    half_versine = torch.tensor([0.0, 1.0], dtype=torch.float64, requires_grad=True)
    value = angle_over_sine(half_versine)
    value.sum().backward()
    assert value.isfinite().all()
    assert half_versine.grad.isfinite().all()
    assert half_versine.grad[0].item() == pytest.approx(2.0 / 3.0, rel=1e-15)
