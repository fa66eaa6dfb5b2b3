import pytest
import torch
from tensordict import TensorDict
from torchrl.collectors import Collector
from torchrl.envs.utils import ExplorationType

from round_trips import RoundTrips
from softgm_bench.algorithms.ppo import ADVANTAGE, PPO, VALUE_TARGET
from softgm_bench.envs import keys, make_env
from softgm_bench.rod.parameters import RodParameters

SHORT = RodParameters(substeps=5)


@pytest.fixture
def build(settings):
    def algorithm(task="wall", *overrides, num_envs=4):
        config = settings(f"task={task}", "algo.epochs=2", "algo.minibatch_size=16", *overrides)
        torch.manual_seed(0)
        env = make_env(config.task, SHORT, num_envs=num_envs, seed=0, horizon=7)
        return PPO(config.algo, config.model, env), env

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


@pytest.mark.parametrize("task", ["basic", "wall"])
def test_the_probability_ratio_is_one_on_fresh_frames(build, task):
    algorithm, env = build(task)
    losses = algorithm.loss(algorithm.prepare(collect(algorithm, env)))
    assert losses["max_ratio"] == pytest.approx(1.0, abs=1e-5)
    assert losses["mean_ratio"] == pytest.approx(1.0, abs=1e-6)
    assert losses["clip_fraction"] == 0.0


def test_advantages_bootstrap_at_a_truncation_and_not_at_a_termination(build):
    """Three steps of one environment with a critic that says 2 everywhere, worked out by hand."""
    algorithm, env = build("basic", "algo.gamma=0.5", "algo.gae_lambda=0.5", "algo.normalize_advantage=false")
    batch = collect(algorithm, env)[:1, :3]
    for parameter in algorithm._critic_parameters:
        parameter.data.zero_()
    algorithm._critic_parameters[-1].data.fill_(2.0)  # the last bias

    def advantages(terminated, truncated):
        frames = batch.clone()
        frames["next", "reward"] = torch.tensor([[[1.0], [3.0], [5.0]]])
        frames["next", "terminated"] = torch.tensor(terminated).view(1, 3, 1)
        frames["next", "truncated"] = torch.tensor(truncated).view(1, 3, 1)
        frames["next", "done"] = frames["next", "terminated"] | frames["next", "truncated"]
        prepared = algorithm.prepare(frames)
        assert torch.allclose(prepared[VALUE_TARGET], prepared[ADVANTAGE][:, 0] + 2.0)
        assert prepared[ADVANTAGE].shape == (3, 6, 1)
        return prepared[ADVANTAGE][:, 0, 0].tolist()

    no, yes = False, True
    # deltas r + 0.5 * 2 - 2 = 0, 2, 4; A2 = 4, A1 = 2 + 0.25 * 4, A0 = 0 + 0.25 * A1
    assert advantages([no, no, no], [no, no, no]) == pytest.approx([0.75, 3.0, 4.0])
    # truncated after step 1: its delta keeps the bootstrap, the sum stops there
    assert advantages([no, no, no], [no, yes, no]) == pytest.approx([0.5, 2.0, 4.0])
    # terminated after step 1: its delta is 3 - 2 = 1
    assert advantages([no, yes, no], [no, no, no]) == pytest.approx([0.25, 1.0, 4.0])


def test_clipping_takes_the_smaller_gain_of_each_agent(build):
    """Ratios 1.5 and 0.5 with advantages of either sign: min(r A, clip(r, 0.8, 1.2) A), by hand."""
    algorithm, env = build("basic", "algo.entropy_coeff=0.0")
    frames = algorithm.prepare(collect(algorithm, env))[:2]
    log_prob = frames[keys.LOG_PROB]
    shift = torch.full_like(log_prob, -torch.tensor(1.5).log().item())
    shift[1] = -torch.tensor(0.5).log().item()
    frames[keys.LOG_PROB] = log_prob + shift
    for advantages, gains in (((1.0, 1.0), (1.2, 0.5)), ((-1.0, -1.0), (-1.5, -0.8))):
        frames[ADVANTAGE] = torch.tensor(advantages).view(2, 1, 1).expand(2, 6, 1)
        loss = algorithm.loss(frames)["loss_objective"]
        assert loss.item() == pytest.approx(-sum(gains) / 2, rel=1e-4)


def test_an_update_moves_actor_and_critic_and_reports_what_it_did(build):
    algorithm, env = build()
    batch = collect(algorithm, env)
    before = [p.detach().clone() for p in (*algorithm._actor_parameters, *algorithm._critic_parameters)]
    metrics = algorithm.update(batch)
    after = [*algorithm._actor_parameters, *algorithm._critic_parameters]
    assert sum(not torch.equal(a, b) for a, b in zip(before, after, strict=True)) > 0.8 * len(before)
    expected = {"loss_objective", "loss_critic", "loss_entropy", "entropy", "kl_approx", "clip_fraction"}
    assert expected <= set(metrics)
    assert all(torch.tensor(value).isfinite() for value in metrics.values())


def test_an_algorithm_goes_on_bit_for_bit_from_its_saved_state(build):
    algorithm, env = build()
    batch = collect(algorithm, env)
    algorithm.update(batch)
    saved = {name: _copy(value) for name, value in algorithm.state_dict().items()}

    def proceed(one):
        torch.manual_seed(5)
        return one.update(batch)

    expected = proceed(algorithm)
    other, _ = build("wall")
    other.update(batch)
    other.load_state_dict(saved)
    assert proceed(other) == expected


def _copy(value):
    if isinstance(value, dict):
        return {name: _copy(item) for name, item in value.items()}
    return value.clone() if isinstance(value, torch.Tensor | TensorDict) else value


def test_the_value_of_a_state_is_one_number_for_the_team(build):
    algorithm, env = build()
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
    algorithm, env = build("basic", f"model={model}")
    algorithm.update(collect(algorithm, env))
    optimizers = (algorithm.actor_optimizer, algorithm.critic_optimizer)
    steps = tuple(state["step"] for optimizer in optimizers for state in optimizer.state.values())  # on the CPU
    batch = collect(algorithm, env)
    with RoundTrips(exempt=steps) as trips:
        algorithm.update(batch)
    assert {found.split(" ")[2].split(":")[0] for found in trips.found} <= {
        "continuous.py",
        "advantages.py",
        "graph.py",
    }


def test_reported_losses_are_the_means_over_the_minibatches_of_each_epoch_and_over_epochs(build):
    algorithm, env = build("basic", "algo.entropy_coeff=0.0")
    seen = []
    step = algorithm._step
    algorithm._step = lambda minibatch: seen.append(step(minibatch)) or seen[-1]
    reported = algorithm.update(collect(algorithm, env))
    assert len(seen) == 4  # two epochs of two minibatches
    for name in ("loss_objective", "loss_critic", "kl_approx", "actor_grad_norm"):
        assert reported[name] == pytest.approx(sum(float(metrics[name]) for metrics in seen) / 4, rel=1e-6, abs=1e-9)
