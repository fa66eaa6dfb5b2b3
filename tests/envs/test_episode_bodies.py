"""Every episode's own body: drawn at resets, told in the frames, played by every backend, and nothing where none is."""

import pytest
import torch
from test_round_trips import actions, leaves, stepped
from torchrl.envs.utils import check_env_specs

from dense import force_dense
from softgm_bench.envs import entries, make_env
from softgm_bench.envs.tasks import TASK_CONFIGS
from softgm_bench.rod.bodies import Bodies, scales
from softgm_bench.rod.contact import element_radius
from softgm_bench.rod.contact_nodes import contact_nodes
from softgm_bench.rod.parameters import RodParameters, rod_constants
from softgm_bench.rod.randomise import FACTORS

pytestmark = pytest.mark.usefixtures("one_thread")


@pytest.fixture
def build(settings):
    def environment(randomise="wide", *overrides, task="wall", num_envs=4, substeps=10, seed=0, **options):
        config = settings(f"task={task}", f"randomise={randomise}", *overrides)
        rod = RodParameters(substeps=substeps)
        return make_env(
            config.task, rod, num_envs, seed, perturbation=config.perturbation, randomise=config.randomise, **options
        )

    return environment


def play(env, steps):
    """Frames after each step, resets within."""
    td, frames = env.reset(), []
    for action in actions(env, steps):
        stepped, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
        frames.append(leaves(stepped))
    return frames, td


def equal(one, other):
    return one.keys() == other.keys() and all(torch.equal(one[key], other[key]) for key in one)


@pytest.mark.parametrize("randomise", ["none", "moderate"])
def test_specs_are_kept(build, randomise):
    check_env_specs(build(randomise))


def test_without_ranges_nothing_is_drawn_and_no_entry_is_there(build):
    env = build("none")
    frame = env.reset()
    assert env.body.shape == (4, 0)
    assert len(env.generators()) == 1
    assert not set(entries.BODY.values()) & set(leaves(frame))


def test_scenes_are_those_without_bodies_also_after_resets(build):
    ordinary, randomised = build("none", horizon=3), build("wide", horizon=3)
    for env in (ordinary, randomised):
        play(env, 7)
    assert equal(leaves(ordinary.scene.to_tensordict()), leaves(randomised.scene.to_tensordict()))


def test_a_reset_draws_a_body_for_its_environment_alone_and_frames_tell_it(build):
    env = build()
    td = env.reset()
    bodies = [env.body.clone()]
    assert len(env.body.unique(dim=0)) == 4
    td["_reset"] = torch.tensor([[False], [True], [False], [True]])
    td = env.reset(td)
    bodies.append(env.body.clone())
    assert (bodies[0] != bodies[1]).any(dim=-1).tolist() == [False, True, False, True]
    td = env.step(td.set(entries.ACTION, actions(env, 1)[0]))["next"]
    assert torch.equal(env.body, bodies[1])
    told = torch.cat([td[entries.BODY[name]] for name in FACTORS], dim=-1)
    assert torch.equal(told.double(), env.body)  # float32, and still exactly what was simulated


def test_what_is_drawn_repeats_with_the_environments_seed(build):
    def drawn(env):
        env.reset()
        return env.body

    first, again, other = (drawn(build(seed=seed)) for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)
    one, two = build(seed=5), build(seed=6)
    for env in (one, two):
        env.set_seed(7)
    assert torch.equal(drawn(one), drawn(two))
    assert not torch.equal(drawn(one), drawn(build(seed=7)))  # the second episodes' are others than the first's


def test_a_saved_state_goes_on_bit_by_bit(build):
    env, other = (build("wide", "perturbation=noise", horizon=5, seed=seed) for seed in (0, 1))
    _, td = play(env, 4)
    other.reset()
    other.load_simulation_state(env.simulation_state())
    other.set_generator_state(env.generator_state())
    assert len(env.generator_state()) == 3  # scenes, noise, bodies
    theirs = td.clone()
    for action in actions(env, 9):  # into the episode after the next
        _, td = env.step_and_maybe_reset(td.set(entries.ACTION, action))
        _, theirs = other.step_and_maybe_reset(theirs.set(entries.ACTION, action))
        assert equal(leaves(td), leaves(theirs))
        assert torch.equal(env.body, other.body)


def test_a_checkpoint_of_before_there_were_bodies_is_read(build):
    env, other = build("none"), build("none", seed=1)
    _, td = play(env, 2)
    state = env.simulation_state()
    del state["episodes", "body"]
    other.reset()
    other.load_simulation_state(state)
    assert torch.equal(env.rod.position, other.rod.position)
    action = actions(env, 1)[0]
    assert equal(*(leaves(one.step(td.clone().set(entries.ACTION, action))) for one in (env, other)))


def test_neither_steps_nor_resets_wait_for_a_device(build):
    found, _ = stepped(build("wide", horizon=3, stagger=True))
    assert found == []


def test_the_torque_limit_is_on_the_arm_and_in_the_metrics(build):
    """Half the action with twice the limit is the same couple and the same torque."""
    strong, nominal = (
        build("none", "randomise.name=strong", f"randomise.max_torque=[{factor},{factor}]", task="basic")
        for factor in (2.0, 1.0)
    )
    assert nominal.simulator.randomise is None
    action = actions(nominal, 1)[0]
    after = [
        env.step(env.reset().set(entries.ACTION, given))["next"]
        for env, given in ((strong, 0.5 * action), (nominal, action))
    ]
    torch.testing.assert_close(strong.rod.omega, nominal.rod.omega, rtol=1e-9, atol=1e-12)
    for key in (entries.TORQUE_PER_AGENT, entries.TORQUE_JOINT):
        torch.testing.assert_close(*(frame[key] for frame in after))


@pytest.mark.parametrize("task", ["basic", "wall"])
def test_a_closed_loop_in_pyelastica_is_that_of_the_fused_kernel_resets_included(build, task):
    overrides = ("task.wall_x=0.2",) if task == "wall" else ()
    envs = [
        build("wide", *overrides, task=task, num_envs=2, substeps=100, horizon=9, backend=name)
        for name in ("numba", "pyelastica")
    ]
    frames, touched, bodies = [env.reset() for env in envs], False, []
    for _ in range(11):
        action = torch.full((2, 6, 2), 0.1)
        action[..., 0] = 0.95
        both = [
            env.step_and_maybe_reset(frame.set(entries.ACTION, action)) for env, frame in zip(envs, frames, strict=True)
        ]
        ours, theirs = (env.rod for env in envs)
        for name, bound in {"position": 1e-10, "director": 1e-10, "velocity": 1e-7, "omega": 1e-7}.items():
            assert (getattr(ours, name) - getattr(theirs, name)).abs().max() < bound, name
        assert torch.equal(*(env.body for env in envs))
        assert torch.equal(*(done["next"][entries.CONTACT_NODES] for done, _ in both))
        bodies.append(envs[0].body.clone())
        touched |= bool(both[1][0]["next"][entries.CONTACT_NODES].any())
        frames = [following for _, following in both]
    assert not torch.equal(bodies[0], bodies[-1])
    assert touched == (task == "wall")


def test_friction_of_the_task_is_what_is_multiplied(settings):
    surface = ("task.friction_coefficient=0.3", "task.velocity_damping_coefficient=10.0")
    drawn = ("randomise.name=slippery", "randomise.friction_coefficient=[0.5,2.0]")
    config = settings("task=wall", *surface, *drawn)
    env = make_env(config.task, config.rod, 5, 0, randomise=config.randomise)
    env.reset()
    column = FACTORS.index("friction_coefficient")
    assert len(env.body[:, column].unique()) == 5
    bodies = Bodies(*env.body[:, : len(Bodies._fields)].unbind(-1))
    arms = [bodies.arm(env.backend.parameters, row).friction_coefficient for row in range(5)]
    assert arms == pytest.approx((0.3 * env.body[:, column]).tolist())


@pytest.mark.parametrize("dense", [False, True], ids=["compiled", "dense"])
def test_contact_is_told_with_each_bodys_own_radius(build, dense):
    env = build()
    env.reset()
    episodes = env.simulator.state.episodes
    volume = torch.as_tensor(rod_constants(env.backend.parameters).volume)
    own = scales(Bodies(*env.body[:, :5].unbind(-1)), env.backend.parameters).volume[:, None] * volume
    radius = element_radius(episodes.rod.position, own)
    torch.testing.assert_close(radius[:, 0], 0.05 * env.body[:, FACTORS.index("base_radius")])
    cylinders = episodes.scene.cylinders.clone()
    cylinders.start[:, 0, 0] = 0.04 + 0.5 * (radius.min() + radius.max())  # touches the fat ones alone
    cylinders.start[:, 0, 1:] = torch.tensor([0.0, -0.2], dtype=torch.float64)
    cylinders.length[:, 0], cylinders.mask[:] = 1.4, False
    cylinders.mask[:, 0] = True
    episodes.scene.cylinders = cylinders
    with force_dense() if dense else torch.no_grad():
        found = env.contacts()
    assert torch.equal(found.any(dim=-1), radius[:, 0] > 0.5 * (radius.min() + radius.max()))
    assert found.any()
    for row in range(4):
        alone = [x[row : row + 1] for x in (episodes.rod.position, own, cylinders)]
        assert torch.equal(found[row : row + 1], contact_nodes(*alone))


def test_every_task_of_the_arm_takes_bodies(build):
    for task in TASK_CONFIGS:
        env = build("moderate", task=task, num_envs=2, substeps=1)
        frame = env.step(env.reset().set(entries.ACTION, torch.zeros(2, 6, 2)))["next"]
        assert frame[entries.BODY["density"]].shape == (2, 1)
