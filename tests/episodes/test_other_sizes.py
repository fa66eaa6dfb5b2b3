"""Policies on arms with another number of sections or elements than they were trained on."""

from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench import api
from softgm_bench.assembly import build_env
from softgm_bench.envs import entries
from softgm_bench.episodes import policy
from softgm_bench.errors import UserError
from untrained_policy import untrained

pytestmark = pytest.mark.usefixtures("one_thread")
POLICIES = Path(__file__).parents[2] / "experiments" / "policies"
SMALL = "rod.n_elements=20"


def keep(path, *overrides):
    """Keep a policy with fresh networks and give its file."""
    policy.save(untrained("recipe=paper", *overrides), path)
    return path


@pytest.mark.parametrize("algo", ["softgm", "mappo"])
@pytest.mark.parametrize("n_agents", [4, 9])
def test_a_kept_policy_reaches_targets_with_another_number_of_sections(algo, n_agents):
    """A policy that does nothing reaches none of them within two seconds, a random one next to none."""
    evaluation = api.evaluate(
        POLICIES / f"basic_{algo}.pt", f"task.n_agents={n_agents}", SMALL, episodes=32, seed=1, horizon=50
    )
    assert evaluation.records["success"].mean() > 0.6
    assert evaluation.records["torque_joint"].max() <= 25.0 * (2 * n_agents) ** 0.5 + 1e-4


@pytest.mark.parametrize("algo", ["softgm", "mappo"])
def test_a_memory_is_kept_by_as_many_agents_as_there_are(algo, tmp_path):
    memory = ("task=structured", "task.sensing_radius=0.4", "model.hidden=16", "algo.actor.memory={cell:gru,size:8}")
    kept = keep(tmp_path / "kept.pt", f"algo={algo}", SMALL, *memory)
    for n_agents in (4, 9):
        settings = (f"task.n_agents={n_agents}",)
        trained = policy.load(kept, overrides=settings)
        env = build_env(trained.config, 3, seed=1, horizon=5)
        with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
            frames = api.rollout(env, trained, steps=5)
        assert frames[entries.NEXT_MEMORY].shape == (3, 5, n_agents, 8)
        assert frames[entries.ACTION].shape == (3, 5, n_agents, 2)
        usual, forgetful = (
            api.evaluate(kept, *settings, episodes=3, horizon=5, intervention=shown).records["torque_joint"]
            for shown in ("none", "forget")
        )
        assert (usual != forgetful).all()


@pytest.mark.parametrize("deterministic", [True, False])
def test_off_policy_actors_that_explore_take_any_number_of_agents(deterministic):
    records = api.evaluate(
        POLICIES / "basic_maddpg.pt", "task.n_agents=9", SMALL, episodes=2, horizon=3, deterministic=deterministic
    ).records
    assert (records["torque_per_agent"] > 0.0).all()


def test_a_vector_policy_takes_any_number_of_agents_and_no_other_observation(tmp_path):
    pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
    kept = keep(tmp_path / "kept.pt", "task=vmas_balance", "algo=mappo", "model=vector_mlp")
    records = api.evaluate(kept, "task.scenario.n_agents=3", episodes=2, horizon=3).records
    assert (records["length"] == 3).all()
    said = r"^\S+: its networks read 16 numbers for each agent, task=vmas_navigation shows 18$"
    with pytest.raises(UserError, match=said):
        policy.load(kept, overrides=["task=vmas_navigation"])


def test_an_oracle_is_refused_where_it_would_be_told_something_else():
    said = r"^\S+: its networks are told 4 numbers about a scene, task=wall_search has 5$"
    with pytest.raises(UserError, match=said):
        policy.load(POLICIES / "wall_softgm_oracle.pt", overrides=["task=wall_search"])


def test_more_sections_than_inner_nodes_are_refused():
    kept = POLICIES / "basic_softgm.pt"
    assert policy.load(kept, overrides=["task.n_agents=19", SMALL]).config.task.n_agents == 19
    with pytest.raises(UserError, match=r"^task.n_agents=20 with rod.n_elements=20: [^\n]*rod.n_elements=21$"):
        policy.load(kept, overrides=["task.n_agents=20", SMALL])
