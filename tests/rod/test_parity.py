"""Trajectories of both CPU backends against PyElastica; ``make parity`` prints the differences."""

from functools import cache

import numpy as np
import pytest
import torch
from parity_cases import (
    CASES,
    CPU_BACKENDS,
    QUANTITIES,
    largest_difference,
    our_trajectories,
    pyelastica_trajectory,
    together,
)

from pairwise import tiered
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.pyelastica_oracle import Array, History, simulate

TOUCHING = [name for name, case in CASES.items() if case.posts]
MOVING = [name for name, case in CASES.items() if case.moves]
# Measured: positions to 6e-14 m at worst; the stiffness amplifies the round-off of the rates.
BOUNDS = dict(zip(QUANTITIES, (1e-11, 1e-11, 1e-8, 1e-8), strict=True))


@cache
def oracle(name: str) -> History:
    return pyelastica_trajectory(CASES[name])


@cache
def batch(backend: str, group: int) -> dict[str, dict[str, Array]]:
    torch.set_num_threads(1)
    return our_trajectories(backend, list(together(CASES))[group])


# The quick tier has all that the kernel does with one number of elements, and one case, free and then touching, of the
# backend that takes its time; tests of the kernel compare the two.
SLOW = {"torch": set(CASES) - {"wall, friction"}, "numba": {"11 elements", "100 elements"}}
EVERY = [tiered(backend, name, quick=name not in SLOW[backend]) for backend in CPU_BACKENDS for name in CASES]


@pytest.mark.parametrize(("backend", "name"), EVERY)
def test_trajectory_equals_pyelastica(backend: str, name: str):
    group = next(i for i, cases in enumerate(together(CASES)) if name in cases)
    ours = batch(backend, group)[name]
    differences = {quantity: largest_difference(ours, oracle(name), quantity) for quantity in QUANTITIES}
    assert all(differences[quantity] < bound for quantity, bound in BOUNDS.items()), differences


@pytest.mark.parametrize("name", TOUCHING)
def test_contact_cases_do_touch(name: str):
    assert oracle(name).contact_force.max() > 10.0


@pytest.mark.parametrize("name", MOVING)
def test_cases_move_the_tip(name: str):
    tip = oracle(name).position[:, :, -1]
    assert np.ptp(tip, axis=0).max() > 0.05


def test_unloaded_arm_stays_at_rest():
    states = oracle("no load")
    assert np.abs(states.position - states.position[0]).max() < 1e-14
    assert not states.omega.any()


@pytest.mark.parametrize("name", ["wall, friction", "slanted post, friction", "two oblique ends, friction"])
def test_friction_cases_differ_from_the_same_cases_without_friction(name: str):
    case = CASES[name]
    smooth = simulate(RodParameters(), case.couple(), case.steps, case.posts)
    assert np.abs(smooth.position - oracle(name).position).max() > 1e-3


@pytest.mark.parametrize("name", TOUCHING)
def test_pyelasticas_pruning_misses_contacts_of_the_leaning_post_alone(name: str):
    assert (oracle(name).missed > 0) == (name == "leaning post")
