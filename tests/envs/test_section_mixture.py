"""Arms of several numbers of sections side by side."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torchrl.envs import EnvBase

from softgm_bench.assembly import build_env, build_envs, configure
from softgm_bench.config import compose
from softgm_bench.envs import Environment, entries, kind_of
from softgm_bench.envs.section_mixture import members, shares
from softgm_bench.errors import UserError

pytestmark = pytest.mark.usefixtures("one_thread")
SMALL = ("task=wall", "rod.n_elements=20", "recipe=paper")


def mixture(*overrides, num_envs=5, seed=3, training=True):
    config = compose([*SMALL, "task.n_agents=[4,6,5]", *overrides])
    return config, build_envs(config, num_envs, seed, horizon=9, training=training)


@given(st.integers(0, 1000), st.integers(1, 20))
def test_shares_are_whole_and_differ_by_one_at_most(total, parts):
    found = shares(total, parts)
    assert sum(found) == total
    assert len(found) == parts
    assert max(found) - min(found) <= 1


def test_every_number_has_its_share_of_environments_of_its_own():
    config, envs = mixture()
    assert isinstance(envs, Environment)
    assert not isinstance(envs, EnvBase)
    assert [(number, one.batch_size[0], one.sizes.n_agents) for number, one in envs.members.items()] == [
        (4, 2, 4),
        (6, 2, 6),
        (5, 1, 5),
    ]
    assert envs.sizes == kind_of(config.task).sizes(config.task) == envs.members[6].sizes
    assert isinstance(build_envs(members(config)[4], 2, seed=0), EnvBase)


def test_training_never_draws_the_scenes_of_one_number_for_another_and_evaluations_always_do():
    for training in (True, False):
        _, envs = mixture(num_envs=6, training=training)
        targets = [one.reset()[entries.TARGET] for one in envs.members.values()]
        assert all(torch.equal(targets[0], other) is not training for other in targets[1:])


def test_the_first_number_has_the_arms_of_a_run_with_that_number_alone():
    config, envs = mixture(num_envs=6)
    alone = build_env(members(config)[4], 2, 3, horizon=9, training=True)
    actions = torch.full((2, 4, 2), 0.7)
    for env in (envs.members[4], alone):
        env.reset()
    for _ in range(3):
        one, other = (env.step(env.fake_tensordict().set(entries.ACTION, actions)) for env in (envs.members[4], alone))
        assert (one["next"] == other["next"]).all()


@pytest.mark.parametrize("perturbation", ["none", "noise"])
def test_a_mixture_goes_on_from_a_state_that_it_gave(perturbation):
    _, envs = mixture(f"perturbation={perturbation}")

    def proceed():
        rollouts = []
        for one in envs.members.values():
            torch.manual_seed(1)  # of the actions
            rollouts.append(one.rollout(12, break_when_any_done=False, auto_reset=False, tensordict=shown[one].copy()))
        return rollouts

    shown = {one: one.reset() for one in envs.members.values()}
    state, generators = envs.simulation_state(), envs.generator_state()
    first = proceed()
    assert state.batch_size == envs.batch_size == ()
    envs.load_simulation_state(state)
    envs.set_generator_state(generators)
    assert all((one == other).all() for one, other in zip(first, proceed(), strict=True))


def test_one_arm_has_one_number_of_sections():
    config, _ = mixture()
    with pytest.raises(UserError, match=r"^task\.n_agents=\[4, 6, 5\]: this is for [^\n]*, as in task\.n_agents=4$"):
        build_env(config, 2, seed=0)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("[]", r"^task\.n_agents is \[\]: it must be at least 1$"),
        ("[4,0]", r"^task\.n_agents is \[4, 0\]: it must be at least 1$"),
        ("[4,4]", r"^task\.n_agents is \[4, 4\]: every number may stand there once$"),
        ("[4,5.5]", r"^task\.n_agents is \[4, 5\.5\]: it must be a whole number, or a list "),
        ("six", r"^task\.n_agents is six: it must be a whole number, or a list of several as in \[4, 6, 8\]$"),
        ("true", r"^task\.n_agents is True: it must be a whole number"),
        ("null", r"^task\.n_agents is None: it must be a whole number"),
        ("[4,20]", r"^task\.n_agents=20 with rod\.n_elements=20: "),
    ],
)
def test_what_is_no_number_of_sections_is_refused(given, said):
    with pytest.raises(UserError, match=said):
        configure([*SMALL, f"task.n_agents={given}"])
