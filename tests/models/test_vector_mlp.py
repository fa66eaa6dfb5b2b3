import pytest
import torch
from tensordict import TensorDict

from softgm_bench.envs.interface import Sizes
from softgm_bench.envs.vmas import OBSERVATION
from softgm_bench.models import VectorMLPConfig, build_encoder
from softgm_bench.models.action_value import ACTION_VALUE, ActionValueConfig, build_action_value
from softgm_bench.models.heads import STATE_VALUE, ValueConfig, build_value

AGENTS, FEATURES = 3, 5
SIZES = Sizes(AGENTS, 2, n_features=FEATURES)


def observation(size=4):
    generator = torch.Generator().manual_seed(0)
    agents = {
        "observation": torch.randn(size, AGENTS, FEATURES, generator=generator),
        "action": torch.randn(size, AGENTS, 2, generator=generator).tanh(),
    }
    return TensorDict({"agents": TensorDict(agents, [size, AGENTS])}, [size])


def test_without_layers_the_embedding_is_the_observation():
    td = observation()
    encoder = build_encoder(VectorMLPConfig([]), SIZES)
    assert torch.equal(encoder(td), td[OBSERVATION])
    assert encoder.own(td).shape == (4, AGENTS, 0)


def test_an_embedding_is_of_one_agents_observation_alone():
    td = observation()
    encoder = build_encoder(VectorMLPConfig([7, 6]), SIZES)
    before = encoder(td)
    assert before.shape == (4, AGENTS, 6)
    td[OBSERVATION][:, 1] += 1.0
    changed = (encoder(td) != before).any(-1)
    assert torch.equal(changed, torch.tensor([False, True, False]).expand(4, AGENTS))


@pytest.mark.parametrize("centralised", [False, True])
def test_critics_are_benchmarls_one_mlp_of_everything_they_may_read(centralised):
    td, config = observation(), VectorMLPConfig([])
    of_state = ValueConfig(
        widths=[8], pooling="concat", mlp=None, asymmetric=False, embedding_norm=False, hidden_norm=False
    )
    value = build_value(config, SIZES, of_state, centralised)
    of_action = ActionValueConfig(widths=[8], mlp=None, asymmetric=False, embedding_norm=False, hidden_norm=False)
    of_actions = build_action_value(config, SIZES, of_action, centralised)
    seen, acted = td[OBSERVATION], td["agents", "action"]
    if centralised:
        expected = value.function(seen.flatten(1))
        of_team = of_actions.function(torch.cat([seen.flatten(1), acted.flatten(1)], dim=-1))
        expected_of_actions = of_team.unsqueeze(1).expand(4, AGENTS, 1)
    else:
        expected = value.head.function(seen)
        expected_of_actions = of_actions.function(torch.cat([seen, acted], dim=-1))
    torch.testing.assert_close(value(td.copy())[STATE_VALUE], expected)
    torch.testing.assert_close(of_actions(td.copy())[ACTION_VALUE], expected_of_actions)
