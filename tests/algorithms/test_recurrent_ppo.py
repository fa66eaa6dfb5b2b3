"""PPO with recurrent actors: learns from sequences, scores them as they were collected."""

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss

from dense import force_dense
from recordings import recordings
from softgm_bench.algorithms.ppo import ADVANTAGE
from softgm_bench.assembly import build_algorithm, build_env, configure
from softgm_bench.envs import entries
from softgm_bench.errors import UserError
from softgm_bench.upstream.collector import FrameCollector

pytestmark = pytest.mark.usefixtures("one_thread")

GRU = "algo.actor.memory={cell:gru,size:12}"
CASES = pytest.mark.parametrize(
    "case",  # an algorithm, a task, a model, and further settings
    [
        ("softgm", "wall", "softgm"),
        ("mappo", "structured", "mlp"),
        ("ippo", "wall", "mlp"),
        ("softgm", "wall", "softgm", "algo.actor.mirror=average"),
        ("softgm", "wall", "softgm", "algo.actor.mirror=canonical"),
        ("ippo", "vmas_balance", "vector_mlp"),
    ],
    ids="-".join,
)


@pytest.fixture
def build():
    made = []

    def algorithm(algo="mappo", task="basic", model="mlp", *overrides):
        if task.startswith("vmas"):
            pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
        settings = [f"algo={algo}", f"task={task}", f"model={model}", "recipe=paper", "rod.n_elements=20", GRU]
        config = configure([*settings, "algo.epochs=2", "algo.minibatch_size=16", *overrides])
        torch.manual_seed(0)
        env = build_env(config, 6, 0, 5, training=True)
        learner = build_algorithm(config, env)
        with torch.no_grad():
            for parameter in learner.policy.parameters():  # actions that depend on everything
                parameter.add_(0.3 * torch.randn_like(parameter))
        made.append(FrameCollector(env, learner.policy, 6 * 8))
        return learner, iter(made[-1])

    yield algorithm
    for collector in made:
        collector.shutdown()


@CASES
def test_collected_log_probabilities_are_those_of_the_sequence_with_resets_inside(build, case):
    learner, batches = build(*case)
    for batch in (next(batches), next(batches)):
        assert batch["next", entries.DONE][:, :-1].any()
        frames = learner.prepare(batch)
        log_prob = learner.policy.get_dist(frames.clone()).log_prob(frames[entries.ACTION])
        torch.testing.assert_close(log_prob, batch[entries.LOG_PROB], rtol=1e-5, atol=1e-5)
        losses = ClipPPOLoss.forward(learner.loss, frames.clone())
        assert losses["max_ratio"] == pytest.approx(1.0, abs=5e-5)
        forgotten = frames.clone().set(entries.IS_INIT, torch.ones_like(frames[entries.IS_INIT]))
        other = learner.policy.get_dist(forgotten).log_prob(frames[entries.ACTION])
        assert not torch.allclose(other, log_prob, atol=1e-2)  # it does remember


@CASES
def test_a_state_goes_from_step_to_step_and_a_new_episode_begins_without(build, case):
    learner, batches = build(*case)
    first, second = (next(batches).clone() for _ in range(2))
    batch = torch.cat([first, second], dim=1)
    assert torch.equal(batch[:, 1:][entries.MEMORY], batch[:, :-1][entries.NEXT_MEMORY])
    begins = batch[entries.IS_INIT].squeeze(-1)
    assert torch.equal(begins[:, 1:], batch["next", entries.DONE][:, :-1].squeeze(-1))
    assert begins[:, 0].all()
    # whatever came before: actions of an episode's first step are those of a policy that begins there
    frames = batch[begins]
    assert frames[entries.MEMORY].abs().sum() > 0.0
    fresh = frames.clone().set(entries.MEMORY, torch.zeros_like(frames[entries.MEMORY]))
    with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
        one, other = (learner.policy(td.select(*learner.policy.in_keys)) for td in (frames, fresh))
    assert torch.equal(one[entries.ACTION], other[entries.ACTION])
    assert torch.equal(one[entries.NEXT_MEMORY], other[entries.NEXT_MEMORY])


def test_minibatches_are_whole_environments_each_once_an_epoch(build):
    learner, batches = build()
    batch = next(batches)
    batch[entries.PREVIOUS_ACTION] = torch.arange(6.0).view(6, 1, 1, 1).expand(6, 8, 6, 2)
    seen, step = [], learner._step
    learner._step = lambda minibatch: seen.append(minibatch.clone()) or step(minibatch)
    learner.update(batch)
    assert [minibatch.shape for minibatch in seen] == [(2, 8)] * 6  # 16 frames, two epochs
    for epoch in (seen[:3], seen[3:]):
        rows = torch.cat([minibatch[entries.PREVIOUS_ACTION][..., 0, 0] for minibatch in epoch])
        assert (rows == rows[:, :1]).all()
        assert sorted(rows[:, 0].tolist()) == [0.0, 1.0, 2.0, 3.0, 4.0, 5.0]


@pytest.mark.parametrize("algo", ["softgm", "mappo", "ippo"])
def test_an_update_moves_the_memory_too_and_reports_what_it_did(build, algo):
    learner, batches = build(algo, "wall", "softgm" if algo == "softgm" else "mlp", "algo.value_norm_decay=0.9")
    batch = next(batches)
    before = [parameter.detach().clone() for parameter in learner.policy[0].head.memory.parameters()]
    metrics = learner.update(batch)
    after = learner.policy[0].head.memory.parameters()
    assert not any(torch.equal(old, new) for old, new in zip(before, after, strict=True))
    assert {"loss_objective", "entropy", "kl_approx", "actor_saturation"} <= set(metrics)
    assert all(torch.tensor(value).isfinite() for value in metrics.values())


def test_advantages_do_not_depend_on_the_order_of_frames(build):
    learner, batches = build()
    batch = next(batches)
    in_sequences = learner.prepare(batch)[ADVANTAGE]
    learner._in_sequences = False
    torch.testing.assert_close(in_sequences.flatten(0, 1), learner.prepare(batch)[ADVANTAGE])


def test_a_recorded_gradient_step_is_the_plain_one(build):
    found = []
    for graphs in (False, True):
        with force_dense(), recordings() as log:
            learner, batches = build("softgm", "wall", "softgm")
            batch = next(batches)
            if graphs:
                learner.use_graphs()
            torch.manual_seed(3)
            found.append(learner.update(batch))
    assert log.count("record") == 1
    assert found[1] == pytest.approx(found[0], rel=1e-3, abs=1e-4)


@pytest.mark.parametrize("algo", ["isac", "masac", "iddpg", "maddpg"])
def test_other_algorithms_refuse_a_memory_in_one_line(algo):
    said = rf"^algo\.actor\.memory with algo={algo}: recurrent actors are trained by PPO: ippo, mappo, softgm$"
    with pytest.raises(UserError, match=said):
        configure([f"algo={algo}", GRU])
