import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torchrl.envs.utils import step_mdp

from kept_threads import kept_threads
from softgm_bench import api
from softgm_bench.envs import entries
from softgm_bench.errors import UserError

ROOT = Path(__file__).parents[1]
TINY = (
    "experiment=smoke",
    "threads=1",
    "experiment.total_frames=16",
    "experiment.num_envs=4",
    "experiment.steps_per_batch=4",
    "experiment.train_horizon=3",
    "experiment.evaluation.horizon=2",
    "experiment.evaluation.final_horizon=2",
    "experiment.evaluation.final_episodes=3",
    "rod.n_elements=20",
    "algo.epochs=1",
)


@pytest.fixture(autouse=True, scope="module")
def _threads_as_before():
    with kept_threads():
        yield


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    return api.train(*TINY, "task=structured", f"run_dir={tmp_path_factory.mktemp('run')}")


def test_a_training_gives_the_folder_and_what_is_in_its_summary(run):
    assert run.summary == json.loads((run.folder / "summary.json").read_text())
    assert run.summary["task"] == "structured"


def test_a_rollout_of_a_policy_repeats_what_acting_step_by_step_does(run):
    trained = api.load(run.folder)
    frames = api.rollout(api.make_env("task=structured", "rod.n_elements=20", num_envs=3, seed=5), trained, steps=4)

    env = api.make_env("task=structured", "rod.n_elements=20", num_envs=3, seed=5)
    observation = env.reset()
    for step in range(4):
        action = api.act(trained, observation)
        assert torch.equal(action, frames[entries.ACTION][:, step])
        observation[entries.ACTION] = action
        observation = step_mdp(env.step(observation))
    assert frames.shape == (3, 4)
    assert torch.equal(observation[entries.TIP], frames["next", entries.TIP][:, -1])


def test_acting_leaves_the_observation_as_it_is_and_samples_if_asked_to(run):
    trained, env = api.load(run.folder), api.make_env("task=structured", "rod.n_elements=20", num_envs=3)
    observation = env.reset()
    before = set(observation.keys(True))

    mode, again = api.act(trained, observation), api.act(trained.policy, observation)
    sample = api.act(trained, observation, deterministic=False)

    assert set(observation.keys(True)) == before
    assert torch.equal(mode, again)
    assert not torch.equal(mode, sample)


def test_an_evaluation_is_that_of_the_command(run, tmp_path):
    result = api.evaluate(run.folder, "task.success_radius=0.9", episodes=4, seed=2, horizon=3, out=tmp_path / "api")
    words = [str(run.folder), "task.success_radius=0.9", "episodes=4", "seed=2", "horizon=3", f"out={tmp_path}/command"]
    subprocess.run([sys.executable, "-m", "softgm_bench.evaluate", *words, "threads=1"], check=True, timeout=300)

    episodes = [(tmp_path / name / "episodes.csv").read_text() for name in ("api", "command")]
    summaries = [json.loads((tmp_path / name / "summary.json").read_text()) for name in ("api", "command")]
    assert episodes[0] == episodes[1]
    assert summaries[0] == summaries[1]
    assert result.metrics["success_rate"]["mean"] == result.records["success"].mean()
    assert "success rate" in str(result)


def test_a_recorded_episode_is_one_of_the_evaluation(run):
    trained = api.load(run.folder)
    episode = api.record(trained, seed=2, horizon=3)
    records = api.evaluate(trained, episodes=1, seed=2, horizon=3).records

    assert episode.steps == records["length"][0]
    assert episode.reward.sum() == pytest.approx(records["undiscounted_return"][0], rel=1e-6)


def test_an_algorithm_can_be_trained_in_a_loop_of_ones_own():
    config, env = api.configure("algo=ippo", "rod.n_elements=20"), api.make_env("rod.n_elements=20", num_envs=4)
    algorithm = api.build_algorithm(config, env)
    before = [parameter.clone() for parameter in algorithm.policy.parameters()]

    losses = algorithm.update(api.rollout(env, algorithm.policy, steps=4, deterministic=False))

    assert losses["actor_grad_norm"] > 0.0
    assert any(not torch.equal(old, new) for old, new in zip(before, algorithm.policy.parameters(), strict=True))


def test_mistakes_are_explained(run):
    with pytest.raises(UserError, match="seed=-1"):
        api.train("seed=-1")
    with pytest.raises(UserError, match="holds a training run"):
        api.evaluate(run.folder, episodes=1, horizon=1, out=run.folder)
    with pytest.raises(UserError, match="loaded already"):
        api.evaluate(api.load(run.folder), "task=basic", episodes=1)


@pytest.mark.parametrize("wrong", [0, -1, 2.5, "many"])
def test_counts_that_are_none_are_one_line(run, wrong):
    for call in (
        lambda: api.evaluate(run.folder, episodes=wrong, horizon=1),
        lambda: api.evaluate(run.folder, episodes=1, horizon=wrong),
        lambda: api.make_env(num_envs=wrong),
        lambda: api.make_env(horizon=wrong),
        lambda: api.rollout(api.make_env("rod.n_elements=20"), steps=wrong),
    ):
        with pytest.raises(UserError, match=rf"^(episodes|horizon|num_envs|steps)={wrong}: it must be at least 1"):
            call()
    with pytest.raises(UserError, match=r"^seed=-1: a seed is a whole number"):
        api.make_env(seed=-1)


def test_importing_the_package_does_not_wait_for_torch():
    code = "import sys, softgm_bench; print('torch' in sys.modules, 'hydra' in sys.modules)"

    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)

    assert result.stdout == "False False\n"


@pytest.mark.slow
def test_the_example_runs(tmp_path):
    result = subprocess.run(
        [sys.executable, ROOT / "examples/api.py", tmp_path / "run"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )

    assert result.returncode == 0, result.stderr
    assert "success rate" in result.stdout
    assert "positions of the nodes" in result.stdout
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


def test_the_notebook_is_stored_with_what_its_cells_gave():
    cells = json.loads((ROOT / "examples/quick_tour.ipynb").read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert [cell["execution_count"] for cell in code] == list(range(1, len(code) + 1))
    assert len({"".join(cell["source"]) for cell in code}) == len(code)
    outputs = [output for cell in code for output in cell["outputs"]]
    assert not any(output["output_type"] == "error" for output in outputs)
    assert any("image/png" in output.get("data", {}) for output in outputs)
    text = json.dumps([output for output in outputs if "image/png" not in output.get("data", {})])
    assert "success rate" in text
    assert "Warning" not in text
    assert str(Path.home()) not in text


@pytest.mark.slow
def test_the_notebook_runs_from_its_folder():
    nbclient, nbformat = pytest.importorskip("nbclient"), pytest.importorskip("nbformat")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(ROOT / "examples/quick_tour.ipynb", as_version=4)
    nbclient.NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(ROOT / "examples")}}).execute()

    outputs = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    assert any("success rate" in output.get("text", "") for output in outputs)
