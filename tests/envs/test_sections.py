"""What an arm of another number of sections or elements senses and is paid, as the page of the environment says it."""

import math
from dataclasses import replace

import pytest
import torch
from hypothesis import given, strategies
from hypothesis import settings as examples

from softgm_bench.envs import entries, make_env
from softgm_bench.envs.sensing import Bins, sense

pytestmark = pytest.mark.usefixtures("one_thread")
NODES = {4: 60, 6: 70, 9: 60, 12: 65}  # elements with which every section has a node at its control point


def arm(settings, n_agents, **rod):
    """One arm at rest."""
    config = settings("task=basic")
    return make_env(replace(config.task, n_agents=n_agents), replace(config.rod, **rod), num_envs=1, seed=0)


@examples(deadline=None, max_examples=25)
@given(strategies.integers(1, 15), strategies.integers(16, 90), strategies.floats(0.5, 1.5))
def test_a_section_sits_within_half_an_element_of_its_control_point_and_no_two_together(
    settings, n_agents, n_elements, length
):
    position = arm(settings, n_agents, n_elements=n_elements, base_length=length).reset()[entries.AGENT_POSITION]
    height = position[0, :, 2].double()
    control_points = length * torch.arange(1, n_agents + 1) / (n_agents + 1)
    assert ((height - control_points).abs() <= 0.5 * length / n_elements + 1e-6).all()
    assert len(height.unique()) == n_agents
    assert 0.0 < height.min() <= height.max() < length


def sensed_at(position, place, radius):
    """Whether any agent senses a bin without a radius of its own."""
    descriptor = torch.zeros(1, 1, 9, dtype=torch.float64)
    descriptor[0, 0, :3] = torch.tensor(place)
    bins = Bins(descriptor=descriptor, mask=torch.ones(1, 1, dtype=torch.bool), batch_size=[1])
    return bool(sense(position, bins, radius).any())


@pytest.mark.parametrize("n_agents", NODES)
def test_the_arm_senses_as_far_before_its_tip_and_beside_its_gaps_as_the_page_says(settings, n_agents):
    radius, gap = 0.15, 1.0 / (n_agents + 1)
    position = arm(settings, n_agents, n_elements=NODES[n_agents]).reset()[entries.AGENT_POSITION].double()
    ahead = radius - gap
    assert sensed_at(position, (0.0, 0.0, 1.0 + ahead - 1e-4), radius)
    assert not sensed_at(position, (0.0, 0.0, 1.0 + ahead + 1e-4), radius)
    beside = math.sqrt(radius**2 - (0.5 * gap) ** 2)
    assert sensed_at(position, (beside - 1e-4, 0.0, 1.5 * gap), radius)
    assert not sensed_at(position, (beside + 1e-4, 0.0, 1.5 * gap), radius)
    assert (ahead < 0.0) == (n_agents == 4)  # the page: an arm of four has a tip that feels nothing


@pytest.mark.parametrize("n_agents", [4, 9])
def test_limits_of_both_torques_and_the_smoothness_of_one_action_are_those_of_the_page(settings, n_agents):
    env = arm(settings, n_agents, n_elements=20)
    frame = env.reset().set(entries.ACTION, torch.ones(1, n_agents, 2))
    info = env.step(frame)["next"]
    assert info[entries.TORQUE_PER_AGENT].item() == pytest.approx(25.0 * math.sqrt(2.0), rel=1e-6)
    assert info[entries.TORQUE_JOINT].item() == pytest.approx(25.0 * math.sqrt(2.0 * n_agents), rel=1e-6)
    assert info["reward_terms", "smoothness"].item() == pytest.approx(-0.05, rel=1e-6)
