"""A run whose numbers stop being finite is a failure that says so, and keeps what was finite."""

import json
import sys

import pytest
import torch
from interrupted import PPO, SMALL, TINY

from kept_threads import kept_threads
from pairwise import partly
from softgm_bench import status
from softgm_bench.algorithms.ppo import PPO as Algorithm
from softgm_bench.analysis.runs import find
from softgm_bench.config import compose
from softgm_bench.episodes import policy
from softgm_bench.errors import NotFinite, UserError
from softgm_bench.models.finite import not_finite
from softgm_bench.runs import checkpoint, loop
from softgm_bench.storage.run_folder import RunFolder
from softgm_bench.sweeps import record as sweep_record

OFF_POLICY = ("algo.batch_size=8", "algo.random_frames=40", "algo.updates_per_frame=0.11", "algo.replay_capacity=100")
VECTOR = ("task=vmas_balance", "model=vector_mlp")
RUNS = {
    "softgm's actor": ("algo=softgm", "model.hidden=16", "algo.actor_lr=1e30", *PPO),
    "mappo's critic": ("algo=mappo", "algo.critic_lr=1e30", *PPO),
    "isac's critics": ("algo=isac", "algo.critic_lr=1e30", *OFF_POLICY),
    "maddpg's critic": ("algo=maddpg", "algo.critic_lr=1e30", *OFF_POLICY),
    "iddpg's critic on VMAS": ("algo=iddpg", "algo.critic_lr=1e25", *VECTOR, *OFF_POLICY),
}
CHECKPOINT_FRAMES, POISONED = 64, 5  # of SMALL: 16 frames an iteration, a checkpoint every 32


@pytest.fixture(autouse=True)
def _threads_as_before():
    with kept_threads():
        yield


def refusal(folder, *overrides):
    with pytest.raises(NotFinite) as caught:
        loop.train(compose([*overrides, f"run_dir={folder}"]))
    line = str(caught.value)
    assert "\n" not in line
    return line


@pytest.mark.parametrize("overrides", RUNS.values(), ids=RUNS)
def test_a_run_that_diverges_by_itself_has_failed_and_keeps_nothing_that_is_not_finite(tmp_path, overrides):
    if overrides[2] == VECTOR[0]:
        pytest.importorskip("vmas", reason="VMAS is an optional extra: pip install 'softgm-bench[vmas]'")
    folder = RunFolder(tmp_path / "run")

    line = refusal(folder.path, *TINY, *overrides)

    assert "training has diverged" in line
    assert not folder.summary.exists()
    assert sweep_record.state(folder.path) == sweep_record.State("failed", line)
    for path in folder.in_order():
        assert not_finite(checkpoint.load(path)["policy"].items()) is None
    found = find(tmp_path)
    assert not found.runs
    assert [problem.reason for problem in found.problems] == [f"failed: {line}"]


def poisoned(how):
    """PPO whose update number ``POISONED`` goes wrong."""
    update, count = Algorithm.update, 0

    def wrong(self, batch):
        nonlocal count
        count += 1
        metrics = update(self, batch)
        return metrics | (how(self, batch) or {}) if count == POISONED else metrics

    return wrong


def spoil(tensor, value):
    with torch.no_grad():
        tensor.view(-1)[-1] = value


POISONS = {
    "loss_critic is nan": lambda algorithm, batch: {"loss_critic": float("nan")},
    "actor_grad_norm is inf": lambda algorithm, batch: {"actor_grad_norm": float("inf")},
    "the parameter policy.module.0.sigma holds nan": lambda algorithm, batch: spoil(
        algorithm.policy.module[0].sigma, float("nan")
    ),
    "the parameter critic.": lambda algorithm, batch: spoil(next(algorithm.critic.parameters()), float("inf")),
    "the action holds nan": lambda algorithm, batch: spoil(batch["agents", "action"], float("nan")),
    "an action of the policy is not finite": lambda algorithm, batch: (
        [spoil(one, 3e38) for one in algorithm.policy.parameters()] and None
    ),
}


@pytest.mark.parametrize(
    "what", partly(list(POISONS), ["loss_critic is nan", "the parameter critic.", "the action holds nan"])
)
def test_the_tensor_is_named_and_the_last_finite_checkpoint_stays(tmp_path, monkeypatch, what):
    monkeypatch.setattr(Algorithm, "update", poisoned(POISONS[what]))
    folder = RunFolder(tmp_path)
    overrides = [*SMALL, "experiment.evaluation.interval=80"]  # the fifth iteration's end

    line = refusal(tmp_path, *overrides)

    kept = folder.newest()
    assert line.startswith(what)
    assert f"after {16 * POISONED} frames: training has diverged, the last finite checkpoint is {kept};" in line
    assert checkpoint.load(kept)["frames"] == CHECKPOINT_FRAMES
    assert policy.load(tmp_path).frames == CHECKPOINT_FRAMES

    monkeypatch.undo()
    loop.train(compose([*overrides, f"run_dir={tmp_path}", "resume=true"]))  # and the run can go on from there
    assert sweep_record.state(tmp_path).kind == "done"
    assert not folder.failure.exists()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("finished")
    loop.train(compose([*SMALL, f"run_dir={folder}"]))
    return folder


def test_what_was_kept_before_anybody_looked_is_not_used(finished, tmp_path, capsys):
    """Runs of earlier versions ended with such policies."""
    newest, folder = RunFolder(finished).in_order(), RunFolder(tmp_path)
    folder.checkpoints.mkdir()
    folder.config.write_bytes(RunFolder(finished).config.read_bytes())
    state = checkpoint.load(newest[-1])
    name = next(iter(state["policy"]))
    state["policy"][name].fill_(float("nan"))
    path = checkpoint.save(folder, state.pop("frames"), state, keep=2)

    with pytest.raises(UserError, match=r"frames-0+160\.pt: \S+ holds nan, its training has diverged; use an earlier"):
        policy.load(tmp_path)
    capsys.readouterr()
    with pytest.raises(UserError, match="no checkpoint here can be used"):
        loop.train(compose([*SMALL, f"run_dir={tmp_path}", "resume=true"]))
    assert f"passed over {path}: {name} holds nan" in capsys.readouterr().err


def test_a_finished_run_of_nan_returns_counts_as_failed(finished, tmp_path, monkeypatch, capsys):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("config.yaml", "metrics.csv", "episodes.csv", "summary.json"):
        (folder / name).write_bytes((finished / name).read_bytes())
    summary = json.loads((folder / "summary.json").read_text())
    summary["final_evaluation"]["undiscounted_return"]["mean"] = None
    (folder / "summary.json").write_text(json.dumps(summary))
    head, *rows = (folder / "episodes.csv").read_text().splitlines()
    column = head.split(",").index("undiscounted_return")
    without = [",".join([*(cells := row.split(","))[:column], "nan", *cells[column + 1 :]]) for row in rows]
    (folder / "episodes.csv").write_text("\n".join([head, *without]) + "\n")

    monkeypatch.setattr(sys, "argv", ["status", str(tmp_path)])
    assert status.main() == 0
    assert capsys.readouterr().out.splitlines()[-1] == "1 run: 1 failed"
    assert "the policy had diverged" in find(tmp_path).problems[0].reason
