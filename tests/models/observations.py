"""Random observations and small configurations that the tests of this folder share."""

import pytest
import torch
from hypothesis import strategies
from tensordict import TensorDict

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import ActorConfig, MLPConfig, SoftGMConfig, ValueConfig, build_actor
from softgm_bench.models.informarl import InforMARLConfig
from softgm_bench.models.section_transformer import SectionTransformerConfig

SEEDS = strategies.integers(0, 2**31)
COUNTS = strategies.tuples(strategies.integers(1, 5), strategies.integers(0, 6))  # N, M
LEADS = strategies.sampled_from([(), (1,), (4,), (2, 3)])


def observation(lead=(4,), n_agents=4, n_slots=6, seed=0, sensed=0.4, discovered=0.7, dtype=torch.float32):
    """Every entry random; each active slot has an edge to each agent with probability ``sensed``."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*lead, *shape, generator=generator, dtype=dtype)

    active = torch.rand(*lead, n_slots, generator=generator) < discovered
    edge = (torch.rand(*lead, n_agents, n_slots, generator=generator) < sensed) & active.unsqueeze(-2)
    values = {
        entries.AGENT_POSITION: normal(n_agents, 3),
        entries.AGENT_VELOCITY: normal(n_agents, 3),
        entries.PREVIOUS_ACTION: normal(n_agents, 2).tanh(),
        entries.EDGE: edge,
        entries.SLOT_DESCRIPTOR: normal(n_slots, 9) * active.unsqueeze(-1),
        entries.SLOT_ACTIVE: active,
        entries.TIP: normal(3),
        entries.TARGET: normal(3),
    }
    td = TensorDict({}, batch_size=lead)
    for key, value in values.items():
        td.set(key, value)
    return td


def relabelled(td, order):
    """The same observation with its slots in another order."""
    new = td.clone()
    new[entries.EDGE] = td[entries.EDGE][..., order]
    new[entries.SLOT_DESCRIPTOR] = td[entries.SLOT_DESCRIPTOR][..., order, :]
    new[entries.SLOT_ACTIVE] = td[entries.SLOT_ACTIVE][..., order]
    return new


def with_unsensed_slots_of(td, other):
    """The observation ``td`` with what ``other`` has in the slots that nobody senses."""
    unsensed, new = ~td[entries.EDGE].any(dim=-2), td.clone()
    new[entries.SLOT_DESCRIPTOR] = torch.where(
        unsensed.unsqueeze(-1), other[entries.SLOT_DESCRIPTOR], td[entries.SLOT_DESCRIPTOR]
    )
    new[entries.SLOT_ACTIVE] = torch.where(unsensed, other[entries.SLOT_ACTIVE], td[entries.SLOT_ACTIVE])
    return new


SIZES = Sizes(4, 2, n_slots=6)  # of ``observation()``


def softgm_config(**changes):
    values = {
        "name": "softgm",
        "hidden": 8,
        "heads": 2,
        "layers": 2,
        "type_embedding": 3,
        "stage1": True,
        "stage2": True,
        "gatv2": False,
        "residual": False,
        "velocity_scale": 1.0,
        "remember": False,
    }
    return SoftGMConfig(**(values | changes))


def informarl_config(**changes):
    values = {
        "name": "informarl",
        "hidden": 8,
        "heads": 2,
        "layers": 2,
        "type_embedding": 3,
        "embedding_layers": 2,
        "velocity_scale": 1.0,
        "remember": False,
    }
    return InforMARLConfig(**(values | changes))


def transformer_config(**changes):
    values = {
        "name": "section_transformer",
        "hidden": 8,
        "heads": 2,
        "layers": 2,
        "feedforward": 12,
        "velocity_scale": 1.0,
        "remember": False,
        "everyone": False,
    }
    return SectionTransformerConfig(**(values | changes))


def actor_config(**changes):
    values = {
        "widths": [8],
        "initial_sigma": 0.5,
        "min_sigma": 0.05,
        "max_sigma": 2.0,
        "state_dependent_sigma": False,
        "mean_bound": 3.0,
        "persistence": 0.0,
        "embedding_norm": False,
        "hidden_norm": False,
        "relative_points": False,
        "memory": None,
        "mirror": None,
    }
    return ActorConfig(**(values | changes))


ENCODERS = pytest.mark.parametrize(
    "encoder", [softgm_config(), MLPConfig(hidden=8, layers=2, velocity_scale=1.0)], ids=["softgm", "mlp"]
)


def actor(encoder=None, seed=0, **changes):
    torch.manual_seed(seed)
    return build_actor(encoder or softgm_config(), SIZES, actor_config(**changes))


def value_config(**changes):
    values = {
        "widths": [8],
        "pooling": "mean",
        "mlp": None,
        "asymmetric": False,
        "embedding_norm": False,
        "hidden_norm": False,
    }
    return ValueConfig(**(values | changes))


def randomise(module):
    """Draw every parameter, biases and the actor's small last layer included, so that no term is hidden by a zero."""
    with torch.no_grad():
        for parameter in module.parameters():
            parameter.normal_(std=0.5)
    return module
