import pytest
import torch
from torchrl.envs.utils import ExplorationType, check_env_specs, set_exploration_type, step_mdp

from every_task import TASKS
from pairwise import partly
from softgm_bench.envs import entries, make_env
from softgm_bench.models.heads import build_actor
from softgm_bench.rod.parameters import RodParameters

SHORT = RodParameters(substeps=10)  # a tenth of a control step: these tests are about the environment


@pytest.fixture
def build(settings):
    def environment(task="wall", num_envs=4, seed=0, overrides=(), rod=SHORT, **options):
        config = settings(f"task={task}", *overrides)
        return make_env(config.task, rod, num_envs=num_envs, seed=seed, **options)

    return environment


def act(env, td, action):
    """One step from ``td``, which is left as it is."""
    return env.step(td.exclude("reward").clone().set(entries.ACTION, action))["next"]


def random_actions(env, steps, seed=0):
    generator = torch.Generator().manual_seed(seed)
    shape = (steps, *env.batch_size, env.sizes.n_agents, 2)
    return 2.0 * torch.rand(shape, generator=generator) - 1.0


def play(env, actions):
    td = env.reset()
    frames = []
    for action in actions:
        td = act(env, td, action)
        frames.append(td)
    return torch.stack(frames)


def edit(env, change):
    """Apply ``change`` to a copy of the simulation's state and go on from it."""
    state = env.simulation_state()
    change(state)
    env.load_simulation_state(state)


@pytest.mark.parametrize("task", TASKS)
@pytest.mark.parametrize(
    "options",
    [
        pytest.param({}, id="float64"),
        # other tests have this kernel compiled already
        pytest.param({"dtype": torch.float32, "rod": RodParameters(n_elements=20)}, id="float32, 20 elements"),
        pytest.param({"dtype": torch.float32}, id="float32", marks=pytest.mark.slow),
    ],
)
def test_specs_are_kept(build, task, options):
    check_env_specs(build(task, **options))


def test_the_torch_backend_makes_the_same_episodes(build):
    actions = random_actions(build(), 3)
    fused, reference = (play(build(backend=name), actions) for name in ("numba", "torch"))
    assert torch.allclose(fused["tip"], reference["tip"], atol=1e-6)
    assert torch.equal(fused["agents", "edge"], reference["agents", "edge"])


@pytest.mark.parametrize("n_agents", [1, 2, 4, 9])
@pytest.mark.parametrize("n_elements", partly([11, 20, 60], [20, 60]))
def test_agents_and_elements_are_parameters(build, n_agents, n_elements):
    rod = RodParameters(n_elements=n_elements, substeps=5)
    env = build("structured", overrides=(f"task.n_agents={n_agents}", "task.slots=5"), rod=rod)
    td = play(env, random_actions(env, 2))
    assert td[entries.AGENT_POSITION].shape == (2, 4, n_agents, 3)
    assert td[entries.EDGE].shape == (2, 4, n_agents, 5)
    assert td[entries.AGENT_POSITION].isfinite().all()


def test_agents_sit_on_the_nodes_nearest_to_their_control_points(build):
    td = build("basic").reset()
    expected = torch.tensor([9, 17, 26, 34, 43, 51]) / 60  # i * 60 / 7, rounded
    assert torch.allclose(td[entries.AGENT_POSITION][0, :, 2], expected)
    assert torch.equal(td["tip"][0], torch.tensor([0.0, 0.0, 1.0]))


def test_the_reward_is_the_sum_of_its_terms(build):
    env = build("wall", rod=RodParameters())
    td = play(env, random_actions(env, 5))
    total = sum(td["reward_terms", name] for name in entries.REWARD_TERM_NAMES)
    assert torch.allclose(td["reward"], total, atol=1e-6)


def test_both_torque_metrics_are_norms_of_the_applied_torque(build):
    env = build("basic")
    td = act(env, env.reset(), torch.ones(4, 6, 2))
    assert torch.allclose(td[entries.TORQUE_PER_AGENT], torch.tensor(25.0 * 2**0.5))
    assert torch.allclose(td[entries.TORQUE_JOINT], torch.tensor(25.0 * 12**0.5))


def test_success_terminates_pays_and_is_not_a_truncation(build):
    env = build("basic", horizon=1)
    td = env.reset()

    def aim(state):
        state["episodes", "scene", "target"][1] = torch.tensor([0.0, 0.01, 0.99])

    edit(env, aim)
    td = act(env, td, torch.zeros(4, 6, 2))
    assert td[entries.SUCCESS].squeeze(-1).tolist() == [False, True, False, False]
    assert torch.equal(td["terminated"], td[entries.SUCCESS])
    assert torch.equal(td["truncated"], ~td[entries.SUCCESS])
    assert td["done"].all()
    assert td["reward_terms", "success"].squeeze(-1).tolist() == [0.0, 50.0, 0.0, 0.0]


def test_an_environment_that_is_done_stands_still_until_it_is_reset(build):
    env = build("basic", horizon=2)
    td = env.reset()
    for action in random_actions(env, 2):
        td = step_mdp(env.step(td.set(entries.ACTION, action)))
    state = env.simulation_state()
    act(env, td, torch.ones(4, 6, 2))
    after = env.simulation_state()
    assert torch.equal(state["episodes", "rod", "position"], after["episodes", "rod", "position"])
    assert torch.equal(state["episodes", "steps"], after["episodes", "steps"])
    td = env.reset(td.set("_reset", torch.tensor([[True], [False], [True], [False]])))
    assert td["done"].squeeze(-1).tolist() == [False, True, False, True]
    assert env.simulation_state()["episodes", "steps"].tolist() == [0, 2, 0, 2]


@pytest.mark.parametrize("task", ["basic", "wall"])
def test_a_partial_reset_changes_no_bit_of_the_others(build, task):
    def episode(reset):
        env = build(task)
        td = env.reset()
        actions = random_actions(env, 4)
        for step, action in enumerate(actions):
            td = step_mdp(env.step(td.set(entries.ACTION, action)))
            if reset and step == 1:
                td = env.reset(td.set("_reset", torch.tensor([[False], [True], [False], [False]])))
        return td

    undisturbed, disturbed = episode(False), episode(True)
    others = [0, 2, 3]
    for key in entries.OBSERVATION:
        assert torch.equal(undisturbed[key][others], disturbed[key][others]), key
    assert not torch.equal(undisturbed[entries.AGENT_POSITION][1], disturbed[entries.AGENT_POSITION][1])


@pytest.mark.parametrize("backend", ["numba", "torch", "pyelastica"])
@pytest.mark.parametrize("broken", ["position", "omega", "velocity", "director"])
def test_a_state_that_is_not_finite_ends_that_environment_and_changes_no_bit_of_the_others(build, backend, broken):
    actions = random_actions(build(), 4)

    def episode(poison):
        env = build("wall", backend=backend)
        td, frames = env.reset(), []
        for step, action in enumerate(actions):
            if poison and step == 2:
                edit(env, lambda state: state["episodes", "rod", broken][1].fill_(float("nan")))
            td = act(env, td, action)
            frames.append(td)
        return torch.stack(frames)

    clean, poisoned = episode(False), episode(True)
    others = [0, 2, 3]
    for key in (*entries.OBSERVATION, "reward", "done"):
        assert torch.equal(clean[key][:, others], poisoned[key][:, others]), key
    assert poisoned[entries.DIVERGED][2:, 1].any()
    assert poisoned["terminated"][2:, 1].all()
    assert not poisoned["truncated"].any()
    assert not poisoned[entries.SUCCESS][:, 1].any()


def test_what_a_diverging_environment_shows_is_its_last_good_state(build):
    env = build("basic", overrides=("task.max_dilatation=1.0000001",), rod=RodParameters())
    start = env.reset()
    td = act(env, start, torch.ones(4, 6, 2))
    assert td[entries.DIVERGED].all()
    assert td["terminated"].all()
    assert torch.equal(td["tip"], start["tip"])
    assert td["reward"].isfinite().all()


def test_the_environments_generator_and_the_global_one_leave_each_other_alone(build):
    torch.manual_seed(7)
    before = torch.get_rng_state()
    first = build("wall", seed=3).reset()
    assert torch.equal(torch.get_rng_state(), before)
    torch.manual_seed(8)
    again = build("wall", seed=3).reset()
    other = build("wall", seed=4).reset()
    assert torch.equal(first["target"], again["target"])
    assert not torch.equal(first["target"], other["target"])


def test_an_episode_goes_on_bit_for_bit_from_its_saved_state(build):
    actions = random_actions(build(), 6)
    env = build("wall")
    td = env.reset()
    for action in actions[:3]:
        td = act(env, td, action)
    state, generator = env.simulation_state(), env.generator_state()

    def finish(env, td):
        for action in actions[3:]:
            td = act(env, td, action)
        return env.reset(td.set("_reset", torch.ones(4, 1, dtype=torch.bool))), td

    expected_reset, expected = finish(env, td)
    other = build("wall", seed=99)
    other.reset()
    other.load_simulation_state(state)
    other.set_generator_state(generator)
    found_reset, found = finish(other, td)
    for key in (*entries.OBSERVATION, "reward"):
        assert torch.equal(expected[key], found[key]), key
    assert torch.equal(expected_reset["target"], found_reset["target"])


def test_moving_an_undiscovered_obstacle_changes_no_bit_of_any_action(build, settings):
    """Arms lean against the wall and discover some of it; then everything that they have not met moves away."""
    rod = RodParameters()
    config = settings("task=wall", "algo=softgm")
    env = build("wall", rod=rod)
    torch.manual_seed(0)
    policy = build_actor(config.model, env.sizes, config.algo.actor)
    td = env.reset()
    push = torch.zeros(4, 6, 2)
    push[..., 0] = 0.9  # towards the wall
    for _ in range(60):
        td = act(env, td, push)
        if (td[entries.DISCOVERED] > 0).all():
            break
    assert (td[entries.DISCOVERED] > 0).all()
    state = env.simulation_state()

    def observe(change):
        env.load_simulation_state(change(state.clone()))
        out = act(env, td, torch.zeros(4, 6, 2))
        with set_exploration_type(ExplorationType.DETERMINISTIC), torch.no_grad():
            return policy(out.select(*entries.OBSERVATION))

    unchanged = observe(lambda state: state)
    known = env.simulation_state()[
        "episodes", "table", "known"
    ]  # after the step: what it may still discover stays in place

    def move_unknown(state):
        state["episodes", "bins", "descriptor"][state["episodes", "bins", "mask"] & ~known] += 50.0
        touched = known.unflatten(1, (env.task.max_cylinders, -1)).any(dim=-1)
        state["episodes", "scene", "cylinders", "start"][~touched] += 50.0
        return state

    def move_known(state):
        state["episodes", "bins", "descriptor"][state["episodes", "table", "known"]] += 0.01
        return state

    moved, seen = observe(move_unknown), observe(move_known)
    for key in (*entries.OBSERVATION, entries.ACTION):
        assert torch.equal(unchanged[key], moved[key]), key
    # the same test notices a change of what has been discovered
    assert not torch.equal(unchanged[entries.ACTION], seen[entries.ACTION])


def test_staggered_episodes_are_truncated_at_different_steps_at_first_and_at_the_horizon_afterwards(build):
    env = build("basic", num_envs=32, horizon=6, stagger=True, rod=RodParameters(substeps=1))
    td, ends = env.reset(), []
    for _ in range(12):
        td, following = env.step_and_maybe_reset(td.set(entries.ACTION, torch.zeros(32, 6, 2)))
        ends.append(td["next", "truncated"].squeeze(-1))
        td = following
    ends = torch.stack(ends)
    assert torch.equal(ends[:6], ends[6:])  # once begun, every episode has its full length
    assert (ends[:6].sum(dim=0) == 1).all()
    assert (ends[:6].sum(dim=1) > 0).sum() >= 4
