"""PyElastica as a backend: what it computes undisturbed, to the bit; what the fused kernel computes, to rounding."""

import sys
from dataclasses import replace
from functools import partial

import elastica.contact_forces
import numpy as np
import pytest
import torch
from parity_cases import CASES, LEANING_POST, ONE_POST, QUANTITIES, TWO_POSTS, Case, our_trajectories

from softgm_bench.errors import UserError
from softgm_bench.rod import pyelastica_oracle
from softgm_bench.rod.backend import check_backend, make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.pyelastica_backend import PyElasticaBackend
from softgm_bench.rod.pyelastica_oracle import as_cylinders, posts_of, simulate
from softgm_bench.rod.state import Cylinders, RodState, straight_rods

pytestmark = pytest.mark.usefixtures("one_thread")

SMALL = RodParameters(n_elements=20, substeps=20)


def leaning(parameters: RodParameters, num_envs: int, step: int) -> torch.Tensor:
    """Couples towards +x, N m, of another strength in every environment."""
    couple = torch.zeros((num_envs, 3, parameters.n_elements), dtype=torch.float64)
    strength = 14.0 + torch.arange(num_envs) + torch.tensor(float(step)).sin()
    couple[:, 0] = strength.unsqueeze(-1) / parameters.n_elements
    return couple


def pushed(parameters: RodParameters, num_envs: int) -> torch.Tensor:
    """5 N on the tips, along +y."""
    force = torch.zeros((num_envs, 3, parameters.n_nodes), dtype=torch.float64)
    force[:, 1, -1] = 5.0
    return force


def difference(one: RodState, other: RodState) -> dict[str, float]:
    return {name: float((getattr(one, name) - getattr(other, name)).abs().max()) for name in QUANTITIES}


FRICTION = replace(SMALL, friction_coefficient=0.3, velocity_damping_coefficient=10.0, gravity=(0.0, 0.0, -1.0))


@pytest.mark.parametrize("pruning", [False, True])
def test_a_step_from_a_given_state_is_pyelasticas_own_next_one_to_the_bit(pruning: bool):
    """Undisturbed, PyElastica never leaves its own memory: what it keeps beside the four quantities would show."""
    case = Case(0.2, FRICTION, seed=10, peak=5.0, push=(20.0, 2.0), posts=LEANING_POST, tip_force=(1.0, 3.0, -2.0))
    theirs = simulate(FRICTION, case.couple(), case.steps, case.posts, lambda step: case.force, pruning)
    rod, state = PyElasticaBackend(FRICTION, pruning), straight_rods(FRICTION, 1)
    cylinders, force = as_cylinders([case.posts]), torch.as_tensor(case.force)[None]
    couple, largest = case.couple(), []
    for step in range(case.steps):
        state = rod.control_step(state, torch.as_tensor(couple(step))[None], force, cylinders)
        largest.append(float(rod.contact_force))
        for name in QUANTITIES:
            np.testing.assert_array_equal(getattr(state, name)[0].numpy(), getattr(theirs, name)[step])
    assert max(largest) > 10.0
    assert largest == theirs.contact_force.tolist()
    assert rod.missed == theirs.missed


def test_environments_among_different_cylinders_move_as_the_fused_kernel_has_it_resets_included():
    """Environment 1 begins anew among other cylinders, environment 2 rests, then goes on."""
    parameters = RodParameters()
    posts = [ONE_POST, TWO_POSTS, (), ONE_POST]
    force, largest = pushed(parameters, 4), torch.zeros(4, dtype=torch.float64)
    ours, theirs = make_backend("numba", parameters), PyElasticaBackend(parameters)
    expected = found = straight_rods(parameters, 4)
    for step in range(12):
        active = torch.tensor([True, True, not 3 <= step < 6, True])
        if step == 8:
            assert largest[1] > 10.0  # it has touched what it stood among
            posts[1] = LEANING_POST
            for state in (expected, found):
                state[1] = straight_rods(parameters, 1)[0]
        cylinders, couple = as_cylinders(posts), leaning(parameters, 4, step)
        expected = ours.control_step(expected, couple, force, cylinders, active)
        found = theirs.control_step(found, couple, force, cylinders, active)
        largest = torch.maximum(largest, theirs.contact_force)
        bounds = dict(zip(QUANTITIES, (1e-11, 1e-11, 1e-8, 1e-8), strict=True))  # as in test_parity
        differences = difference(expected, found)
        assert all(differences[name] < bound for name, bound in bounds.items()), (step, differences)
    assert (largest > 10.0).tolist() == [True, True, False, True]


def test_a_rod_that_is_not_active_rests_and_its_state_is_not_looked_at():
    rod, state = PyElasticaBackend(SMALL), straight_rods(SMALL, 3)
    state.velocity[1] = torch.nan
    before = state.clone()
    moved = rod.control_step(state, leaning(SMALL, 3, 0), active=torch.tensor([True, False, True]))
    for name in QUANTITIES:
        kept, given, original = (getattr(one, name).numpy() for one in (moved, state, before))
        np.testing.assert_array_equal(given, original)  # a new state, not the old one changed
        np.testing.assert_array_equal(kept[1], original[1])
        assert np.isfinite(kept[[0, 2]]).all()
        assert not np.array_equal(kept[[0, 2]], original[[0, 2]])


def test_company_and_order_change_no_bit():
    state, couple = straight_rods(SMALL, 3), leaning(SMALL, 3, 0)
    posts = [ONE_POST, (), ONE_POST]
    together = PyElasticaBackend(SMALL).control_step(state, couple, cylinders=as_cylinders(posts))
    backwards = PyElasticaBackend(SMALL).control_step(state, couple.flip(0), cylinders=as_cylinders(posts[::-1]))
    for name in QUANTITIES:
        assert torch.equal(getattr(together, name), getattr(backwards, name).flip(0))


def test_substeps_of_a_step_can_be_given():
    state, couple = straight_rods(SMALL, 1), leaning(SMALL, 1, 0)
    whole = PyElasticaBackend(SMALL).control_step(state, couple)
    rod = PyElasticaBackend(SMALL)
    parts = rod.control_step(rod.control_step(state, couple, substeps=5), couple, substeps=15)
    assert torch.equal(whole.position, parts.position)


def test_only_simulators_of_cylinders_that_are_there_are_kept():
    rod, state = PyElasticaBackend(SMALL), straight_rods(SMALL, 2)
    for number in range(3):
        post = ONE_POST[0]._replace(radius=0.01 + 0.01 * number)
        rod.control_step(state, leaning(SMALL, 2, 0), cylinders=as_cylinders([(post,), ()]), substeps=1)
        assert len(rod._arms) == 2


@pytest.mark.parametrize("name", ["leaning post", "slanted post, its end", "two oblique ends, friction"])
def test_skipping_what_is_out_of_reach_changes_no_bit(monkeypatch: pytest.MonkeyPatch, name: str):
    case = CASES[name]
    run = partial(simulate, case.parameters, case.couple(), case.steps, case.posts)
    quick = run()
    tried = []
    monkeypatch.setattr(pyelastica_oracle, "_out_of_reach", lambda *arguments: tried.append(arguments) or False)
    whole = run()
    assert tried
    for quantity in QUANTITIES:
        np.testing.assert_array_equal(getattr(quick, quantity), getattr(whole, quantity))
    assert (quick.missed, quick.contact_force.tolist()) == (whole.missed, whole.contact_force.tolist())


def test_posts_are_the_cylinders_that_exist():
    cylinders: Cylinders = as_cylinders([TWO_POSTS, ()])
    assert posts_of(cylinders, 0) == TWO_POSTS
    assert posts_of(cylinders, 1) == ()


def test_pyelastica_is_as_it_is_shipped_afterwards():
    module = elastica.contact_forces
    before = module._prune_using_aabbs_rod_cylinder, module._calculate_contact_forces_rod_cylinder
    PyElasticaBackend(SMALL).control_step(straight_rods(SMALL, 1), leaning(SMALL, 1, 0), substeps=1)
    assert before == (module._prune_using_aabbs_rod_cylinder, module._calculate_contact_forces_rod_cylinder)


def test_what_pyelastica_cannot_do_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch):
    with pytest.raises(UserError, match=r"^rod\.contact_model=exact with backend=pyelastica: [^\n]+$"):
        make_backend("pyelastica", RodParameters(contact_model="exact"))
    single = straight_rods(SMALL, 1, torch.float32)
    with pytest.raises(ValueError, match="float64 on the CPU"):
        make_backend("pyelastica", SMALL).control_step(single, leaning(SMALL, 1, 0))
    with pytest.raises(ValueError, match="choose backend=torch"):
        make_backend("pyelastica", SMALL).control_step(
            straight_rods(SMALL, 1), leaning(SMALL, 1, 0).requires_grad_(True)
        )
    with pytest.raises(ValueError, match=r"^backend=pyelastica has no dtype=float32: add dtype=float64$"):
        check_backend("pyelastica", "cpu", "float32")
    monkeypatch.delitem(sys.modules, "softgm_bench.rod.pyelastica_oracle")
    monkeypatch.setitem(sys.modules, "elastica", None)
    with pytest.raises(UserError, match=r"^backend=pyelastica needs PyElastica: pip install '\.\[pyelastica\]'$"):
        make_backend("pyelastica", SMALL)


@pytest.mark.slow
def test_the_backend_is_the_oracle_in_every_case_of_the_parity_table():
    for name, case in CASES.items():
        force = None if case.force is None else lambda step, case=case: case.force
        theirs = simulate(case.parameters, case.couple(), case.steps, case.posts, force, post_velocity=case.velocity())
        ours = our_trajectories("pyelastica", {name: case})[name]
        for quantity in QUANTITIES:
            np.testing.assert_array_equal(ours[quantity], getattr(theirs, quantity), err_msg=f"{name}: {quantity}")
