"""Any algorithm with any model on any task: that they run, and what their policies read."""

import csv
import math
from functools import cache
from itertools import product

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

import every_task
from pairwise import pairwise, tiered
from softgm_bench.algorithms import algorithm_configs, build_algorithm
from softgm_bench.config import compose
from softgm_bench.envs import entries, make_env
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.runs import checkpoint
from softgm_bench.runs.loop import train
from softgm_bench.storage.run_folder import RunFolder

TASKS = tuple(task for task in every_task.TASKS if task not in every_task.FELT)
OTHER_WALLS = ("wall_narrow", "wall_fixed")  # which differ from `wall` in numbers
ALGORITHMS = tuple(algorithm_configs())
ON_POLICY = ("softgm", "ippo", "mappo")
ABLATIONS = ("softgm_no_stage1", "softgm_no_stage2", "softgm_remember")  # models of SoftGM's algorithm
RIVALS = ("informarl", "section_transformer")
PAIRS = [
    *product(ALGORITHMS, ("mlp", "softgm")),
    *product(("softgm",), (*ABLATIONS, *RIVALS)),
    *product(("masac", "iddpg"), RIVALS),
]
OWN = {algo: "softgm" if algo == "softgm" else "mlp" for algo in ALGORITHMS}
TINY = (
    "experiment=smoke",
    "threads=1",
    "experiment.total_frames=16",
    "experiment.num_envs=2",
    "experiment.steps_per_batch=4",
    "experiment.train_horizon=3",
    "experiment.evaluation.interval=16",
    "experiment.evaluation.episodes=2",
    "experiment.evaluation.final_episodes=2",
    "experiment.evaluation.horizon=2",
    "experiment.evaluation.final_horizon=2",
    "experiment.checkpoint.interval=16",
    "rod.n_elements=20",
)
TINY_PPO = ("algo.epochs=1", "algo.minibatch_size=8")
TINY_OFF_POLICY = (
    "algo.batch_size=4",
    "algo.random_frames=8",
    "algo.updates_per_frame=0.25",
    "algo.replay_capacity=32",
)

pytestmark = pytest.mark.usefixtures("one_thread")


def check_run(folder, algo, *overrides):
    """Train at smoke scale; every iteration is written down, what was learnt from is finite, a checkpoint is left."""
    sizes = TINY_PPO if algo in ON_POLICY else TINY_OFF_POLICY
    summary = train(compose([*TINY, *sizes, f"algo={algo}", f"run_dir={folder}", *overrides]))
    with (folder / "metrics.csv").open() as file:
        rows = list(csv.DictReader(file))
    losses = {name: float(value) for name, value in rows[-1].items() if name.startswith("loss_") or "_norm" in name}
    assert len(rows) == 2
    assert len(losses) >= 4
    assert all(math.isfinite(value) for value in losses.values()), losses
    assert summary["algo"].startswith(algo)
    assert summary["frames"] == 16
    assert summary["final_evaluation"]["episodes"] == 2
    state = checkpoint.load(RunFolder(folder).newest())
    assert state["config"]["algo"]["name"] == algo
    return summary


@pytest.mark.parametrize(
    ("algo", "model", "task"), pairwise(ALGORITHMS, ("mlp", "softgm", *RIVALS), TASKS, slow=OTHER_WALLS)
)
def test_every_algorithm_trains_with_every_model_on_every_task(tmp_path, algo, model, task):
    summary = check_run(tmp_path, algo, f"task={task}", f"model={model}")
    assert (summary["model"], summary["algo"]) == (model, algo if model == OWN[algo] else f"{algo}_{model}")


@pytest.mark.slow
@pytest.mark.parametrize(("algo", "task"), list(product(("softgm", "ippo", "masac", "iddpg"), every_task.FELT)))
def test_algorithms_of_every_kind_train_on_walls_that_have_to_be_felt(tmp_path, algo, task):
    assert check_run(tmp_path, algo, f"task={task}", f"model={OWN[algo]}")["task"] == task


@pytest.mark.parametrize(
    ("model", "task"),
    [tiered(*row, quick=row[1] == "wall") for row in product(ABLATIONS, TASKS)],
)
def test_ablations_train_on_every_task_under_their_own_names(tmp_path, model, task):
    summary = check_run(tmp_path, "softgm", f"task={task}", f"model={model}")
    assert (summary["model"], summary["algo"]) == (model, model)


@pytest.mark.parametrize(("algo", "model"), [*OWN.items(), *product(("softgm",), ABLATIONS)])
def test_every_algorithm_trains_with_an_asymmetric_critic(tmp_path, algo, model):
    check_run(tmp_path, algo, "task=wall", f"model={model}", "algo.critic.asymmetric=true")


@pytest.mark.parametrize("model", RIVALS)
def test_rivals_train_with_everything_that_an_actor_may_have(tmp_path, model):
    more = ("algo.actor.embedding_norm=true", "algo.critic.embedding_norm=true", "algo.actor.memory={cell:gru,size:8}")
    summary = check_run(tmp_path, "softgm", "task=wall", f"model={model}", "task.n_agents=5", "recipe=paper", *more)
    assert summary["algo"] == f"softgm_{model}_gru"


@pytest.mark.slow
@pytest.mark.parametrize("model", ["informarl_remember", "section_transformer_remember", "section_transformer_all"])
def test_rivals_of_other_kinds_train_under_their_own_names(tmp_path, model):
    assert check_run(tmp_path, "softgm", "task=wall", f"model={model}")["algo"] == f"softgm_{model}"


@pytest.fixture(scope="module")
def wall():
    return make_env(compose(["task=wall"]).task, RodParameters(n_elements=20, substeps=1), num_envs=3, seed=0)


@cache
def settings_on_wall(algo, model, *overrides):
    return compose(
        ["task=wall", f"algo={algo}", f"model={model}", *(() if algo in ON_POLICY else TINY_OFF_POLICY), *overrides]
    )


def built(algo, model, env, *overrides):
    """An algorithm whose parameters are all drawn at random, so that no term is hidden by a zero or a small gain."""
    config = settings_on_wall(algo, model, *overrides)
    algorithm = build_algorithm(config.algo, config.model, env, config.oracle)
    torch.manual_seed(0)
    with torch.no_grad():
        for parameter in algorithm.policy.parameters():
            parameter.normal_(std=0.05)
    return algorithm


def scene(env):
    """A frame with every entry drawn at random; an edge comes only from an active slot, as the environment has it."""
    torch.manual_seed(1)
    td = env.reset()
    td.update(env.observation_spec.rand())
    td[entries.EDGE] &= td[entries.SLOT_ACTIVE].unsqueeze(-2) & (torch.rand(td[entries.EDGE].shape) < 0.1)
    return td


def act(policy, td, exploration=ExplorationType.DETERMINISTIC):
    torch.manual_seed(2)
    with torch.no_grad(), set_exploration_type(exploration):
        return policy(td.clone())[entries.ACTION]


@pytest.mark.parametrize(("algo", "model"), PAIRS)
def test_every_policy_reads_the_observation_and_nothing_else(algo, model, wall):
    policy, td = built(algo, model, wall).policy, scene(wall)
    observed = td.select(*entries.OBSERVATION)
    assert set(policy.in_keys) == set(entries.OBSERVATION)
    assert len(td.keys(include_nested=True, leaves_only=True)) > len(entries.OBSERVATION)
    for exploration in (ExplorationType.DETERMINISTIC, ExplorationType.RANDOM):
        assert torch.equal(act(policy, td, exploration), act(policy, observed, exploration))
    for key in (entries.TARGET, entries.AGENT_POSITION):  # and this it does read
        other = observed.clone()
        other[key] += 1.0
        assert not torch.equal(act(policy, observed), act(policy, other))


@pytest.mark.parametrize(("algo", "model"), [*product(ALGORITHMS, ("softgm",)), *product(("softgm",), ABLATIONS)])
def test_no_policy_reads_what_its_asymmetric_critic_is_told(algo, model, wall):
    policy, td = built(algo, model, wall, "algo.critic.asymmetric=true").policy, scene(wall)
    other = td.clone()
    other[entries.PRIVILEGED] += 1.0
    assert set(policy.in_keys) == set(entries.OBSERVATION)
    assert torch.equal(act(policy, td), act(policy, other))


@pytest.mark.parametrize(("algo", "model"), [*product(ALGORITHMS, ("mlp",)), ("softgm", "softgm")])
def test_an_oracles_policy_reads_the_opening_in_either_recipe(algo, model, wall):
    for relative in ("true", "false"):
        oracle = ("observation=oracle", f"algo.actor.relative_points={relative}")
        policy, td = built(algo, model, wall, *oracle).policy, scene(wall)
        other = td.clone()
        other[entries.PRIVILEGED] += 1.0
        assert set(policy.in_keys) == {*entries.OBSERVATION, entries.PRIVILEGED}
        assert not torch.equal(act(policy, td), act(policy, other))


@pytest.mark.parametrize("moved", [0, 3, 5])
@pytest.mark.parametrize(("algo", "model"), PAIRS)
def test_execution_is_decentralised(algo, model, moved, wall):
    """An agent acts on its own entries and, with graph networks, on those of agents at most L = 2 places away."""
    policy, td = built(algo, model, wall).policy.double(), scene(wall)
    td = td.select(*entries.OBSERVATION).apply(lambda entry: entry.double() if entry.is_floating_point() else entry)
    other = td.clone()
    for key in (entries.AGENT_POSITION, entries.AGENT_VELOCITY, entries.PREVIOUS_ACTION):
        other[key][:, moved] = td[key][:, moved] * 0.5 + 0.1
    other[entries.EDGE][:, moved] = td[entries.SLOT_ACTIVE] & ~td[entries.EDGE][:, moved]
    changed = ((act(policy, td) - act(policy, other)).abs() > 1e-11).any(dim=-1).any(dim=0).tolist()
    reach = 0 if model in ("mlp", "softgm_no_stage2") else 2
    assert changed == [abs(agent - moved) <= reach for agent in range(6)]
