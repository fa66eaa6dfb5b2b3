import itertools
from dataclasses import replace

import pytest
import torch
from observations import ENCODERS, SIZES, actor, actor_config, observation, randomise, softgm_config, value_config
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench.envs import entries
from softgm_bench.models import MLPConfig, MLPEncoder, build_actor, build_value, graph
from softgm_bench.models.heads import LOC, POOLINGS, SATURATION_FRAMES, SCALE, STATE_VALUE, actor_saturation
from softgm_bench.models.mlp import MLPTeamEncoder
from softgm_bench.models.registry import Normalised, NormalisedTeam


@ENCODERS
@pytest.mark.parametrize("lead", [(5,), (2, 3)])
def test_shapes(encoder, lead):
    td = actor(encoder)(observation(lead))
    assert td[entries.ACTION].shape == (*lead, 4, 2)
    assert td[entries.LOG_PROB].shape == (*lead, 4)
    assert td[LOC].shape == td[SCALE].shape == (*lead, 4, 2)
    assert (td[entries.ACTION].abs() <= 1).all()
    for pooling in POOLINGS:
        value = build_value(encoder, SIZES, value_config(pooling=pooling))
        assert value(td)[STATE_VALUE].shape == (*lead, 1)
    value = build_value(encoder, SIZES, value_config(), centralised=False)
    assert value(td)[STATE_VALUE].shape == (*lead, 4, 1)


@ENCODERS
@pytest.mark.parametrize("state_dependent_sigma", [False, True])
def test_the_first_policy_is_centred_and_has_the_initial_sigma(encoder, state_dependent_sigma):
    td = actor(encoder, initial_sigma=0.7, state_dependent_sigma=state_dependent_sigma)(observation((50,)))
    assert td[LOC].abs().max() < 0.1
    torch.testing.assert_close(td[SCALE], torch.full_like(td[SCALE], 0.7), rtol=0.05, atol=0.0)


@pytest.mark.parametrize("mean", [0.0, 3.0, 10.0, -50.0])
@pytest.mark.parametrize("sigma", [0.1, 0.5, 1.9])
def test_the_ratio_of_an_unchanged_policy_is_one(mean, sigma):
    policy = actor(initial_sigma=sigma)
    with torch.no_grad():
        policy.module[0].head.function[-1].bias.fill_(mean)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        data = torch.cat([policy(observation((64,), seed=seed)) for seed in range(8)])
    data = data[torch.randperm(len(data))]  # minibatches are other batches than the rollout's
    stored = data[entries.LOG_PROB].clone()
    ratio = (policy.get_dist(data).log_prob(data[entries.ACTION]) - stored).exp()
    assert (ratio - 1).abs().max() < 1e-5


@pytest.mark.parametrize("mean", [0.0, 10.0, -50.0])
@pytest.mark.parametrize("state_dependent_sigma", [False, True])
def test_gradients_are_finite(mean, state_dependent_sigma):
    policy = actor(state_dependent_sigma=state_dependent_sigma)
    with torch.no_grad():
        policy.module[0].head.function[-1].bias[:2].fill_(mean)
        data = policy(observation((64,)))
    dist = policy.get_dist(data)
    _, pathwise = dist.rsample_and_log_prob()
    (dist.log_prob(data[entries.ACTION]).sum() + pathwise.sum()).backward()
    for name, parameter in policy.named_parameters():
        assert parameter.grad is not None, name
        assert parameter.grad.isfinite().all(), name


def test_it_is_deterministic_only_when_told_so():
    policy, td = actor(), observation((5,))

    def act(exploration):
        with set_exploration_type(exploration):
            return policy(td.clone())[entries.ACTION]

    assert torch.equal(act(ExplorationType.DETERMINISTIC), act(ExplorationType.DETERMINISTIC))
    assert not torch.equal(act(ExplorationType.RANDOM), act(ExplorationType.RANDOM))
    assert not torch.equal(policy(td.clone())[entries.ACTION], policy(td.clone())[entries.ACTION])
    loc = policy(td)[LOC]
    torch.testing.assert_close(act(ExplorationType.DETERMINISTIC), (3 * (loc / 3).tanh()).tanh())


@pytest.mark.parametrize("extreme", [-30.0, -4.0, 4.0, 30.0])
def test_sigma_stays_between_its_bounds_and_can_return(extreme):
    policy = actor()
    with torch.no_grad():
        policy.module[0].sigma.fill_(extreme)
    scale = policy(observation((2,)))[SCALE]
    assert scale.min() >= 0.05 * (1 - 1e-6)
    assert scale.max() <= 2.0 * (1 + 1e-6)
    scale.sum().backward()
    if abs(extreme) < 10:
        assert (policy.module[0].sigma.grad.abs() > 1e-4).all()


def test_an_initial_sigma_outside_its_bounds_is_refused():
    with pytest.raises(ValueError, match="initial_sigma"):
        actor(initial_sigma=3.0)


def test_a_slot_without_an_edge_changes_no_bit_of_any_action():
    policy, td = randomise(actor()), observation((9,))
    changed = td.clone()
    unsensed = ~td[entries.EDGE].any(dim=-2, keepdim=True).mT
    changed[entries.SLOT_DESCRIPTOR] = torch.where(unsensed, 5.0, td[entries.SLOT_DESCRIPTOR])
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(policy(td)[entries.ACTION], policy(changed)[entries.ACTION])


def test_the_value_pools_the_agents_mean():
    td = observation((5,))
    value = build_value(softgm_config(), SIZES, value_config())
    expected = value.function(value.encoder(td).mean(dim=-2))
    assert torch.equal(value(td)[STATE_VALUE], expected)


def test_the_concatenated_value_reads_every_agents_node_and_embedding_side_by_side():
    td = observation((5,))
    value = build_value(softgm_config(), SIZES, value_config(pooling="concat"))
    parts = [graph.agent_channels(td), value.encoder.encoder(td)]
    agents = [torch.cat([part[:, agent] for part in parts], dim=-1) for agent in range(4)]
    assert torch.equal(value(td)[STATE_VALUE], value.function(torch.cat(agents, dim=-1)))


@ENCODERS
def test_a_critic_may_have_an_mlp_of_its_own_whatever_the_actors_model(encoder):
    mlp = MLPConfig(hidden=8, layers=1, velocity_scale=1.0)
    config = value_config(pooling="concat", mlp=mlp)
    assert isinstance(build_value(encoder, SIZES, config).encoder, MLPTeamEncoder)
    assert isinstance(build_value(encoder, SIZES, config, centralised=False).head.encoder, MLPEncoder)


@ENCODERS
@pytest.mark.parametrize("pooling", POOLINGS)
def test_a_centralised_critic_sees_every_agent(encoder, pooling):
    torch.manual_seed(0)
    value = randomise(build_value(encoder, SIZES, value_config(pooling=pooling)))
    for agent in range(4):
        td = observation((5,))
        before = value(td.clone())[STATE_VALUE]
        td[entries.AGENT_VELOCITY][:, agent] += 1.0
        assert not torch.isclose(before, value(td)[STATE_VALUE]).any()


OWN = (entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.PREVIOUS_ACTION, entries.EDGE)


@pytest.mark.parametrize("moved", range(4))
@pytest.mark.parametrize("entry", OWN)
def test_an_independent_critic_sees_of_each_agent_what_its_actor_sees(entry, moved):
    """The MLP's agents see their own entries, SoftGM's (here one layer) also what their neighbours tell them."""
    for encoder, reach in ((MLPConfig(hidden=8, layers=2, velocity_scale=1.0), 0), (softgm_config(layers=1), 1)):
        torch.manual_seed(0)
        value = randomise(build_value(encoder, SIZES, value_config(), centralised=False)).double()
        td = observation((5,), sensed=0.6, discovered=1.0, dtype=torch.float64)
        other = td.clone()
        other[entry][:, moved] = ~td[entry][:, moved] if entry == entries.EDGE else td[entry][:, moved] + 1.0
        difference = (value(td)[STATE_VALUE] - value(other)[STATE_VALUE]).abs().squeeze(-1)
        changed = (difference > 1e-12).any(dim=0).tolist()
        assert changed == [abs(agent - moved) <= reach for agent in range(4)]


def test_privileged_channels_enter_the_heads_that_are_built_for_them_and_no_other():
    torch.manual_seed(0)
    td = observation((5,))
    td[entries.PRIVILEGED] = torch.randn(5, 3)
    other = td.clone()
    other[entries.PRIVILEGED] = td[entries.PRIVILEGED] + 1.0

    def same(build, key):
        network = randomise(build)
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return torch.equal(network(td.clone())[key], network(other.clone())[key])

    for known in (0, 3):
        network = build_actor(softgm_config(), SIZES, actor_config(), n_privileged=known)
        assert (entries.PRIVILEGED in network.in_keys) is bool(known)
        assert same(network, LOC) is not bool(known)
        for centralised, pooling in ((True, "mean"), (True, "concat"), (False, "mean")):
            value = build_value(softgm_config(), SIZES, value_config(pooling=pooling), centralised, known)
            assert (entries.PRIVILEGED in value.in_keys) is bool(known)
            assert same(value, STATE_VALUE) is not bool(known)


def test_an_oracles_actor_is_told_a_point_as_it_is_told_the_target():
    """Were the opening's centre the target, both would be told every agent alike."""
    sizes = replace(SIZES, n_privileged=4, n_points=1)
    torch.manual_seed(0)
    policy = build_actor(softgm_config(), sizes, actor_config(relative_points=True), sizes.n_privileged)
    td = observation((5,))
    td[entries.PRIVILEGED] = torch.cat([td[entries.TARGET], torch.full((5, 1), 0.3)], dim=-1)
    inputs = policy.module[0].head.inputs(td)
    known, relative = inputs[..., -7:-3], inputs[..., -3:]
    assert torch.equal(known, td[entries.PRIVILEGED].unsqueeze(-2).expand(5, 4, 4))
    assert torch.equal(relative, graph.agent_channels(td)[..., 9:12])
    absolute = build_actor(softgm_config(), sizes, actor_config(), sizes.n_privileged).module[0].head
    assert torch.equal(absolute.inputs(td)[..., -4:], known)
    assert absolute.function[0].in_features == inputs.shape[-1] - 3


def test_only_an_oracles_actor_is_told_points():
    sizes = replace(SIZES, n_privileged=4, n_points=1)
    for relative in (False, True):
        policy = build_actor(softgm_config(), sizes, actor_config(relative_points=relative))
        assert set(policy.in_keys) == set(entries.OBSERVATION)
        assert policy.module[0].head.function[0].in_features == graph.CHANNELS + 8


def test_an_unknown_pooling_is_refused():
    with pytest.raises(ValueError, match=r"algo\.critic\.pooling is max: choose one of mean, concat"):
        value_config(pooling="max")


def test_actor_and_critic_share_no_parameter():
    policy, value = actor(), build_value(softgm_config(), SIZES, value_config())
    assert not {id(p) for p in policy.parameters()} & {id(p) for p in value.parameters()}


def test_persistence_mixes_the_previous_action_into_the_mean():
    plain, persistent = actor(), actor(persistence=0.75)
    data = observation((7,))
    loc = plain(data.clone())[LOC]
    previous = data[entries.PREVIOUS_ACTION].clamp(-0.99, 0.99).atanh()
    torch.testing.assert_close(persistent(data.clone())[LOC], 0.25 * loc + 0.75 * previous)
    with pytest.raises(ValueError, match=r"persistence is 1\.0"):
        actor(persistence=1.0)


NORMALISED = pytest.mark.parametrize(
    "build",
    [
        lambda encoder, norm: build_actor(encoder, SIZES, actor_config(embedding_norm=norm)),
        lambda encoder, norm: build_value(encoder, SIZES, value_config(embedding_norm=norm)),
        lambda encoder, norm: build_value(encoder, SIZES, value_config(embedding_norm=norm), centralised=False),
        lambda encoder, norm: build_value(encoder, SIZES, value_config(embedding_norm=norm, pooling="concat")),
    ],
    ids=["actor", "mean", "independent", "concat"],
)


@ENCODERS
@NORMALISED
def test_a_normalised_embedding_gives_the_head_the_same_whatever_its_scale(encoder, build):
    """Its mean is 0 and its variance 1, and what a hundred times the embedding would say is the same."""
    torch.manual_seed(0)
    network = build(encoder, True)
    (normalised,) = (module for module in network.modules() if isinstance(module, Normalised | NormalisedTeam))
    inputs = (observation((5,)), *([torch.zeros(5, 0)] if isinstance(normalised, NormalisedTeam) else []))
    once = normalised(*inputs)
    torch.testing.assert_close(once.mean(-1), torch.zeros(once.shape[:-1]), rtol=0.0, atol=1e-5)
    torch.testing.assert_close(once.var(-1, correction=0), torch.ones(once.shape[:-1]), rtol=0.0, atol=1e-2)
    embed = normalised.encoder.forward
    normalised.encoder.forward = lambda *args: 100.0 * embed(*args)
    torch.testing.assert_close(normalised(*inputs), once, rtol=0.0, atol=1e-2)


@ENCODERS
@NORMALISED
def test_without_normalisation_a_network_has_the_parameters_and_the_draws_of_before(encoder, build):
    torch.manual_seed(0)
    plain = build(encoder, False).state_dict()
    torch.manual_seed(0)
    normalised = build(encoder, True).state_dict()
    assert not any("norm" in name for name in plain)
    drawn = [value for name, value in normalised.items() if not name.endswith("norm.weight")]
    assert len(drawn) == len(normalised) - 1
    assert all(torch.equal(one, other) for one, other in zip(plain.values(), drawn, strict=True))


@ENCODERS
def test_saturation_is_of_the_heads_first_layer(encoder):
    policy, td = actor(encoder), observation((6, 4))
    head = policy.module[0].head
    size = head.function[0](head.inputs(td)).abs()
    state = torch.get_rng_state()
    told = actor_saturation(policy, td)
    assert torch.equal(torch.get_rng_state(), state)
    expected = {"actor_saturation": (size > 3.0).float().mean().item(), "actor_preactivation": size.mean().item()}
    assert told == pytest.approx(expected, rel=1e-5)
    with torch.no_grad():
        head.function[0].bias.fill_(100.0)
    assert actor_saturation(policy, td)["actor_saturation"] == 1.0
    assert actor_saturation(actor(encoder, widths=[]), td) == {}


HIDDEN = pytest.mark.parametrize(
    "build",
    [
        lambda norm: build_actor(softgm_config(), SIZES, actor_config(widths=[64, 64], hidden_norm=norm)),
        lambda norm: build_value(softgm_config(), SIZES, value_config(widths=[64], hidden_norm=norm)),
        lambda norm: build_value(
            softgm_config(), SIZES, value_config(widths=[64], hidden_norm=norm, pooling="concat"), centralised=False
        ),
    ],
    ids=["actor", "mean", "independent"],
)


@HIDDEN
def test_a_normalised_head_is_the_same_however_large_its_weights(build):
    torch.manual_seed(0)
    network, td = build(True), observation((5,))
    key = LOC if LOC in network.out_keys else STATE_VALUE
    once = network(td.clone())[key]
    with torch.no_grad():
        function = next(module.function for module in network.modules() if hasattr(module, "function"))
        linears = [layer for layer in function[:-1] if isinstance(layer, torch.nn.Linear)]
        for layer in linears:
            layer.weight *= 30.0
            layer.bias *= 30.0
    torch.testing.assert_close(network(td.clone())[key], once, rtol=1e-2, atol=1e-3)  # its epsilon counts less
    plain = build(False)
    assert not any(isinstance(module, torch.nn.LayerNorm) for module in plain.modules())


def test_a_normalised_head_hardly_saturates_where_a_plain_one_does():
    shares = {}
    for norm in (False, True):
        torch.manual_seed(0)
        policy, td = actor(widths=[64], hidden_norm=norm), observation((64, 4))
        with torch.no_grad():
            policy.module[0].head.function[0].weight *= 100.0
        shares[norm] = actor_saturation(policy, td)["actor_saturation"]
    assert shares[False] > 0.5
    assert shares[True] < 0.01


def test_saturation_is_told_of_frames_all_over_a_large_batch():
    policy, td = actor(), observation((100, 6))
    seen = []
    inputs = policy.module[0].head.inputs
    policy.module[0].head.inputs = lambda frames: seen.append(frames) or inputs(frames)
    actor_saturation(policy, td)
    assert len(seen[0]) == SATURATION_FRAMES
    flat = td.reshape(-1)[entries.TIP]
    rows = [(flat == tip).all(-1).nonzero().item() for tip in seen[0][entries.TIP]]
    assert rows[0] == 0
    assert {after - before for before, after in itertools.pairwise(rows)} == {2, 3}
