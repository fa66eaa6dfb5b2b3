"""The limit that is refused at is the integrator's."""

from dataclasses import replace

import pytest
import torch

from softgm_bench.rod.actuation import Actuation
from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.divergence import diverged
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.stability import MARGIN, check_time_step, longest_time_step
from softgm_bench.rod.state import straight_rods

ARM = RodParameters(n_elements=20)
ARMS = {
    "the paper's": ARM,
    "stiff": replace(ARM, youngs_modulus=5e6, shear_modulus=2e6),
    "stiff in shear": replace(ARM, shear_modulus=2e6),
    "light": replace(ARM, density=100.0),
    "short": replace(ARM, base_length=0.4),
    "thin": replace(ARM, base_radius=0.02),
    "undamped": replace(ARM, damping_constant=0.0),
}


def torn(parameters, steps=3):
    """Whether random torques, as strong for this arm as the task's are for the paper's, tear any of 8 arms apart."""
    backend, state = make_backend("numba", parameters), straight_rods(parameters, 8)
    strong = 25.0 * parameters.youngs_modulus / 5e5 * (parameters.base_radius / 0.05) ** 4 / parameters.base_length
    actuation = Actuation(
        parameters, 6, strong, "interpolating", "per_length", device=torch.device("cpu"), dtype=torch.float64
    )
    generator = torch.Generator().manual_seed(0)
    for _ in range(steps):
        action = 2.0 * torch.rand(8, 6, 2, generator=generator) - 1.0
        state = backend.control_step(state, actuation.couple(action))
    return bool(diverged(state, torch.as_tensor(rod_constants(parameters).rest_length), 0.2, 5.0).any())


def at(arm, share):
    dt = share * longest_time_step(arm)
    return replace(arm, dt=dt, substeps=max(1, round(0.04 / dt)))


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_what_is_admitted_holds_and_what_tears_apart_is_refused(arm):
    assert not torn(at(arm, 0.99 * MARGIN))
    check_time_step(at(arm, 0.99 * MARGIN))
    assert torn(at(arm, 1.05))
    with pytest.raises(ValueError, match=r"rod\.dt="):
        check_time_step(at(arm, 1.05))


@pytest.mark.parametrize("arm", ARMS.values(), ids=ARMS)
def test_the_limit_of_fine_elements_is_the_time_that_sound_takes_through_one(arm):
    fine = replace(arm, n_elements=2000)
    stiffest = max(fine.youngs_modulus, 27.0 / 28.0 * fine.shear_modulus)
    by_hand = fine.base_length / 2000 * (fine.density / stiffest) ** 0.5
    assert longest_time_step(fine) == pytest.approx(by_hand, rel=2e-2)


def test_the_step_that_is_advised_is_admitted_and_keeps_the_control_step():
    arm = RodParameters(n_elements=120)
    with pytest.raises(ValueError, match=r"stable up to 0\.000\d+ s; give rod\.dt=\S+ rod\.substeps=\d+$") as caught:
        check_time_step(arm)
    words = dict(word.split("=") for word in str(caught.value).split() if word.startswith("rod.") and "=" in word)
    advised = replace(arm, dt=float(words["rod.dt"]), substeps=int(words["rod.substeps"]))
    check_time_step(advised)
    assert advised.control_dt == pytest.approx(arm.control_dt, rel=1e-5)
