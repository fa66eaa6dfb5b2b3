import pytest
import torch
from test_round_trips import actions, leaves, stepped
from torchrl.envs.utils import check_env_specs

from softgm_bench.envs import entries, make_env
from softgm_bench.envs.perturbation import PerturbationConfig
from softgm_bench.rod.parameters import RodParameters

OBSERVED = (entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.PREVIOUS_ACTION)
CASES = ("none", "noise", "section_failure", "disturbance")


@pytest.fixture
def build(settings):
    def environment(case="none", *overrides, task="wall", num_envs=4, substeps=10, seed=0, **options):
        config = settings(f"task={task}", f"perturbation={case}", *overrides)
        rod = RodParameters(substeps=substeps)
        return make_env(config.task, rod, num_envs, seed, perturbation=config.perturbation, **options)

    return environment


def play(env, steps=12):
    """All frames, the reset's first; what is done does not begin again."""
    td = env.reset()
    frames = [leaves(td)]
    for action in actions(env, steps):
        td = env.step(td.exclude("next", "reward").set(entries.ACTION, action))["next"]
        frames.append(leaves(td))
    return frames


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


@pytest.mark.parametrize("case", CASES)
def test_specs_are_kept(build, case):
    check_env_specs(build(case))


@pytest.mark.parametrize("case", CASES[1:])
def test_scenes_are_those_without_a_perturbation_also_after_resets(build, case):
    ordinary, perturbed = build(horizon=3), build(case, horizon=3)
    for env in (ordinary, perturbed):
        td = env.reset()
        for action in actions(env, 7):
            _, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
    assert equal(leaves(ordinary.scene.to_tensordict()), leaves(perturbed.scene.to_tensordict()))


def test_a_perturbation_of_strength_zero_changes_no_bit(build):
    weak = build("noise", *(f"perturbation.{channel}_sigma=0" for channel in ("position", "velocity", "action")))
    assert not weak.tip_force.any()
    assert all(equal(one, other) for one, other in zip(play(weak), play(build()), strict=True))


def test_noise_has_the_settings_deviations_is_independent_and_reaches_nothing_else(build):
    frames, true = (play(env) for env in (build("noise", num_envs=200), build(num_envs=200)))
    for key, sigma in zip(OBSERVED, (0.1, 0.1, 0.2), strict=True):
        noise = torch.stack([one[key] - other[key] for one, other in zip(frames, true, strict=True)])
        count = noise.numel()
        assert abs(noise.mean()) < 4 * sigma / count**0.5
        assert abs(noise.std() / sigma - 1) < 4 / (2 * count) ** 0.5
        assert (noise[1:] - noise[:-1]).abs().min() > 0  # drawn anew in every frame
        columns = noise.movedim(0, -2).flatten(0, 1).flatten(-2)  # (environments x agents, steps x directions)
        assert torch.corrcoef(columns.T).fill_diagonal_(0).abs().max() < 5 / len(columns) ** 0.5
    for one, other in zip(frames, true, strict=True):
        assert equal(*({key: value for key, value in frame.items() if key not in OBSERVED} for frame in (one, other)))


def test_only_the_channels_with_a_deviation_are_noisy(build):
    frames = play(build("noise", "perturbation.velocity_sigma=0", "perturbation.action_sigma=0"))
    true = play(build())
    assert not torch.equal(frames[-1][entries.AGENT_POSITION], true[-1][entries.AGENT_POSITION])
    for key in OBSERVED[1:]:
        assert torch.equal(frames[-1][key], true[-1][key])


def test_a_section_that_failed_is_as_one_that_is_told_to_do_nothing(build):
    failing, told = build("section_failure", "perturbation.failed_agents=[2,5]"), build()
    one, other = failing.reset(), told.reset()
    for action in actions(told, 8):
        silent = action.clone()
        silent[:, [2, 5]] = 0.0
        one = failing.step(one.exclude("next", "reward").set(entries.ACTION, action))["next"]
        other = told.step(other.exclude("next", "reward").set(entries.ACTION, silent))["next"]
        assert equal(leaves(one.exclude("agents")), leaves(other.exclude("agents")))
        assert torch.equal(failing.applied_action, silent)
        assert torch.equal(one[entries.PREVIOUS_ACTION], silent)
    assert torch.equal(failing.rod.position, told.rod.position)


def test_the_push_has_its_strength_and_time_and_a_direction_of_its_own_in_every_episode(build):
    env = build("disturbance", task="basic", num_envs=500, horizon=13)
    td = env.reset()
    forces = []
    for action in actions(env, 26):
        _, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
        forces.append(env.tip_force)
    strength = torch.stack(forces).norm(dim=-1)
    pushed = torch.arange(26) % 13
    pushed = (pushed >= 5) & (pushed <= 10)
    torch.testing.assert_close(strength, torch.where(pushed, 15.0, 0.0).double()[:, None].expand_as(strength))
    assert all(torch.equal(forces[5], forces[step]) for step in range(5, 11))
    directions = torch.cat([forces[5], forces[18]]) / 15.0
    assert len(directions.unique(dim=0)) == 1000
    assert directions.mean(0).abs().max() < 4 / 3000**0.5  # all directions alike: variance 1/3 each
    torch.testing.assert_close(directions.T @ directions / 1000, torch.eye(3).double() / 3, atol=0.05, rtol=0)


def test_the_push_is_a_force_on_the_tip_node(build):
    env = build("disturbance", "perturbation.first_step=0", "perturbation.steps=1", task="basic", substeps=1)
    td = env.reset()
    state = env.rod.clone()
    env.step(td.set(entries.ACTION, torch.zeros(4, 6, 2)))
    force = torch.zeros_like(state.position)
    force[..., -1] = env.tip_force
    couple = torch.zeros(4, 3, 60, dtype=torch.float64)
    assert torch.equal(env.backend.control_step(state, couple, force=force).position, env.rod.position)
    moved = torch.nn.functional.normalize(env.rod.velocity[..., -1], dim=-1)
    torch.testing.assert_close(moved, env.tip_force / 15.0)


@pytest.mark.parametrize("case", ["noise", "disturbance"])
def test_what_is_drawn_repeats_with_the_environments_seed(build, case):
    first, again, other = play(build(case, seed=3), 8), play(build(case, seed=3), 8), build(case, seed=4)
    assert all(map(equal, first, again))
    assert not equal(play(other, 8)[-1], first[-1])
    one, two = build(case, seed=5), other
    for env in (one, two):
        env.set_seed(6)
    assert all(map(equal, play(one, 8), play(two, 8)))


def test_a_saved_state_goes_on_bit_by_bit(build):
    overrides = ("perturbation.tip_force=5", "perturbation.first_step=2", "perturbation.steps=6")

    def make(seed):
        return build("noise", *overrides, horizon=7, seed=seed)

    env, other = make(0), make(1)
    td = env.reset()
    for action in actions(env, 4):
        _, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
    other.reset()
    other.load_simulation_state(env.simulation_state())
    other.set_generator_state(env.generator_state())
    theirs = td.clone()
    for action in actions(env, 12):  # into the next episode
        _, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
        _, theirs = other.step_and_maybe_reset(theirs.set(entries.ACTION, action))
        assert equal(leaves(td), leaves(theirs))
        assert torch.equal(env.tip_force, other.tip_force)


@pytest.mark.parametrize("case", CASES[1:])
def test_neither_steps_nor_resets_wait_for_a_device(build, case):
    found, _ = stepped(build(case, horizon=3, stagger=True))
    assert found == []


def test_contacts_are_the_nodes_that_the_metric_counts(build):
    env = build(num_envs=16, substeps=100)
    td = env.reset()
    push = actions(env, 1)[0, :, :1].expand(16, 6, 2)
    for _ in range(25):
        td = env.step(td.exclude("next", "reward").set(entries.ACTION, push))["next"]
    touching = env.contacts()
    assert touching.any()
    assert torch.equal(touching.sum(-1, keepdim=True).float(), td[entries.CONTACT_NODES])
    assert not build(task="basic").contacts().any()


@pytest.mark.parametrize(
    ("values", "says"),
    [
        ({"name": "x", "position_sigma": -1.0}, "position_sigma is -1.0: it must be a number from 0 up"),
        ({"name": "x", "tip_force": float("nan")}, "tip_force is nan: it must be a number from 0 up"),
        ({"name": "x", "tip_force": 1.0}, r"steps is 0 with perturbation.tip_force=1.0"),
        ({"velocity_sigma": 0.1}, r"velocity_sigma is 0.1 with perturbation=none: add perturbation=noise"),
        ({"failed_agents": [0]}, r"failed_agents is \(0,\) with perturbation=none"),
        ({"name": "../x"}, "name is '../x': use letters and _, it becomes a folder's name"),
    ],
)
def test_values_that_make_no_sense_are_refused_in_one_line(values, says):
    with pytest.raises(ValueError, match=rf"^perturbation\.{says}[^\n]*$"):
        PerturbationConfig(**values)


def test_a_section_that_does_not_exist_cannot_fail(build):
    config = PerturbationConfig("x", failed_agents=(6,))
    with pytest.raises(ValueError, match=r"^perturbation.failed_agents holds 6: the 6 agents are 0 to 5$"):
        make_env(build().task.config, RodParameters(), 1, 0, perturbation=config)
