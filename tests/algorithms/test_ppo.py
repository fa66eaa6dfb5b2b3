import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import ClipPPOLoss

from round_trips import RoundTrips
from softgm_bench.algorithms.ppo import ADVANTAGE, PPO, VALUE_TARGET
from softgm_bench.envs import entries, make_env
from softgm_bench.models.heads import STATE_VALUE
from softgm_bench.rod.parameters import RodParameters

pytestmark = pytest.mark.usefixtures("one_thread")

SHORT = RodParameters(substeps=5)
NAMES = pytest.mark.parametrize("name", ["softgm", "ippo", "mappo"])


@pytest.fixture
def build(settings):
    def algorithm(task="wall", *overrides, num_envs=4, oracle=False):
        config = settings(f"task={task}", "algo.epochs=2", "algo.minibatch_size=16", *overrides)
        torch.manual_seed(0)
        env = make_env(config.task, SHORT, num_envs=num_envs, seed=0, horizon=7)
        return PPO(config.algo, config.model, env, oracle), env

    return algorithm


def collect(algorithm, env, steps=8):
    collector = Collector(
        env,
        algorithm.policy,
        frames_per_batch=env.batch_size[0] * steps,
        total_frames=env.batch_size[0] * steps,
        exploration_type=ExplorationType.RANDOM,
    )
    (batch,) = list(collector)
    collector.shutdown()
    return batch


@NAMES
@pytest.mark.parametrize("task", ["basic", "wall"])
def test_the_probability_ratio_is_one_on_fresh_frames(build, task, name):
    algorithm, env = build(task, f"algo={name}")
    losses = ClipPPOLoss.forward(algorithm.loss, algorithm.prepare(collect(algorithm, env)))
    assert losses["max_ratio"] == pytest.approx(1.0, abs=1e-5)
    assert losses["mean_ratio"] == pytest.approx(1.0, abs=1e-6)
    assert losses["clip_fraction"] == 0.0


def three_steps(batch, terminated=(False,) * 3, truncated=(False,) * 3, reward=(1.0, 3.0, 5.0)):
    """The first three frames of the first environment with other rewards and ends."""
    frames = batch[:1, :3].clone()
    frames["next", "reward"] = torch.tensor(reward).view(1, 3, 1)
    frames["next", "terminated"] = torch.tensor(terminated).view(1, 3, 1)
    frames["next", "truncated"] = torch.tensor(truncated).view(1, 3, 1)
    frames["next", "done"] = frames["next", "terminated"] | frames["next", "truncated"]
    return frames


HALVES = ("algo.gamma=0.5", "algo.gae_lambda=0.5", "algo.normalize_advantage=false")
AFTER_STEP_1 = (False, True, False)


@pytest.mark.parametrize("name", ["softgm", "mappo"])
def test_advantages_bootstrap_at_a_truncation_and_not_at_a_termination(build, name):
    """Three steps of one environment with a critic that says 2 everywhere, worked out by hand."""
    algorithm, env = build("basic", f"algo={name}", *HALVES)
    batch = collect(algorithm, env)
    for parameter in algorithm._critic_parameters:
        parameter.data.zero_()
    algorithm._critic_parameters[-1].data.fill_(2.0)  # the last bias

    def advantages(**ends):
        prepared = algorithm.prepare(three_steps(batch, **ends))
        assert torch.allclose(prepared[VALUE_TARGET], prepared[ADVANTAGE][:, 0] + 2.0)
        assert prepared[ADVANTAGE].shape == (3, 6, 1)
        return prepared[ADVANTAGE][:, 0, 0].tolist()

    # deltas r + 0.5 * 2 - 2 = 0, 2, 4; A2 = 4, A1 = 2 + 0.25 * 4, A0 = 0 + 0.25 * A1
    assert advantages() == pytest.approx([0.75, 3.0, 4.0])
    # its delta keeps the bootstrap, the sum stops there
    assert advantages(truncated=AFTER_STEP_1) == pytest.approx([0.5, 2.0, 4.0])
    # its delta is 3 - 2 = 1
    assert advantages(terminated=AFTER_STEP_1) == pytest.approx([0.25, 1.0, 4.0])


def test_every_agent_of_ippo_has_its_own_advantage_of_the_teams_reward(build):
    """The same three steps with values 2 (agent 0) and 4 (agent 1) everywhere, worked out by hand."""
    algorithm, env = build("basic", "algo=ippo", "task.n_agents=2", *HALVES)
    batch = collect(algorithm, env)
    algorithm._values = lambda td: torch.tensor([[2.0], [4.0]]).expand(*td.shape, 2, 1)

    def advantages(**ends):
        prepared = algorithm.prepare(three_steps(batch, **ends))
        assert prepared[ADVANTAGE].shape == prepared[VALUE_TARGET].shape == (3, 2, 1)
        assert torch.allclose(prepared[VALUE_TARGET] - prepared[ADVANTAGE], torch.tensor([[2.0], [4.0]]))
        return prepared[ADVANTAGE][:, :, 0].T.flatten().tolist()

    # agent 1: deltas r + 0.5 * 4 - 4 = -1, 1, 3; A2 = 3, A1 = 1 + 0.25 * 3, A0 = -1 + 0.25 * A1
    assert advantages() == pytest.approx([0.75, 3.0, 4.0, -0.5625, 1.75, 3.0])
    assert advantages(truncated=AFTER_STEP_1) == pytest.approx([0.5, 2.0, 4.0, -0.75, 1.0, 3.0])
    # agent 1: the delta of step 1 is 3 - 4 = -1
    assert advantages(terminated=AFTER_STEP_1) == pytest.approx([0.25, 1.0, 4.0, -1.25, -1.0, 3.0])


def test_normalised_value_targets_follow_debiased_averages(build):
    """gamma = 0 makes the targets the rewards; two updates with decay 1/2, worked out by hand."""
    algorithm, env = build("basic", "algo.gamma=0.0", "algo.value_norm_decay=0.5")
    batch = collect(algorithm, env)

    def targets(*reward):
        return algorithm.prepare(three_steps(batch, reward=reward))[VALUE_TARGET].flatten().tolist()

    # averages 0.5 * 3 and 0.5 * 35/3 over a weight of 0.5: mean 3, variance 35/3 - 9 = 8/3
    assert targets(1.0, 3.0, 5.0) == pytest.approx([-2 / (8 / 3) ** 0.5, 0.0, 2 / (8 / 3) ** 0.5], abs=1e-5)
    # mean (0.25 * 3 + 0.5 * 8) / 0.75 = 19/3, square (0.25 * 35/3 + 0.5 * 66) / 0.75 = 431/9, variance 70/9
    assert targets(7.0, 7.0, 10.0) == pytest.approx(
        [(2 / 3) / (70 / 9) ** 0.5, (2 / 3) / (70 / 9) ** 0.5, (11 / 3) / (70 / 9) ** 0.5], abs=1e-5
    )
    # and what the critic says is read in that scale
    raw = algorithm.critic(batch.clone())[STATE_VALUE]
    torch.testing.assert_close(algorithm._values(batch), raw * (70 / 9) ** 0.5 + 19 / 3, rtol=1e-4, atol=1e-4)


def test_clipping_takes_the_smaller_gain_of_each_agent(build):
    """Ratios 1.5 and 0.5 with advantages of either sign: min(r A, clip(r, 0.8, 1.2) A), by hand."""
    algorithm, env = build("basic", "algo.entropy_coeff=0.0")
    frames = algorithm.prepare(collect(algorithm, env))[:2]
    log_prob = frames[entries.LOG_PROB]
    shift = torch.full_like(log_prob, -torch.tensor(1.5).log().item())
    shift[1] = -torch.tensor(0.5).log().item()
    frames[entries.LOG_PROB] = log_prob + shift
    for advantages, gains in (((1.0, 1.0), (1.2, 0.5)), ((-1.0, -1.0), (-1.5, -0.8))):
        frames[ADVANTAGE] = torch.tensor(advantages).view(2, 1, 1).expand(2, 6, 1)
        loss = algorithm.loss(frames)["loss_objective"]
        assert loss.item() == pytest.approx(-sum(gains) / 2, rel=1e-4)


@NAMES
def test_an_update_moves_actor_and_critic_and_reports_what_it_did(build, name):
    algorithm, env = build("wall", f"algo={name}")
    batch = collect(algorithm, env)
    before = [p.detach().clone() for p in (*algorithm._actor_parameters, *algorithm._critic_parameters)]
    metrics = algorithm.update(batch)
    after = [*algorithm._actor_parameters, *algorithm._critic_parameters]
    assert sum(not torch.equal(a, b) for a, b in zip(before, after, strict=True)) > 0.8 * len(before)
    expected = {"loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction", "actor_saturation"}
    assert expected <= set(metrics)
    assert all(torch.tensor(value).isfinite() for value in metrics.values())


def test_an_algorithm_goes_on_bit_for_bit_from_its_saved_state(build):
    stateful = ("algo.value_norm_decay=0.9", "algo.lr_schedule=linear", "algo.target_kl=1.0e-6")
    algorithm, env = build("wall", *stateful)
    batch = collect(algorithm, env)
    algorithm.update(batch)
    saved = {name: _copy(value) for name, value in algorithm.state_dict().items()}

    def proceed(one):
        torch.manual_seed(5)
        return one.update(batch)

    expected = proceed(algorithm)
    other, _ = build("wall", *stateful)
    other.update(batch)
    other.update(batch)
    other.load_state_dict(saved)
    assert proceed(other) == expected


def _copy(value):
    if isinstance(value, dict):
        return {name: _copy(item) for name, item in value.items()}
    return value.clone() if isinstance(value, torch.Tensor | TensorDict) else value


@pytest.mark.parametrize("name", ["softgm", "mappo"])
def test_the_value_of_a_centralised_critic_is_one_number_for_the_team(build, name):
    algorithm, env = build("wall", f"algo={name}")
    frames = algorithm.prepare(collect(algorithm, env))
    assert frames[VALUE_TARGET].shape == (len(frames), 1)
    assert frames[ADVANTAGE].shape == (len(frames), 6, 1)
    assert (frames[ADVANTAGE] == frames[ADVANTAGE][:, :1]).all()
    assert abs(frames[ADVANTAGE].mean().item()) < 1e-5


def test_the_actors_learning_rate_falls_until_updates_stay_near_the_target_and_never_exceeds_its_setting(build):
    algorithm, env = build("basic", "algo.target_kl=1.0e-6", "algo.actor_lr=1.0e-3")
    batch = collect(algorithm, env)
    rates = [algorithm.update(batch)["actor_lr"] for _ in range(3)]
    assert rates == pytest.approx([1e-3 / 1.2, 1e-3 / 1.2**2, 1e-3 / 1.2**3])
    patient, _ = build("basic", "algo.target_kl=1000.0", "algo.actor_lr=1.0e-3")
    assert patient.update(batch)["actor_lr"] == 1e-3


def test_learning_rates_fall_linearly_with_the_frames_learnt_from(build):
    schedule = ("algo.lr_schedule=linear", "algo.lr_schedule_frames=80")
    algorithm, env = build("basic", *schedule, "algo.actor_lr=1.0e-3", "algo.critic_lr=2.0e-3")
    batch = collect(algorithm, env)  # 32 frames
    rates = [(metrics["actor_lr"], metrics["critic_lr"]) for metrics in (algorithm.update(batch) for _ in range(3))]
    assert rates == [pytest.approx(pair) for pair in ((6e-4, 1.2e-3), (2e-4, 4e-4), (0.0, 0.0))]
    constant, _ = build("basic", "algo.actor_lr=1.0e-3")
    assert [constant.update(batch)["actor_lr"] for _ in range(3)] == [1e-3] * 3
    both, _ = build("basic", *schedule, "algo.actor_lr=1.0e-3", "algo.target_kl=1.0e-6")
    assert both.update(batch)["actor_lr"] == pytest.approx(6e-4 / 1.2)


def told_otherwise(frames):
    changed = frames.clone()
    changed[entries.PRIVILEGED] = frames[entries.PRIVILEGED] + 1.0
    return changed


@NAMES
def test_an_asymmetric_critic_is_told_what_the_actor_is_not(build, name):
    algorithm, env = build("wall", f"algo={name}", "algo.critic.asymmetric=true")
    frames = collect(algorithm, env).reshape(-1)
    other = told_otherwise(frames)
    assert not torch.isclose(algorithm._values(frames), algorithm._values(other)).any()
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert torch.equal(algorithm.policy(frames.clone())[entries.ACTION], algorithm.policy(other)[entries.ACTION])
    assert entries.PRIVILEGED not in algorithm.policy.in_keys
    algorithm.update(collect(algorithm, env))


@NAMES
def test_without_it_neither_actor_nor_critic_reads_what_is_privileged(build, name):
    algorithm, env = build("wall", f"algo={name}")
    assert set(algorithm.policy.in_keys) == set(algorithm.critic.in_keys) == set(entries.OBSERVATION)
    frames = collect(algorithm, env).select(*entries.OBSERVATION)
    assert algorithm._values(frames).isfinite().all()
    assert algorithm.policy(frames)[entries.ACTION].isfinite().all()


@NAMES
def test_an_oracle_is_told_and_learns_from_it(build, name):
    algorithm, env = build("wall", f"algo={name}", oracle=True)
    batch = collect(algorithm, env)
    other = told_otherwise(batch)
    with set_exploration_type(ExplorationType.DETERMINISTIC):
        assert not torch.equal(algorithm.policy(batch.clone())[entries.ACTION], algorithm.policy(other)[entries.ACTION])
    losses = ClipPPOLoss.forward(algorithm.loss, algorithm.prepare(batch))
    assert losses["max_ratio"] == pytest.approx(1.0, abs=1e-5)
    algorithm.update(batch)


def test_a_task_without_secrets_has_no_privileged_entry_to_read(build):
    algorithm, env = build("basic", "algo.critic.asymmetric=true", oracle=True)
    assert env.sizes.n_privileged == 0
    algorithm.update(collect(algorithm, env))


def test_clipped_advantages_are_standardised_again_only_if_they_were_before(build):
    raw = build("basic", "algo.normalize_advantage=false", "algo.advantage_clip=0.05")
    advantage = raw[0].prepare(collect(*raw))[ADVANTAGE]
    assert advantage.abs().max() == pytest.approx(0.05)
    standardised = build("basic", "algo.advantage_clip=0.5")
    advantage = standardised[0].prepare(collect(*standardised))[ADVANTAGE][:, 0]
    assert advantage.mean().abs() < 1e-5
    assert advantage.std() == pytest.approx(1.0, abs=1e-4)


@pytest.mark.parametrize("model", ["mlp", "softgm"])
def test_an_update_itself_never_waits_for_a_device_before_all_minibatches_are_done(build, model):
    """What waits lies in libraries and in SoftGM's packing of edges, see docs/environment.md."""
    algorithm, env = build("basic", f"model={model}", "algo.value_norm_decay=0.9", "algo.lr_schedule=linear")
    algorithm.update(collect(algorithm, env))
    optimizers = (algorithm.actor_optimizer, algorithm.critic_optimizer)
    steps = tuple(state["step"] for optimizer in optimizers for state in optimizer.state.values())  # on the CPU
    batch = collect(algorithm, env)
    with RoundTrips(exempt=steps) as trips:
        algorithm.update(batch)
    assert {found.split(" ")[2].split(":")[0] for found in trips.found} <= {"continuous.py", "graph.py"}


def test_without_an_entropy_bonus_the_entropy_is_that_of_the_frames_and_gradients_are_the_same(build):
    """At zero, the term that TorchRL's loss would draw samples for adds nothing to any gradient."""
    algorithm, env = build("basic", "algo.entropy_coeff=0.0")
    batch = collect(algorithm, env)
    reported = algorithm.update(batch)
    assert reported["entropy"] == pytest.approx(-float(batch[entries.LOG_PROB].mean()), rel=1e-6)
    assert reported["loss_entropy"] == 0.0
    frames = algorithm.prepare(batch)
    gradients = []
    for bonus in (False, True):
        algorithm.loss.entropy_bonus = bonus
        losses = algorithm.loss(frames)
        algorithm.loss.zero_grad()
        sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
        gradients.append([p.grad.clone() for p in algorithm.loss.parameters()])
    assert all(torch.equal(without, with_it) for without, with_it in zip(*gradients, strict=True))


def test_reported_losses_are_the_means_over_the_minibatches_of_each_epoch_and_over_epochs(build):
    algorithm, env = build("basic", "algo.entropy_coeff=0.0")
    seen = []
    step = algorithm._step
    algorithm._step = lambda minibatch: seen.append(step(minibatch)) or seen[-1]
    reported = algorithm.update(collect(algorithm, env))
    assert len(seen) == 4  # two epochs of two minibatches
    for name, mean in zip(algorithm._names, torch.stack(seen).view(2, 2, -1).mean(1).mean(0).tolist(), strict=True):
        assert reported[name] == pytest.approx(mean, rel=1e-6, abs=1e-9)
