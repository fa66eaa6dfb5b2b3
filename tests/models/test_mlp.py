import torch
from hypothesis import given, settings
from observations import COUNTS, LEADS, SEEDS, SIZES, observation, randomise

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import MLPConfig, MLPEncoder, graph
from softgm_bench.models.mlp import MLPTeamEncoder


@settings(max_examples=30, deadline=None)
@given(LEADS, COUNTS, SEEDS)
def test_it_is_an_mlp_on_the_flat_observation(lead, sizes, seed):
    torch.manual_seed(seed)
    model = randomise(
        MLPEncoder(MLPConfig(hidden=7, layers=2, velocity_scale=1.0), Sizes(sizes[0], 2, n_slots=sizes[1]))
    ).double()
    td = observation(lead, *sizes, seed=seed, dtype=torch.float64)
    plain = torch.nn.Sequential(model.first, torch.nn.Tanh(), model.rest[0], torch.nn.Tanh())
    out = model(td)
    assert out.shape == (*lead, sizes[0], 7)
    torch.testing.assert_close(out, plain(graph.flat_observation(td)), rtol=1e-12, atol=1e-12)


def test_it_knows_undiscovered_slots_by_nothing():
    model = MLPEncoder(MLPConfig(hidden=7, layers=1, velocity_scale=0.5), SIZES)
    td = observation((5,), 4, 6)
    changed = td.clone()
    changed[entries.SLOT_DESCRIPTOR] = torch.where(
        td[entries.SLOT_ACTIVE].unsqueeze(-1), td[entries.SLOT_DESCRIPTOR], 9.0
    )
    assert torch.equal(model(td), model(changed))


@settings(max_examples=30, deadline=None)
@given(LEADS, COUNTS, SEEDS)
def test_the_teams_is_an_mlp_on_every_distinct_number_of_the_flat_observations(lead, sizes, seed):
    n_agents, n_slots = sizes
    torch.manual_seed(seed)
    config = MLPConfig(hidden=7, layers=2, velocity_scale=1.0)
    model = randomise(MLPTeamEncoder(config, Sizes(n_agents, 2, n_slots=n_slots), 3)).double()
    td = observation(lead, *sizes, seed=seed, dtype=torch.float64)
    further = torch.randn(*lead, 3, dtype=torch.float64)
    flat = graph.flat_observation(td)
    own, slots, edges = flat.split([graph.CHANNELS, n_slots * graph.CHANNELS, n_slots], dim=-1)
    inputs = torch.cat([own.flatten(-2), edges.flatten(-2), slots[..., 0, :], further], dim=-1)
    plain = torch.nn.Sequential(model.layers[0], torch.nn.Tanh(), model.layers[1], torch.nn.Tanh())
    assert model(td, further).shape == (*lead, 7)
    torch.testing.assert_close(model(td, further), plain(inputs), rtol=1e-12, atol=1e-12)
