import importlib.util
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench.envs import keys, make_env
from softgm_bench.experiment import policy

ROOT = Path(__file__).parents[1]
POLICIES = sorted((ROOT / "experiments" / "policies").glob("*.pt"))


@pytest.fixture(scope="module")
def results():
    specification = importlib.util.spec_from_file_location("results", ROOT / "experiments" / "results.py")
    module = importlib.util.module_from_spec(specification)
    specification.loader.exec_module(module)
    return module


def test_the_tables_of_the_results_are_made_from_the_committed_runs(results):
    page = results.PAGE.read_text()
    assert results.page(page) == page
    assert any(results.runs(task) for task in results.TASKS)


@pytest.mark.parametrize("path", POLICIES, ids=lambda path: path.stem)
def test_a_kept_policy_belongs_to_a_committed_run(path, results):
    trained = policy.load(path)
    task = trained.config.task.name
    assert path.stem == f"{task}_{trained.config.label}"
    assert trained.frames in [run.final.frames for run in results.runs(task) if run.final.label == trained.config.label]


@pytest.mark.parametrize("algo", ["softgm", "mappo"])
def test_a_kept_policy_still_reaches_targets(algo):
    trained = policy.load(ROOT / "experiments" / "policies" / f"basic_{algo}.pt")
    env = make_env(trained.config.task, trained.config.rod, num_envs=64, seed=3, horizon=100)
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        episodes = env.rollout(100, trained.policy, break_when_any_done=False)
    assert episodes["next"][keys.SUCCESS].any(dim=1).double().mean() > 0.85
