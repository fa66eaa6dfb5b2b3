"""The command, called as Python calls it, on policies that are in the repository."""

import csv
import errno
import json
import re
import shutil
import subprocess
import sys
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

from softgm_bench.envs import entries
from softgm_bench.episodes import folder as evaluation_folder
from softgm_bench.rod.randomise import FACTORS
from softgm_bench.runs import checkpoint
from softgm_bench.storage import archive

# The command; the package's own name ``evaluate`` is the function.
evaluate = import_module("softgm_bench.evaluate")

POLICIES = Path(__file__).parents[1] / "experiments" / "policies"
SOFTGM, MAPPO = str(POLICIES / "basic_softgm.pt"), str(POLICIES / "basic_mappo.pt")
QUICK = ("episodes=3", "horizon=4", "rod.n_elements=20", "threads=1")


@pytest.fixture
def run(monkeypatch, capsys, tmp_path):
    """Call the command in an empty folder: its status, what it printed, what it complained of."""
    threads = torch.get_num_threads()
    monkeypatch.chdir(tmp_path)

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["evaluate", *map(str, arguments)])
        status = evaluate.main()
        printed = capsys.readouterr()
        return status, printed.out, printed.err

    yield call
    torch.set_num_threads(threads)


def columns(path):
    with path.open(newline="") as file:
        rows = list(csv.DictReader(file))
    return {name: [row[name] for row in rows] for name in rows[0]}


def test_an_evaluation_leaves_its_episodes_and_a_summary_of_them(run, tmp_path):
    status, out, err = run(
        SOFTGM, *QUICK, "task=wall", "perturbation=noise", "perturbation.position_sigma=0.2", "out=x"
    )
    assert (status, err) == (0, "")
    assert "softgm on wall, perturbation noise, seed 0:" in out
    assert "success rate" in out
    assert {path.name for path in (tmp_path / "x").iterdir()} == {"episodes.csv", "summary.json"}
    found, summary = columns(tmp_path / "x/episodes.csv"), json.loads((tmp_path / "x/summary.json").read_text())
    absent = {entries.CONTACT_FAILURE, *entries.BODY.values()}  # no limit here, no body drawn
    told = [column.name for column in entries.EPISODE_COLUMNS if column.key not in absent]
    assert list(found) == ["episode", *told]
    assert found["episode"] == ["0", "1", "2"]
    returns = np.array(found["undiscounted_return"], dtype=float)
    terms = sum(np.array(found[name], dtype=float) for name in found if name.startswith("reward_"))
    np.testing.assert_allclose(returns, terms, rtol=1e-6)
    metrics = summary.pop("metrics")
    assert metrics["undiscounted_return"]["mean"] == pytest.approx(returns.mean(), rel=1e-12)
    assert metrics["episodes"] == 3
    versions = summary.pop("versions")
    assert versions["torch"] == torch.__version__.partition("+")[0] or versions["torch"] == torch.__version__
    frames = summary.pop("frames")
    assert frames > 1_000_000
    assert re.fullmatch("[0-9a-f]{16}", summary.pop("policy"))
    assert summary == {
        "task": "wall",
        "algo": "softgm",
        "model": "softgm",
        "observation": "standard",
        "recipe": "",  # kept before recipes had names
        "seed": 0,
        "perturbation": {
            "name": "noise",
            "position_sigma": 0.2,
            "velocity_sigma": 0.1,
            "action_sigma": 0.2,
            "failed_agents": [],
            "tip_force": 0.0,
            "first_step": 0,
            "steps": 0,
        },
        "evaluation_seed": 0,
        "deterministic": True,
        "horizon": 4,
        "batch": None,
        "intervention": "none",
        "device": "cpu",
        "backend": "numba",
        "discount": 0.99,
        "threads": 1,
        "overrides": ["rod.n_elements=20", "task=wall", "perturbation=noise", "perturbation.position_sigma=0.2"],
    }


def test_the_same_command_writes_the_same_bytes_and_another_seed_others(run, tmp_path):
    contents = []
    for number, seed in enumerate((5, 5, 6)):
        run(SOFTGM, *QUICK, f"seed={seed}", "deterministic=false", f"out={number}")
        contents.append([(tmp_path / str(number) / name).read_bytes() for name in ("episodes.csv", "summary.json")])
    assert contents[0] == contents[1]
    assert contents[0][0] != contents[2][0]


def test_episodes_are_the_same_with_a_perturbation_until_it_acts(run, tmp_path):
    for name, *overrides in (("none",), ("disturbance", "perturbation.first_step=4")):
        assert run(SOFTGM, *QUICK, f"perturbation={name}", *overrides, f"out={name}")[0] == 0
    same, pushed = (columns(tmp_path / name / "episodes.csv") for name in ("none", "disturbance"))
    assert same == pushed
    run(SOFTGM, *QUICK, "perturbation=disturbance", "perturbation.first_step=3", "out=early")
    assert columns(tmp_path / "early/episodes.csv") != same


def test_episodes_tell_their_bodies_and_play_the_scenes_of_the_nominal_arm(run, tmp_path):
    run(SOFTGM, *QUICK, "out=nominal")
    status, out, _ = run(SOFTGM, *QUICK, "randomise=wide", "randomise.max_torque=[1,1]", "out=drawn")
    assert status == 0
    assert "softgm on basic, perturbation none, bodies wide, seed 0:" in out
    nominal, drawn = (columns(tmp_path / name / "episodes.csv") for name in ("nominal", "drawn"))
    assert set(drawn) - set(nominal) == {f"body_{name}" for name in FACTORS}
    assert len(set(drawn["body_density"])) == 3
    assert all(0.8 <= float(factor) <= 1.25 for factor in drawn["body_density"])
    assert set(drawn["body_max_torque"]) == {"1.0"}
    assert drawn["tip_travel_distance"] != nominal["tip_travel_distance"]
    assert json.loads((tmp_path / "drawn/summary.json").read_text())["randomise"]["youngs_modulus"] == [0.5, 2.0]
    assert run(SOFTGM, *QUICK, "out=drawn")[0] == 2  # the nominal arm's is another evaluation
    run(SOFTGM, *QUICK, "randomise=wide", "randomise.max_torque=[1,1]", "out=again")
    assert columns(tmp_path / "again/episodes.csv") == drawn


def test_batches_make_as_many_episodes_and_no_two_alike(run, tmp_path):
    assert run(SOFTGM, *QUICK, "episodes=5", "batch=2", "out=x")[0] == 0
    assert len(set(columns(tmp_path / "x/episodes.csv")["final_distance"])) == 5


def test_a_run_keeps_its_evaluations_and_a_file_has_them_elsewhere(run, tmp_path):
    (tmp_path / "run/checkpoints").mkdir(parents=True)
    kept = tmp_path / "run/checkpoints/frames-000000000007.pt"
    shutil.copy(SOFTGM, kept)
    frames, small = archive.load(kept)["frames"], "n_elements-20"
    expected = {
        (
            "run",
            "task=wall",
            "task.n_agents=3",
            "seed=4",
        ): f"run/evaluations/wall_{small}_n_agents-3_horizon-4_none_seed4",
        ("run", "perturbation=noise", "deterministic=false"): (
            f"run/evaluations/basic_{small}_horizon-4_sampled_noise_seed0"
        ),
        ("run/checkpoints/" + kept.name,): f"run/evaluations/basic_{small}_horizon-4_none_seed0_frames{frames}",
        (SOFTGM,): f"outputs/evaluations/basic_softgm/basic_{small}_horizon-4_none_seed0",
        (SOFTGM, "task=wall", "intervention=blind"): (
            f"outputs/evaluations/basic_softgm/wall_{small}_horizon-4_intervention-blind_none_seed0"
        ),
    }
    for arguments, folder in expected.items():
        status, out, err = run(*QUICK, *arguments)
        assert (status, err) == (0, "")
        assert out.endswith(f"written to {folder}\n")
        assert (tmp_path / folder / "summary.json").exists()


def test_nothing_is_replaced_by_accident(run, tmp_path):
    assert run(SOFTGM, *QUICK, "out=x")[0] == 0
    before = (tmp_path / "x/episodes.csv").read_bytes()
    status, _, err = run(SOFTGM, *QUICK, "seed=1", "out=x")
    assert status == 2
    assert err == (
        "softgm_bench.evaluate: out=x holds an evaluation: add overwrite=true to replace it or choose another out\n"
    )
    assert (tmp_path / "x/episodes.csv").read_bytes() == before
    assert run(SOFTGM, *QUICK, "seed=1", "out=x", "overwrite=true")[0] == 0
    assert (tmp_path / "x/episodes.csv").read_bytes() != before
    (tmp_path / "run").mkdir()
    (tmp_path / "run/metrics.csv").write_text("")
    status, _, err = run(SOFTGM, *QUICK, "out=run", "overwrite=true")
    assert (status, err) == (2, "softgm_bench.evaluate: out=run holds a training run: choose another folder\n")


def test_repeating_a_finished_evaluation_shows_its_table_and_plays_nothing(run, monkeypatch, tmp_path):
    _, first, _ = run(SOFTGM, *QUICK, "out=x")
    before = (tmp_path / "x/summary.json").stat().st_mtime_ns
    monkeypatch.setattr(evaluate.Options, "play", lambda *arguments: 1 / 0)
    status, again, err = run(SOFTGM, *QUICK, "out=x")
    assert (status, err) == (0, "")
    assert again.splitlines()[:-1] == first.splitlines()[:-1]
    assert again.splitlines()[-1] == "evaluated before, in x; overwrite=true plays again"
    assert (tmp_path / "x/summary.json").stat().st_mtime_ns == before


def test_an_evaluation_in_pyelastica_says_so_and_is_that_of_the_fused_kernel(run, tmp_path):
    for backend in ("numba", "pyelastica"):
        status, out, err = run(SOFTGM, *QUICK, f"backend={backend}", f"out={backend}")
        assert (status, err) == (0, "")
        assert ("in PyElastica" in out) == (backend == "pyelastica")
        assert json.loads((tmp_path / backend / "summary.json").read_text())["backend"] == backend
    ours, theirs = (columns(tmp_path / backend / "episodes.csv") for backend in ("numba", "pyelastica"))
    for name in ours:
        if "True" not in ours[name] and "False" not in ours[name]:
            np.testing.assert_allclose(np.float64(ours[name]), np.float64(theirs[name]), rtol=1e-5, err_msg=name)


def test_an_evaluation_of_before_backends_were_told_is_known_again(run, tmp_path):
    run(SOFTGM, *QUICK, "out=x")
    path = tmp_path / "x/summary.json"
    held = json.loads(path.read_text())
    del held["backend"]
    path.write_text(json.dumps(held))
    assert "evaluated before" in run(SOFTGM, *QUICK, "out=x")[1]
    assert run(SOFTGM, *QUICK, "backend=torch", "out=x")[0] == 2  # another evaluation


@pytest.mark.parametrize(
    "other",
    [
        (MAPPO,),
        (SOFTGM, "episodes=4"),
        (SOFTGM, "horizon=5"),
        (SOFTGM, "perturbation=noise"),
        (SOFTGM, "randomise=wide"),
    ],
)
def test_another_policy_or_setting_is_another_evaluation(run, other):
    assert run(SOFTGM, *QUICK, "out=x")[0] == 0
    status, out, err = run(*QUICK, *other, "out=x")
    assert (status, out) == (2, "")
    assert "holds an evaluation" in err


def test_a_policy_with_other_parameters_has_another_fingerprint():
    from softgm_bench.episodes import policy

    trained = policy.load(Path(SOFTGM))
    name = policy.fingerprint(trained)
    assert name == policy.fingerprint(policy.load(Path(SOFTGM)))
    with torch.no_grad():
        next(iter(trained.policy.parameters())).view(-1)[0] += 1e-3
    assert policy.fingerprint(trained) != name


def test_on_a_full_disk_the_table_is_left(run, monkeypatch, tmp_path):
    def full(path, content):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    monkeypatch.setattr(evaluation_folder, "write_atomically", full)
    status, out, err = run(SOFTGM, *QUICK, "out=x")
    assert status == 2
    assert "episode length" in out
    assert err == "softgm_bench.evaluate: out=x: No space left on device; the table above is all that there is\n"


MISTAKES = {
    "no source": ([], "give one run folder, checkpoint or policy's file, found none"),
    "no such file": (["nowhere.pt"], "nowhere.pt: No such file or directory"),
    "no checkpoint": (["empty"], "empty: no checkpoint here; name a run folder, a checkpoint or a policy's file"),
    "cut short": (["cut.pt"], "cut.pt: damaged or no checkpoint; use an older one"),
    "one bit": (["flipped.pt"], "flipped.pt: damaged or no checkpoint; use an older one"),
    "no settings": (["bare.pt"], "bare.pt: this version cannot build its networks; use the version that trained it"),
    "no such task": ([SOFTGM, "task=wal"], "task=wal: no such task; choose one of basic, structured, "),
    "no such perturbation": (
        [SOFTGM, "perturbation=nois"],
        "perturbation=nois: no such perturbation; choose one of dis",
    ),
    "misspelt option": ([SOFTGM, "episode=3"], "episode: no such setting; did you mean episodes?"),
    "misspelt key": ([SOFTGM, "task.n_agent=3"], "task.n_agent: no such key; did you mean task.n_agents?"),
    "wrong type": ([SOFTGM, "task.horizon=six"], "task.horizon: Value 'six' of type 'str' could not be converted"),
    "no number": (
        [SOFTGM, "task.n_agents=six"],
        "task.n_agents is six: it must be a whole number, or a list of several",
    ),
    "no agents": ([SOFTGM, "task.n_agents=0"], "task.n_agents is 0: it must be at least 1"),
    "no such agent": (
        [SOFTGM, "perturbation=section_failure", "task.n_agents=2"],
        "perturbation.failed_agents holds 2: the 2 agents are 0 to 1",
    ),
    "settled": ([SOFTGM, "model.heads=2"], "model.heads: no such setting; choose from episodes, "),
    "an MLP's slots": ([MAPPO, "task=wall"], "its networks read 0 obstacle slots, task=wall with 6 agents has 128"),
    "another kind of task": ([SOFTGM, "task=vmas_balance"], "whose observations are not those of task=vmas_balance"),
    "no episodes": ([SOFTGM, "episodes=0"], "episodes=0: it must be at least 1"),
    "no horizon": ([SOFTGM, "horizon=0"], "horizon=0: it must be at least 1"),
    "negative seed": ([SOFTGM, "seed=-1"], "seed=-1: a seed is a whole number from 0 to 2**63 - 1"),
    "no discount": ([SOFTGM, "gamma=1.5"], "gamma=1.5: it must lie between 0 and 1"),
    "no such intervention": ([SOFTGM, "intervention=deaf"], "intervention=deaf: choose one of none, blind, "),
    "nothing to hide": ([SOFTGM, "intervention=blind"], "intervention=blind: task=basic shows no obstacles"),
    "too many threads": ([SOFTGM, "threads=1000"], "threads=1000: choose 1 to "),
    "no such device": ([SOFTGM, "device=tpu"], "device=tpu: choose cpu, cuda or cuda:<index>"),
    "the other device's kernel": (
        [SOFTGM, "backend=cuda"],
        "backend=cuda does not run on device=cpu: choose device=cuda",
    ),
    "PyElastica in single precision": (
        [SOFTGM, "backend=pyelastica", "dtype=float32"],
        "backend=pyelastica has no dtype=float32: add dtype=float64",
    ),
    "PyElastica on a GPU": ([SOFTGM, "backend=pyelastica", "device=cuda"], "device=cuda"),
    "a contact that PyElastica has not": (
        [SOFTGM, "backend=pyelastica", "rod.contact_model=exact"],
        "rod.contact_model=exact with backend=pyelastica: PyElastica has no such contact",
    ),
    "a file in the way": (
        [SOFTGM, "out=cut.pt/x"],
        "out=cut.pt/x: Not a directory; choose a folder that can be written",
    ),
}


@pytest.mark.parametrize(("arguments", "says"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_answered_by_one_line_and_leaves_nothing_behind(run, tmp_path, arguments, says):
    content = Path(SOFTGM).read_bytes()
    middle = len(content) // 2
    (tmp_path / "empty").mkdir()
    (tmp_path / "cut.pt").write_bytes(content[:middle])
    (tmp_path / "flipped.pt").write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    torch.save({"format": checkpoint.FORMATS[-1], "frames": 1, "config": 3}, tmp_path / "bare.pt")
    before = sorted(path.name for path in tmp_path.iterdir())

    status, out, err = run(*arguments)

    assert says in err
    assert err.startswith("softgm_bench.evaluate: ")
    assert err.count("\n") == 1
    assert (status, out) == (2, "")
    assert sorted(path.name for path in tmp_path.iterdir()) == before


@pytest.mark.slow
def test_the_process_ends_with_the_status(tmp_path):
    command = [sys.executable, "-m", "softgm_bench.evaluate", "nowhere"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    assert (done.returncode, done.stderr) == (2, "softgm_bench.evaluate: nowhere: No such file or directory\n")
