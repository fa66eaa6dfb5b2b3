import functools

import pytest
import torch
from observations import observation, randomise, softgm_config

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import MLPConfig, MLPEncoder, graph
from softgm_bench.models.action_value import ACTION_VALUE, ActionValueConfig, build_action_value
from softgm_bench.models.mlp import MLPTeamEncoder

MLP = MLPConfig(hidden=8, layers=2, velocity_scale=0.5)
ENCODERS = pytest.mark.parametrize("encoder", [softgm_config(), MLP], ids=["softgm", "mlp"])
OWN = (entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.PREVIOUS_ACTION, entries.ACTION)


def critic(encoder, centralised, n_agents=5, seed=0):
    torch.manual_seed(seed)
    return randomise(
        build_action_value(
            encoder,
            Sizes(n_agents, 2, n_slots=6),
            ActionValueConfig(widths=[8], mlp=None, asymmetric=False, embedding_norm=False, hidden_norm=False),
            centralised,
        )
    )


def frames(lead=(7,), n_agents=5, sensed=0.4):
    td = observation(lead, n_agents=n_agents, sensed=sensed)
    td[entries.ACTION] = torch.rand(*lead, n_agents, 2) * 2 - 1
    return td


def changed(td, key, agent):
    other = td.clone()
    value = other[key].clone()
    value[..., agent, :] = ~value[..., agent, :] if value.dtype == torch.bool else value[..., agent, :] + 0.3
    other[key] = value
    return other


def value(network, td):
    with torch.no_grad():
        return network(td.clone())[ACTION_VALUE]


@ENCODERS
@pytest.mark.parametrize("centralised", [False, True])
@pytest.mark.parametrize("lead", [(7,), (2, 3)])
@pytest.mark.parametrize("n_agents", [1, 5])
def test_every_agent_has_a_value_for_any_number_of_agents(encoder, centralised, lead, n_agents):
    values = value(critic(encoder, centralised, n_agents), frames(lead, n_agents))
    assert values.shape == (*lead, n_agents, 1)
    assert values.isfinite().all()


@ENCODERS
@pytest.mark.parametrize("key", OWN, ids=lambda key: key[1])
def test_a_centralised_critic_says_one_value_and_heeds_every_agent(encoder, key):
    network, td = critic(encoder, centralised=True), frames()
    values = value(network, td)
    assert (values == values[:, :1]).all()
    for agent in range(5):
        assert not torch.equal(values, value(network, changed(td, key, agent)))


def test_a_centralised_critic_tells_agents_apart():
    """Swapping two agents' actions keeps their mean and still changes the value."""
    network, td = critic(MLP, centralised=True), frames()
    swapped = td.clone()
    swapped[entries.ACTION] = td[entries.ACTION][:, [1, 0, 2, 3, 4]]
    assert ((value(network, td) - value(network, swapped)).abs() > 1e-4).all()


@pytest.mark.parametrize("key", [*OWN, entries.EDGE], ids=lambda key: key[1])
def test_an_independent_critic_on_the_mlp_knows_nothing_of_other_agents(key):
    network, td = critic(MLP, centralised=False), frames()
    values, other = value(network, td), value(network, changed(td, key, agent=1))
    assert torch.equal(values[:, [0, 2, 3, 4]], other[:, [0, 2, 3, 4]])
    assert not torch.equal(values[:, 1], other[:, 1])


def test_an_independent_critic_on_softgm_knows_others_as_far_as_messages_travel_and_never_their_actions():
    network, td = critic(softgm_config(), centralised=False), frames()
    values = value(network, td)
    acted = value(network, changed(td, entries.ACTION, agent=0))
    assert torch.equal(values[:, 1:], acted[:, 1:])
    assert not torch.equal(values[:, 0], acted[:, 0])
    moved = value(network, changed(td, entries.AGENT_POSITION, agent=0))
    assert (values[:, :3] != moved[:, :3]).any(dim=0).all()  # two layers along the chain
    assert torch.equal(values[:, 3:], moved[:, 3:])


@ENCODERS
def test_independent_values_are_those_of_node_embedding_and_action(encoder):
    network, td = critic(encoder, centralised=False), frames()
    with torch.no_grad():
        own = graph.agent_channels(td, network.encoder.velocity_scale)
        parts = torch.cat([own, network.encoder(td), td[entries.ACTION]], dim=-1)
        rows = [network.function(parts[:, agent]) for agent in range(5)]
    torch.testing.assert_close(value(network, td), torch.stack(rows, dim=1))


@ENCODERS
def test_the_teams_value_is_that_of_all_observations_and_then_all_actions(encoder):
    network, td = critic(encoder, centralised=True), frames()
    with torch.no_grad():
        expected = network.function(network.encoder(td, td[entries.ACTION].flatten(1)))
    torch.testing.assert_close(value(network, td), expected.unsqueeze(1).expand(-1, 5, -1))


def test_a_critic_may_have_an_mlp_of_its_own_whatever_the_actors_model():
    config = ActionValueConfig(widths=[8], mlp=MLP, asymmetric=False, embedding_norm=False, hidden_norm=False)
    build = functools.partial(build_action_value, softgm_config(), Sizes(5, 2, n_slots=6), config)
    assert isinstance(build(centralised=True).encoder, MLPTeamEncoder)
    assert isinstance(build(centralised=False).encoder, MLPEncoder)


@pytest.mark.parametrize("centralised", [False, True])
def test_only_an_asymmetric_critic_reads_what_is_privileged(centralised):
    td = frames()
    td[entries.PRIVILEGED] = torch.randn(7, 4)
    other = td.clone()
    other[entries.PRIVILEGED] = torch.randn(7, 4)
    plain = critic(MLP, centralised)
    assert entries.PRIVILEGED not in plain.in_keys
    assert torch.equal(value(plain, td), value(plain, other))
    config = ActionValueConfig(widths=[8], mlp=None, asymmetric=True, embedding_norm=False, hidden_norm=False)
    told = randomise(build_action_value(MLP, Sizes(5, 2, n_slots=6), config, centralised, n_privileged=4))
    assert entries.PRIVILEGED in told.in_keys
    assert value(told, td).shape == (7, 5, 1)
    assert ((value(told, td) - value(told, other)).abs() > 1e-5).all()
