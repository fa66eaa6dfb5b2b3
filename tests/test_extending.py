"""The tutorial as a reader follows it: its files and its commands are taken from its own text."""

import csv
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

TUTORIAL = (Path(__file__).parents[1] / "docs/extending.md").read_text()
FILES = {
    name: content for content, name in re.findall(r"```(?:py|yaml)\n(# (my_project/\S+)\n.*?)```", TUTORIAL, re.DOTALL)
}
(VARIABLE,) = re.findall(r"export (\w+)=my_project", TUTORIAL)
COMMANDS = re.findall(r"```sh\n(python .*?)\n```", TUTORIAL)


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """A folder away from the repository with the tutorial's files in it."""
    folder = tmp_path_factory.mktemp("tutorial")
    for name, content in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(content)
    return folder


def run(folder, command, **variables):
    words = command.split()
    assert words[0] == "python"
    return subprocess.run(
        [sys.executable, *words[1:]],
        cwd=folder,
        env=os.environ | variables,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_the_tutorial_builds_one_of_each():
    assert {name for name in FILES if name.endswith(".yaml")} == {
        "my_project/conf/task/one_post.yaml",
        "my_project/conf/model/deep_sets.yaml",
        "my_project/conf/algo/reinforce.yaml",
    }
    assert len(FILES) == 6
    assert len(COMMANDS) == 4


RUNS = ("one_post/softgm", "structured/mappo_deep_sets", "one_post/reinforce_deep_sets")


@pytest.mark.slow
def test_the_commands_of_the_tutorial_do_what_it_says(place):
    for command in COMMANDS:
        result = run(place, command, **{VARIABLE: "my_project"})
        assert result.returncode == 0, result.stderr
        assert "success rate" in result.stdout

    for name in RUNS:
        folder = place / "outputs" / name / "seed0"
        assert (folder / "summary.json").exists()
        config = yaml.safe_load((folder / "config.yaml").read_text())
        for group in ("task", "model", "algo"):
            yours = f"my_project/conf/{group}/{config[group]['name']}.yaml"
            for key, value in yaml.safe_load(FILES.get(yours, "{}")).items():
                if key not in ("defaults", "lr"):  # 1e-3 is text to YAML 1.1
                    assert _given(value, config[group][key]) == value
    with (folder / "metrics.csv").open() as file:
        assert {"loss_objective", "return_to_go"} <= set(next(csv.DictReader(file)))
    (evaluation,) = (folder / "evaluations").iterdir()
    assert (evaluation / "episodes.csv").read_text().count("\n") == 5


def _given(yours, found):
    """What was found of the keys that you gave; a run has also those that came to its classes later."""
    return {key: found[key] for key in yours} if isinstance(yours, dict) else found


CHECKS = """
import torch
from softgm_bench import api
from softgm_bench.envs import entries

env = api.make_env("task=one_post", num_envs=64, seed=3)
td = env.reset()
posts = env.scene.cylinders
assert posts.start.shape == (64, 1, 3)
assert posts.mask.all()
x, y = posts.start[:, 0, 0], posts.start[:, 0, 1]
assert 0.3 <= x.min() < x.max() <= 0.4, x
assert -0.15 <= y.min() < -0.1 and 0.1 < y.max() <= 0.15, y

config = api.configure("task=structured", "algo=reinforce", "model=deep_sets")
torch.manual_seed(0)
env = api.make_env("task=structured", num_envs=8, seed=0)
algorithm = api.build_algorithm(config, env)

# the embedding does not depend on the order of the slots, and does on what is in them
td = env.reset()
edge, slots = td[entries.EDGE].clone(), td[entries.SLOT_DESCRIPTOR].clone()
edge[:, 0, :4] = True
td[entries.EDGE], td[entries.SLOT_ACTIVE] = edge, edge.any(1)
td[entries.SLOT_DESCRIPTOR] = torch.randn_like(slots)
encoder = algorithm.policy[0].head.encoder
shuffled, emptied = td.clone(), td.clone()
order = torch.randperm(edge.shape[-1])
shuffled[entries.EDGE] = td[entries.EDGE][..., order]
shuffled[entries.SLOT_ACTIVE] = td[entries.SLOT_ACTIVE][..., order]
shuffled[entries.SLOT_DESCRIPTOR] = td[entries.SLOT_DESCRIPTOR][:, order]
emptied[entries.EDGE] = torch.zeros_like(edge)
assert torch.allclose(encoder(td), encoder(shuffled), atol=1e-5)
assert not torch.allclose(encoder(td)[:, 0], encoder(emptied)[:, 0], atol=1e-3)
assert torch.equal(encoder(td)[:, 1], encoder(emptied)[:, 1])

# returns end with the episode; an action that was rewarded becomes likelier, one that was punished less likely
batch = api.rollout(env, algorithm.policy, steps=3, deterministic=False)
batch["next", entries.REWARD] = torch.tensor([1.0, 2.0, 4.0]).expand(8, 3).unsqueeze(-1).clone()
done = torch.zeros(8, 3, 1, dtype=torch.bool)
done[4:, 1] = True
batch["next", entries.DONE] = done
g = algorithm.config.gamma
returns = algorithm.returns(batch)
assert torch.allclose(returns[0], torch.tensor([1 + 2 * g + 4 * g * g, 2 + 4 * g, 4.0]))
assert torch.allclose(returns[7], torch.tensor([1 + 2 * g, 2.0, 4.0]))
good = torch.arange(8) < 4
batch["next", entries.REWARD] = torch.where(good, 1.0, -1.0).reshape(8, 1, 1).expand(8, 3, 1).clone()
def likelihood():
    with torch.no_grad():
        return algorithm.policy.get_dist(batch).log_prob(batch[entries.ACTION]).sum(dim=(-1, -2))
before = likelihood()
for _ in range(5):
    algorithm.update(batch)
change = likelihood() - before
assert change[good].mean() > 0 > change[~good].mean(), change
print("checked")
"""


@pytest.mark.slow
def test_what_the_tutorial_builds_has_the_properties_that_it_states(place):
    result = subprocess.run(
        [sys.executable, "-c", CHECKS],
        cwd=place,
        env=os.environ | {VARIABLE: "my_project"},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )

    assert result.returncode == 0, result.stderr
    assert result.stdout == "checked\n"


def test_without_the_variable_there_is_no_such_task(place):
    result = run(place, "python -m softgm_bench task=one_post experiment=smoke", **{VARIABLE: ""})

    assert result.returncode == 2
    assert result.stderr.startswith("softgm_bench: task=one_post: no such task; choose one of basic, structured")
