"""Training over a mixture of numbers of sections: ``task.n_agents=[4, 6, 8]``."""

import csv
import json
import re

import numpy as np
import pytest
import torch
from interrupted import SMALL, state, written
from tensordict import TensorDict

from kept_threads import kept_threads
from softgm_bench import api
from softgm_bench.assembly import configure
from softgm_bench.config import compose
from softgm_bench.envs import entries
from softgm_bench.episodes import policy
from softgm_bench.errors import UserError
from softgm_bench.runs import loop
from softgm_bench.runs.loggers.video import episode_video
from softgm_bench.runs.metrics import success_by_number

SETTINGS = (*SMALL, "experiment.total_frames=64", "experiment.num_envs=5", "experiment.evaluation.episodes=4")
EASY = ("task.success_radius=0.9", "experiment.evaluation.final_episodes=7")


@pytest.fixture(autouse=True, scope="module")
def _threads_as_before():
    with kept_threads():
        yield


def train(folder, *overrides):
    loop.train(compose([*SETTINGS, f"run_dir={folder}", *overrides]))
    return folder


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """Folder of a run over three numbers, some of whose targets are reached by chance."""
    return train(tmp_path_factory.mktemp("mixed"), "task.n_agents=[4,6,5]", *EASY)


def without(values, *names):
    return {name: value for name, value in values.items() if name not in names}


@pytest.mark.parametrize("algo", [("algo=softgm",), ("algo=ippo", "model.hidden=8")], ids=["softgm", "ippo"])
def test_a_mixture_of_one_number_is_a_run_of_that_number_bit_for_bit(tmp_path, algo):
    several = (*algo, "algo.value_norm_decay=0.9", "algo.target_kl=0.01")
    one = train(tmp_path / "one", "task.n_agents=6", *several)
    mixture = train(tmp_path / "mixture", "task.n_agents=[6]", *several)

    (rows, looks, _, summary), (mixed_rows, mixed_looks, _, mixed_summary) = written(one), written(mixture)
    assert [without(row, "success_rate_n6") for row in mixed_rows] == rows
    assert all(row["success_rate_n6"] == row["success_rate"] for row in mixed_rows)
    assert [without(look, "success_rate_n6") for look in mixed_looks] == looks
    final, mixed_final = summary.pop("final_evaluation"), mixed_summary.pop("final_evaluation")
    assert without(mixed_final, "success_rate_n6") == final
    assert without(mixed_final["success_rate_n6"], "episodes") == final["success_rate"]
    assert mixed_summary == summary
    held, mixed_held = state(one), state(mixture)
    for key in ("algorithm", "policy", "episodes"):
        assert json.dumps(_plain(held[key])) == json.dumps(_plain(mixed_held[key]))


def _plain(value):
    if isinstance(value, torch.Tensor):
        return value.tolist()
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    return [_plain(item) for item in value] if isinstance(value, list | tuple) else value


def test_success_is_told_of_each_number_and_of_all(mixed):
    rows, looks, episodes, summary = written(mixed)
    names = [f"success_rate_n{number}" for number in (4, 6, 5)]
    assert set(names) <= set(rows[0])
    for metrics, counts in [(look, (2, 1, 1)) for look in looks] + [(summary["final_evaluation"], (3, 2, 2))]:
        assert [metrics[name]["episodes"] for name in names] == list(counts)
        share = sum(metrics[name]["mean"] * count for name, count in zip(names, counts, strict=True)) / sum(counts)
        assert metrics["success_rate"]["mean"] == pytest.approx(share)
    played = list(csv.DictReader(episodes.splitlines()))
    assert [int(row["n_agents"]) for row in played] == [4] * 3 + [6] * 2 + [5] * 2
    assert {float(row["success_rate"]) for row in rows} != {0.0}


def test_a_rate_is_that_of_the_episodes_that_end():
    def batch(done, success):
        flags = {entries.DONE: done, entries.SUCCESS: success}
        after = {key: torch.tensor(values).bool().unsqueeze(-1) for key, values in flags.items()}
        return TensorDict({"next": TensorDict(after, (2, 2))}, (2, 2))

    one, other = batch([[1, 0], [1, 1]], [[1, 0], [0, 0]]), batch([[0, 0], [0, 0]], [[0, 0], [0, 0]])
    rates = success_by_number([one, other], [4, 6])
    assert rates["success_rate_n4"] == pytest.approx(1 / 3)
    assert np.isnan(rates["success_rate_n6"])
    assert success_by_number([one], ()) == {}


def test_the_policy_plays_arms_of_any_number_and_the_mixture_again(mixed, tmp_path):
    kept = tmp_path / "kept.pt"
    policy.save(policy.load(mixed), kept)
    other = api.evaluate(kept, "task.n_agents=9", episodes=3, horizon=3)
    assert "n_agents" not in other.records
    assert other.records["torque_joint"].max() > 0.0
    again = api.evaluate(kept, episodes=7, horizon=3)
    assert again.records["n_agents"].tolist() == [4] * 3 + [6] * 2 + [5] * 2
    assert re.search(r"success, 6 sections +\d\.\d{3}  \[\S+ \S+\]  of 2\n", str(again))
    alone = api.evaluate(kept, "task.n_agents=4", episodes=3, horizon=3)
    for name in alone.records:
        assert np.array_equal(alone.records[name], again.records[name][:3])
    # and a mixture's episodes are shared out in every part of an evaluation
    parts = api.evaluate(kept, "task.n_agents=[4,9]", episodes=5, horizon=2, batch=3)
    assert parts.records["n_agents"].tolist() == [4, 4, 9, 4, 9]


def test_a_recording_is_of_one_number(mixed):
    with pytest.raises(UserError, match=r"^task\.n_agents=\[4, 6, 5\]: this is for arms of one number "):
        api.record(mixed)
    assert api.record(mixed, "task.n_agents=5", horizon=2).action.shape[1:] == (5, 2)
    trained = policy.load(mixed)
    pytest.importorskip("av", reason="videos are an optional extra")
    assert episode_video(trained.config, trained.policy, trained.sizes, trained.frames)


LIST = "task.n_agents=[4,6,5]"


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        (
            ("algo=masac",),
            r"^task\.n_agents=\[4, 6, 5\]: algo=masac learns from arms of one number [^\n]*softgm or ippo$",
        ),
        (("algo=mappo",), r"^task\.n_agents=\[4, 6, 5\]: critic\.\S+ of algo=mappo has another shape [^\n]*$"),
        (("experiment.num_envs=2",), r"^experiment\.num_envs=2 with task\.n_agents=\[4, 6, 5\]: at least one for each"),
        (("perturbation=section_failure", "perturbation.failed_agents=[4]"), r"^perturbation\.failed_agents holds 4: "),
        (("task=vmas_balance", "model=vector_mlp", "recipe=paper"), r"n_agents"),
    ],
)
def test_what_no_mixture_can_be_is_refused_in_one_line(overrides, said):
    if "task=vmas_balance" in overrides:
        pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
    with pytest.raises(Exception, match=said):
        configure(["rod.n_elements=20", LIST, *overrides])


def test_both_recipes_and_both_critics_learn_mixtures():
    for overrides in ((), ("recipe=paper",), ("algo=ippo",), ("algo=mappo", "algo.critic.pooling=mean")):
        config = configure(["rod.n_elements=20", LIST, *overrides])
        assert config.mixed
        assert not config.graphs
    assert configure(["task.n_agents=6"]).algo.critic.pooling == "concat"
    assert configure([LIST]).algo.critic.pooling == "mean"
