import pytest
import torch

from softgm_bench.envs import entries
from softgm_bench.envs.reward import reward_terms
from softgm_bench.envs.tasks.base import RewardConfig

CONFIG = RewardConfig(
    lambda_p=10.0,
    lambda_da=0.05,
    lambda_t=0.05,
    lambda_c=-0.01,
    lambda_cn=-0.001,
    lambda_d=0.05,
    k_max=5,
    lambda_s=0.05,
    epsilon=1e-4,
    lambda_succ=50.0,
    lambda_fail=0.0,
)


def terms(**changes):
    values = {
        "distance": 0.40,
        "previous_distance": 0.43,
        "action": [[1.0, -0.5], [0.0, 0.25], [-1.0, 1.0]],
        "previous_action": [[0.5, -0.5], [0.0, 0.0], [1.0, 0.0]],
        "contact_nodes": 3,
        "new_bins": 7,
        "success": False,
    } | changes
    tensors = {name: torch.tensor([value]) for name, value in values.items()}
    tensors["distance"] = tensors["distance"].double()
    tensors["previous_distance"] = tensors["previous_distance"].double()
    return {name: value.item() for name, value in reward_terms(CONFIG, **tensors).items()}


def test_every_term_of_the_papers_formula_worked_out_by_hand():
    found = terms()
    # squared changes: 0.25 + 0 + 0 + 0.0625 + 4 + 1 = 5.3125 over 3 agents and 2 directions
    assert found == pytest.approx(
        {
            "distance": -0.40,
            "progress": 0.3,
            "smoothness": -0.05 * 5.3125 / 6,
            "time": -0.05,
            "collision": -0.01 - 0.003,
            "discovery": 0.25,
            "stuck": 0.0,
            "success": 0.0,
        }
    )
    assert tuple(found) == entries.REWARD_TERM_NAMES


def test_no_contact_costs_nothing_and_cannot_be_stuck():
    found = terms(contact_nodes=0, previous_distance=0.40)
    assert found["collision"] == 0.0
    assert found["stuck"] == 0.0


@pytest.mark.parametrize(("gain", "stuck"), [(0.9e-4, -0.05), (-0.9e-4, -0.05), (1.1e-4, 0.0), (-1.1e-4, 0.0)])
def test_stuck_needs_contact_and_a_distance_that_stands_still(gain, stuck):
    assert terms(previous_distance=0.40 + gain)["stuck"] == pytest.approx(stuck)


def test_discoveries_are_rewarded_one_by_one_up_to_the_cap():
    assert [terms(new_bins=n)["discovery"] for n in (0, 1, 5, 6)] == pytest.approx([0.0, 0.05, 0.25, 0.25])


def test_success_pays_once_it_is_true():
    assert terms(success=True)["success"] == 50.0


def test_a_step_in_which_an_obstacle_pushes_costs_as_contact_does():
    """Where pushes are counted, no node need touch at the step's end."""
    unseen = terms(contact_nodes=0, pushed=True, previous_distance=0.40)
    assert unseen["collision"] == pytest.approx(-0.01)
    assert unseen["stuck"] == pytest.approx(-0.05)
    assert terms(pushed=True) == terms(pushed=False) == terms()
