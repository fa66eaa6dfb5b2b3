"""Policies that commute with the mirror, either way."""

from dataclasses import replace

import pytest
import torch
from observations import ENCODERS, SIZES, actor, actor_config, observation, randomise, softgm_config

from softgm_bench.envs import entries
from softgm_bench.models import build_actor, graph
from softgm_bench.models.heads import LOC, SCALE, actor_saturation
from softgm_bench.models.memory import MemoryConfig
from softgm_bench.models.mirror import AVERAGE, CANONICAL, seen

BINORMAL = torch.tensor([1.0, -1.0])  # what bends the arm sideways
WAYS = pytest.mark.parametrize("mirror", [AVERAGE, CANONICAL])


@ENCODERS
@WAYS
@pytest.mark.parametrize("state_dependent_sigma", [False, True])
@pytest.mark.parametrize("persistence", [0.0, 0.5])
def test_a_mirrored_policy_does_in_the_mirror_what_mirrors_its_actions(
    encoder, mirror, state_dependent_sigma, persistence
):
    policy = actor(encoder, mirror=mirror, state_dependent_sigma=state_dependent_sigma, persistence=persistence)
    randomise(policy)
    td = observation((2, 3))
    here, there = policy.module[0](td.clone()), policy.module[0](graph.mirrored(td))
    torch.testing.assert_close(there[LOC], here[LOC] * BINORMAL, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(there[SCALE], here[SCALE], rtol=1e-5, atol=0.0)
    assert here[LOC].abs().min() > 1e-4
    plain = actor(encoder, state_dependent_sigma=state_dependent_sigma, persistence=persistence)
    randomise(plain)
    there = plain.module[0](graph.mirrored(td))
    assert not torch.allclose(there[LOC], plain.module[0](td.clone())[LOC] * BINORMAL, rtol=0.1)


@ENCODERS
def test_a_mirrored_policy_bends_to_neither_side_where_both_look_the_same(encoder):
    policy = actor(encoder, mirror=AVERAGE)
    randomise(policy)
    td = observation((7,))
    for key, signs in graph.MIRRORED.items():
        td[key] = td[key] * (torch.tensor(signs) > 0)  # all in the plane
    loc = policy.module[0](td)[LOC]
    assert torch.equal(loc[..., 1], torch.zeros_like(loc[..., 1]))
    assert loc[..., 0].abs().min() > 1e-4


def test_a_canonical_policy_sees_targets_on_the_left_alone_and_its_image_is_exact():
    policy, plain = actor(mirror=CANONICAL), actor()
    for network in (policy, plain):
        torch.manual_seed(1)
        randomise(network)
    td = observation((40,))
    right = td[entries.TARGET][:, 1] < 0.0
    assert 5 < right.sum() < 35
    here, there = policy.module[0](td.clone())[LOC], policy.module[0](graph.mirrored(td))[LOC]
    assert torch.equal(there, here * BINORMAL)
    alone, image = plain.module[0](td.clone())[LOC], plain.module[0](graph.mirrored(td))[LOC] * BINORMAL
    torch.testing.assert_close(here, torch.where(right[:, None, None], image, alone))


@WAYS
def test_a_mirrored_policy_changes_nothing_that_it_reads_and_its_saturation_is_told(mirror):
    policy = actor(mirror=mirror)
    td = observation((6, 4))
    read = td.clone()
    policy(td)
    for key in entries.OBSERVATION:
        assert torch.equal(td[key], read[key])
    assert actor_saturation(policy, td).keys() == {"actor_saturation", "actor_preactivation"}


@ENCODERS
@WAYS
def test_a_mirrored_policy_that_remembers_does_in_the_mirror_what_mirrors_its_actions(encoder, mirror):
    """Step after step, episodes that begin in between, and in one go; an average remembers both sides."""
    policy = actor(encoder, mirror=mirror, memory=MemoryConfig(cell="gru", size=4))
    randomise(policy)
    frames = observation((3, 6))
    frames[entries.TARGET] = frames[entries.TARGET][:, :1].expand(3, 6, 3).clone()  # where it is stays
    frames[entries.IS_INIT] = torch.rand(3, 6, 1, generator=torch.Generator().manual_seed(0)) < 0.3
    image = graph.mirrored(frames).set(entries.IS_INIT, frames[entries.IS_INIT])
    means = []
    for shown in (frames, image):
        state, of_steps = None, []
        for step in range(6):
            td = shown[:, step].clone()
            if state is not None:
                td.set(entries.MEMORY, state)
            of_steps.append(policy.module[0](td)[LOC])
            state = td[entries.NEXT_MEMORY]
            assert state.shape == (3, 4, 4 * (1 + (mirror == AVERAGE)))
        whole = shown.clone()
        torch.testing.assert_close(policy.module[0](whole)[LOC], torch.stack(of_steps, 1), rtol=1e-5, atol=1e-6)
        assert "next" not in whole.keys()  # noqa: SIM118
        means.append((torch.stack(of_steps, 1), state))
    (here, kept), (there, other) = means
    torch.testing.assert_close(there, here * BINORMAL, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(other, kept.roll(4, dims=-1), rtol=1e-5, atol=1e-6)  # exchanged
    forgotten = frames.clone().set(entries.IS_INIT, torch.ones_like(frames[entries.IS_INIT]))
    assert not torch.allclose(policy.module[0](forgotten)[LOC], here, atol=1e-3)
    assert actor_saturation(policy, policy(frames.clone())).keys() == {"actor_saturation", "actor_preactivation"}


@WAYS
def test_a_mirrored_oracle_does_in_the_mirror_what_mirrors_its_actions(mirror):
    image = ((3, 1.0), (4, -1.0), (5, 1.0), (0, 1.0), (1, -1.0), (2, 1.0), (6, -1.0))  # two points change places
    sizes = replace(SIZES, n_privileged=7, n_points=2, privileged_image=image)
    torch.manual_seed(0)
    policy = build_actor(softgm_config(), sizes, actor_config(mirror=mirror, relative_points=True), sizes.n_privileged)
    randomise(policy)
    td = observation((5,))
    td[entries.PRIVILEGED] = torch.randn(5, 7)
    here, there = policy.module[0](td.clone()), policy.module[0](graph.mirrored(td, image))
    torch.testing.assert_close(there[LOC], here[LOC] * BINORMAL, rtol=1e-5, atol=1e-6)
    unaware = graph.mirrored(td, image).set(entries.PRIVILEGED, td[entries.PRIVILEGED])
    assert not torch.allclose(policy.module[0](unaware)[LOC], there[LOC], atol=1e-3)


def test_an_unknown_way_to_mirror_is_refused():
    with pytest.raises(ValueError, match=r"algo\.actor\.mirror is both: choose average, canonical or null"):
        actor_config(mirror="both")


def test_what_a_network_is_asked_about_is_the_frame_or_its_image():
    td = observation((40,))
    right = td[entries.TARGET][:, 1] < 0.0
    assert seen(actor(), td) is td
    for key in entries.OBSERVATION:
        image = graph.mirrored(td)[key]
        assert torch.equal(seen(actor(mirror=AVERAGE), td)[key], td[key])
        canonical = seen(actor(mirror=CANONICAL), td)[key]
        assert torch.equal(canonical[right], image[right])
        assert torch.equal(canonical[~right], td[key][~right])
