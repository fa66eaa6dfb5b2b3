"""A task that cannot be solved without memory is solved with it, by each agent for itself."""

import pytest
import torch
from cue import DELAY, N_AGENTS, CueEnv
from torchrl.envs.utils import check_env_specs

from softgm_bench.algorithms import PPO
from softgm_bench.envs import entries
from softgm_bench.episodes.evaluation import evaluate
from softgm_bench.models import VectorMLPConfig
from softgm_bench.upstream.collector import FrameCollector

pytestmark = pytest.mark.usefixtures("one_thread")

FAST = ("algo.actor_lr=0.003", "algo.critic_lr=0.003", "algo.epochs=4", "algo.minibatch_size=256", "algo.gamma=0.5")
FAST += ("algo.entropy_coeff=0.0", "algo.actor.widths=[32]", "algo.critic.widths=[32]")
ITERATIONS = 25
MEMORY = "algo.actor.memory={cell:gru,size:16}"


def learn(settings, iterations, *overrides):
    """The policy after so many iterations of 64 environments and two episodes, and its mean return."""
    torch.manual_seed(0)
    env = CueEnv(64)
    learner = PPO(settings("algo=ippo", *FAST, *overrides).algo, VectorMLPConfig(widths=[]), env)
    collector = FrameCollector(env, learner.policy, 64 * 2 * (DELAY + 1))
    batches = iter(collector)
    for _ in range(iterations):
        learner.update(next(batches))
    collector.shutdown()
    return learner.policy, evaluate(learner.policy, CueEnv(256), deterministic=True, seed=1)[
        "undiscounted_return"
    ].mean()


def test_the_task_is_an_environment_that_hands_memory_on():
    env = CueEnv(3)
    check_env_specs(env)
    frames = env.rollout(2 * (DELAY + 1), break_when_any_done=False)
    assert frames[entries.IS_INIT].squeeze(-1).nonzero()[:, 1].tolist() == [0, DELAY + 1] * 3
    assert frames["next", entries.REWARD].count_nonzero() == 3 * 2


def test_memory_solves_it(settings):
    policy, reached = learn(settings, ITERATIONS, MEMORY)
    assert reached > 0.9
    # by each agent's own: an agent's answer is that of its own cue, whatever the other's
    env = CueEnv(256, seed=2)
    frames = env.rollout(DELAY + 1, policy)
    answers = frames[entries.ACTION][:, DELAY, :, 0].sign()
    assert (answers == env.cue).float().mean() > 0.95
    assert 0.3 < (env.cue[:, 0] == env.cue[:, 1]).float().mean() < 0.7
    assert answers.shape == (256, N_AGENTS)


def test_without_memory_it_cannot_be_solved(settings):
    assert abs(learn(settings, ITERATIONS)[1]) < 0.2
