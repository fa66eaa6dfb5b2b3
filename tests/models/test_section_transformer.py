import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from observations import COUNTS, SEEDS, SIZES, observation, randomise, transformer_config
from torch import nn

from softgm_bench.models import graph
from softgm_bench.models.section_transformer import SectionTransformerEncoder


def tokens_and_mask(model, td):
    """Every section and every slot as a token, and what each may not attend to, as torch wants it."""
    channels = torch.cat([graph.agent_channels(td), graph.slot_channels(td)], dim=-2)
    n_agents, n_slots = td["agents", "edge"].shape[-2:]
    types = torch.tensor([graph.AGENT] * n_agents + [graph.OBSTACLE] * n_slots)
    adjacency = graph.full_adjacency(td, model.config.remember)
    if model.config.everyone:
        adjacency[..., :n_agents, :n_agents] = True
    adjacency = adjacency | torch.eye(n_agents + n_slots, dtype=torch.bool)
    return model.input(channels) + model.types(types), ~adjacency.repeat_interleave(model.config.heads, dim=0)


def reference(model, td):
    """torch's own blocks over all tokens with a mask, and its attention weights."""
    tokens, mask = tokens_and_mask(model, td)
    n_agents = td["agents", "edge"].shape[-2]
    weights = []
    for block in model.blocks:
        norm = block.norm1(tokens)
        attention = block.self_attn(norm, norm, norm, attn_mask=mask, average_attn_weights=False)[1]
        weights.append(attention[:, :, :n_agents])
        tokens = block(tokens, src_mask=mask)
    return model.norm(tokens[:, :n_agents]), torch.stack(weights, dim=1)


@settings(max_examples=25, deadline=None)
@given(COUNTS, SEEDS, st.booleans(), st.booleans())
def test_it_is_torchs_encoder_with_a_mask(sizes, seed, remember, everyone):
    torch.manual_seed(seed)
    model = randomise(SectionTransformerEncoder(transformer_config(remember=remember, everyone=everyone), SIZES))
    model, td = model.double(), observation((3,), *sizes, seed=seed, dtype=torch.float64)
    expected, attention = reference(model, td)
    out, weights = model.forward_with_weights(td)
    torch.testing.assert_close(out, expected, rtol=1e-10, atol=1e-10)
    torch.testing.assert_close(weights, attention, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("everyone", [False, True])
def test_its_gradients_are_those_of_torchs_encoder(everyone):
    torch.manual_seed(0)
    model = SectionTransformerEncoder(transformer_config(everyone=everyone), SIZES).double()
    td = observation((3,), dtype=torch.float64)
    parameters = list(model.parameters())
    ours = torch.autograd.grad(model(td).square()[..., 0].sum(), parameters)
    theirs = torch.autograd.grad(reference(model, td)[0].square()[..., 0].sum(), parameters)
    for one, other in zip(ours, theirs, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-9, atol=1e-9)


def test_where_everyone_hears_everyone_an_agent_is_heard_everywhere():
    model = SectionTransformerEncoder(transformer_config(everyone=True, layers=1), SIZES)
    td = observation((3,), 6, 5)
    other = td.clone()
    other["agents", "position"][:, 0] += 1.0
    assert (model(td) != model(other)).any(dim=-1).all()


def test_its_blocks_are_torchs():
    model = SectionTransformerEncoder(transformer_config(), SIZES)
    assert all(isinstance(block, nn.TransformerEncoderLayer) and block.norm_first for block in model.blocks)


@pytest.mark.parametrize(
    ("changes", "message"),
    [({"heads": 3}, "model.hidden is 8: it must be a multiple of model.heads, 3"), ({"layers": 0}, "at least 1")],
)
def test_settings_that_give_no_network_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        transformer_config(**changes)
