"""Policies with memory wherever policies act: evaluations, recordings, rollouts, loops of one's own, from files."""

import numpy as np
import pytest
import torch
from tensordict.nn import TensorDictModuleBase
from torchrl.envs.utils import ExplorationType, set_exploration_type, step_mdp

from softgm_bench import api
from softgm_bench.assembly import build_policy, configure
from softgm_bench.envs import entries, kind_of, make_env
from softgm_bench.episodes import policy, recording
from softgm_bench.episodes.evaluation import evaluate
from softgm_bench.episodes.interventions import INTERVENTIONS
from softgm_bench.errors import UserError
from softgm_bench.rod.parameters import RodParameters
from untrained_policy import untrained

pytestmark = pytest.mark.usefixtures("one_thread")
SETTINGS = ("task=structured", "rod.n_elements=20", "task.sensing_radius=0.4", "recipe=paper")
GRU = "algo.actor.memory={cell:gru,size:8}"


@pytest.fixture(scope="module", params=["softgm", "mappo"])
def trained(request):
    """Not trained at all, but its actions depend on what it remembers."""
    return untrained(*SETTINGS, f"algo={request.param}", "model.hidden=16", GRU)


def environment(trained, num_envs=4, horizon=6):
    return make_env(trained.config.task, RodParameters(n_elements=20), num_envs, seed=0, horizon=horizon)


class Clocked(TensorDictModuleBase):
    """Remembers how many steps it has acted in, and notes it; episode i of the evaluation ends at ``ends[i]``."""

    in_keys = [entries.TIP, entries.MEMORY, entries.IS_INIT]  # noqa: RUF012
    out_keys = [entries.ACTION, entries.NEXT_MEMORY]  # noqa: RUF012

    def __init__(self):
        super().__init__()
        self.noted = []

    def forward(self, td):
        before = td.get(entries.MEMORY, torch.zeros(*td.shape, 6, 1)).masked_fill(
            td[entries.IS_INIT].unsqueeze(-1), 0.0
        )
        self.noted.append(before[:, 0, 0].tolist())
        td.set(entries.NEXT_MEMORY, before + 1.0)
        return td.set(entries.ACTION, torch.zeros(*td.shape, 6, 2))


def test_in_an_evaluation_a_memory_stays_with_its_episode_while_others_end(trained):
    env, clocked = environment(trained), Clocked()
    step, ends = env.step, torch.tensor([3, 1, 4, 2])

    def ending(data):
        out = step(data)
        out["next", entries.DONE].copy_((ends <= len(clocked.noted)).unsqueeze(-1))
        return out

    env.step = ending
    evaluate(clocked, env, deterministic=True, seed=3)
    assert clocked.noted == [[0.0] * 4, [1.0] * 3, [2.0] * 2, [3.0]]


def test_a_new_episode_does_not_depend_on_the_one_before_and_no_other_environment_notices(trained):
    """Two rollouts that differ in one environment's first episode alone, over its end and beyond."""
    actor = trained.policy
    found = []
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        for push in (0.0, 0.8):
            env = environment(trained, 3, horizon=8)
            env.set_seed(5)
            td, frames = env.reset(), []
            for step in range(6):
                td = actor(td)
                if step == 0:
                    td[entries.NEXT_MEMORY][1] += push
                frame = env.step(td)
                if step == 2:
                    frame["next", entries.DONE][1] = frame["next", entries.TERMINATED][1] = True
                td = env.maybe_reset(env._post_step_mdp_hooks(frame, env._step_mdp(frame))[1])
                frames.append(frame)
            found.append(torch.stack(frames, dim=1))
    one, other = found
    for key in (entries.ACTION, entries.NEXT_MEMORY):
        assert torch.equal(one[key][[0, 2]], other[key][[0, 2]])
        assert not torch.equal(one[key][1, 1], other[key][1, 1])
        assert torch.equal(one[key][1, 3:], other[key][1, 3:])
    assert one[entries.IS_INIT][1].flatten().tolist() == [True, False, False, True, False, False]


@pytest.mark.parametrize("deterministic", [True, False])
def test_an_episode_that_is_recorded_is_that_of_the_evaluation(trained, deterministic):
    records = api.evaluate(trained, episodes=3, seed=1, horizon=5, deterministic=deterministic).records
    for episode in range(3):
        recorded = recording.record(trained, 1, episode, horizon=5, deterministic=deterministic, episodes=3)
        assert recorded.steps == records["length"][episode]
        assert recorded.reward.astype(np.float64).sum() == pytest.approx(
            records["undiscounted_return"][episode], rel=1e-6
        )


def test_attention_is_recorded_beside_a_memory(trained):
    recorded = recording.record(trained, 1, horizon=3, attention=True)
    with_attention = trained.config.algo.name == "softgm"
    assert {stage: len(weights) for stage, weights in recorded.attention.items()} == (
        {"stage1": 3, "stage2": 3} if with_attention else {}
    )


def test_a_rollout_a_loop_of_ones_own_and_a_kept_file_act_alike_and_remember(trained, tmp_path):
    frames = api.rollout(environment(trained), trained, steps=9)  # the horizon ends episodes within
    policy.save(trained, tmp_path / "kept.pt")
    kept = policy.load(tmp_path / "kept.pt")
    env = environment(trained)
    observation = env.reset()
    for step in range(6):
        action = api.act(kept, observation)
        assert torch.equal(action, api.act(kept, observation))  # to ask again is no step
        assert torch.equal(action, frames[entries.ACTION][:, step])
        observation[entries.ACTION] = action
        observation = step_mdp(env.step(observation))
    assert torch.equal(observation[entries.MEMORY], frames[entries.NEXT_MEMORY][:, 5])
    assert frames[entries.IS_INIT][:, 6].all()
    begun = trained.policy(frames[:, 6].exclude(entries.MEMORY, "next"))
    assert torch.equal(begun[entries.NEXT_MEMORY], frames[entries.NEXT_MEMORY][:, 6])


def test_what_forgets_acts_as_in_its_first_step_always(trained):
    records = {
        name: evaluate(trained.policy, environment(trained), deterministic=True, seed=3, show=INTERVENTIONS[name])
        for name in ("none", "forget")
    }
    assert not np.array_equal(*(record["tip_travel_distance"] for record in records.values()))
    first = trained.policy(environment(trained).reset())[entries.NEXT_MEMORY]
    again = INTERVENTIONS["forget"](environment(trained).reset().set(entries.MEMORY, first))
    assert not again[entries.MEMORY].any()


def test_who_has_no_memory_cannot_forget():
    config = configure([*SETTINGS, "algo=mappo"])
    sizes = kind_of(config.task).sizes(config.task)
    plain = policy.TrainedPolicy(build_policy(config, sizes), sizes, config, 0, {}, config)
    with pytest.raises(UserError, match=r"^intervention=forget: this policy has no memory; [^\n]*$"):
        api.evaluate(plain, episodes=2, horizon=2, intervention="forget")


def test_results_are_named_after_the_memory(trained):
    assert trained.label == f"{trained.config.algo.name}_gru"
    assert configure([*SETTINGS, GRU, "algo=mappo"]).run_dir == "outputs/structured/mappo_gru/seed0"
