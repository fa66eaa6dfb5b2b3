import pytest
import torch
from hypothesis import given, settings
from observations import COUNTS, LEADS, SEEDS, SIZES, observation, randomise

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import MLPConfig, MLPEncoder, graph
from softgm_bench.models.mlp import MLPTeamEncoder
from softgm_bench.rod import sync


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


@pytest.mark.parametrize("team", [False, True])
@pytest.mark.parametrize("used", [0, 3, 6])
def test_columns_of_slots_that_are_empty_in_the_whole_batch_are_not_multiplied_and_get_no_gradient(
    team, used, monkeypatch
):
    torch.manual_seed(0)
    config = MLPConfig(hidden=7, layers=2, velocity_scale=0.5)
    model = randomise(MLPTeamEncoder(config, SIZES, 2) if team else MLPEncoder(config, SIZES)).double()
    td = observation((5,), 4, 6, dtype=torch.float64)
    active = torch.arange(6) < used
    td[entries.SLOT_ACTIVE] = active.expand(5, 6).clone()
    td[entries.EDGE] = td[entries.EDGE] & active
    further = (torch.randn(5, 2, dtype=torch.float64),) if team else ()
    weight = next(model.parameters())

    def outcome():
        model.zero_grad()
        out = model(td, *further)
        (out * torch.linspace(-1, 1, out.numel(), dtype=torch.float64).view_as(out)).sum().backward()
        return [out.detach(), *(one.grad.clone() for one in model.parameters())]

    cropped = outcome()
    monkeypatch.setattr(sync, "is_free", lambda device: False)
    for mine, whole in zip(cropped, outcome(), strict=True):
        torch.testing.assert_close(mine, whole, rtol=1e-12, atol=1e-12)
    empty, own = ~active, torch.zeros(graph.CHANNELS, dtype=torch.bool)
    slots = empty.repeat_interleave(graph.CHANNELS)
    parts = [own.repeat(4), empty.repeat(4), slots, torch.zeros(2, dtype=torch.bool)] if team else [own, slots, empty]
    unread = torch.cat(parts)
    assert (cropped[1][:, unread] == 0.0).all()
    monkeypatch.undo()
    with torch.no_grad():
        weight[:, unread] = torch.nan
    assert model(td, *further).isfinite().all()
