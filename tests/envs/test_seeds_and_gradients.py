"""One seed means one set of scenes however it is given, and a gradient is right or refused."""

import copy

import pytest
import torch

from softgm_bench import api
from softgm_bench.envs import entries, make_env
from softgm_bench.episodes.evaluation import evaluation_seed

SMALL = ("task=wall", "rod.n_elements=20", "rod.substeps=5")


def first(env, **options):
    return env.reset(**options)[entries.TARGET]


@pytest.mark.parametrize("overrides", [SMALL, (*SMALL, "perturbation=noise")], ids=["plain", "noise"])
def test_a_seed_is_the_same_to_the_constructor_set_seed_and_reset(overrides):
    built = api.make_env(*overrides, num_envs=4, seed=7)
    other = api.make_env(*overrides, num_envs=4, seed=1)
    once = first(built)

    other.set_seed(7)
    assert torch.equal(first(other), once)
    assert not torch.equal(first(other), once)
    assert torch.equal(first(other, seed=7), once)
    assert torch.equal(first(copy.deepcopy(built), seed=7), once)


def test_a_copy_moves_on_its_own():
    env = api.make_env(*SMALL, "perturbation=noise", num_envs=3, seed=2)
    td = env.reset()
    other = copy.deepcopy(env)
    before = other.simulation_state()
    after = env.step(td.clone().set(entries.ACTION, torch.ones(3, 6, 2)))["next", entries.TIP]
    assert (other.simulation_state() == before).all()
    assert torch.equal(other.step(td.clone().set(entries.ACTION, torch.ones(3, 6, 2)))["next", entries.TIP], after)
    env.reset()
    assert not torch.equal(env.scene.target, other.scene.target)


def test_vmas_takes_a_seed_in_reset_too():
    pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
    env = api.make_env("task=vmas_navigation", "model=vector_mlp", "recipe=paper", num_envs=3, seed=5)
    once = env.reset()["agents", "observation"]
    assert not torch.equal(env.reset()["agents", "observation"], once)
    assert torch.equal(env.reset(seed=5)["agents", "observation"], once)


def test_the_seed_of_an_evaluation_names_its_scenes(settings):
    """As docs/evaluation.md says."""
    from softgm_bench.episodes.evaluation import evaluate

    config = settings("task=basic", "rod.n_elements=20", "rod.substeps=5")
    seen = []

    def policy(td):
        seen.append(td[entries.TARGET])
        return td.set(entries.ACTION, torch.zeros(4, 6, 2))

    own = evaluation_seed(3)
    evaluate(policy, make_env(config.task, config.rod, 4, 0, horizon=1), deterministic=True, seed=own)
    assert torch.equal(seen[0], first(make_env(config.task, config.rod, 4, own)))


def rewards(backend, action):
    overrides = ("rod.n_elements=20", "rod.substeps=20", f"backend={backend}")
    env = api.make_env(*overrides, num_envs=1, seed=0)
    return env.step(env.reset().set(entries.ACTION, action))["next", entries.REWARD].double().sum()


def test_a_gradient_through_the_default_backend_is_refused_and_torchs_is_that_of_differences():
    action = torch.full((1, 6, 2), 0.3)
    with pytest.raises(ValueError, match=r"^the action, [^\n]*backend=numba has none: choose backend=torch, or[^\n]*$"):
        rewards("numba", action.clone().requires_grad_())
    with torch.no_grad():  # nobody asks for one
        assert float(rewards("numba", action.clone().requires_grad_())) == pytest.approx(
            float(rewards("torch", action))
        )

    leaf = action.clone().requires_grad_()
    rewards("torch", leaf).backward()
    moved = torch.zeros_like(action)
    moved[0, 3, 0] = 0.01
    difference = (rewards("torch", action + moved) - rewards("torch", action - moved)) / 0.02
    assert float(leaf.grad[0, 3, 0]) == pytest.approx(float(difference), rel=2e-2)


@pytest.fixture
def _double():
    before = torch.get_default_dtype()
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(before)


@pytest.mark.usefixtures("_double")
@pytest.mark.parametrize("algo", ["softgm", "ippo", "masac", "maddpg"])
def test_the_default_type_of_torch_changes_no_entry_and_no_network(algo):
    env = api.make_env(*SMALL, "perturbation=noise", num_envs=4)
    for key, value in env.reset().items(True, True):
        assert value.dtype in (torch.float32, torch.bool), key
    algorithm = api.build_algorithm(api.configure(*SMALL, f"algo={algo}"), env)
    assert {parameter.dtype for parameter in algorithm.policy.parameters()} == {torch.float32}
    frames = api.rollout(env, algorithm.policy, steps=3, deterministic=False)
    assert frames[entries.ACTION].dtype == torch.float32
    assert torch.get_default_dtype() == torch.float64
