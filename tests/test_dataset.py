"""The command that writes data sets: what it asks for, and one line about each mistake."""

import sys
from pathlib import Path

import pytest

from interrupted_writing import interrupt_second_chunk
from softgm_bench import dataset
from softgm_bench.datasets.reading import load

ROOT = Path(__file__).parents[1]
SOFTGM = str(ROOT / "experiments/policies/basic_softgm.pt")
WALL = str(ROOT / "experiments/policies/wall_softgm.pt")
QUICK = ["transitions=20", "horizon=4", "batch=3", "chunk=9"]


@pytest.fixture
def run(monkeypatch, tmp_path, capsys, one_thread):
    """Runs the command in an empty folder: status, what it printed, and its errors."""
    monkeypatch.chdir(tmp_path)

    def command(*arguments):
        monkeypatch.setattr(sys, "argv", ["softgm_bench.dataset", *arguments])
        status = dataset.main()
        return status, *capsys.readouterr()

    return command


def test_a_mixture_is_written_with_its_datasheet_and_a_repeated_command_only_compares(run, tmp_path):
    arguments = ["out=x", f"policies=[random,{SOFTGM}]", "shares=[1,3]", *QUICK, "licence=CC-BY-4.0"]
    status, out, err = run(*arguments)
    assert (status, err) == (0, "")
    assert out.endswith("written to x\n")
    data = load(tmp_path / "x")
    assert [policy["transitions"] for policy in data.settings["policies"]] == [5, 15]
    sheet = (tmp_path / "x/datasheet.md").read_text()
    for told in ("CC-BY-4.0", "`basic`", f"{data.transitions} transitions", " ".join(arguments[3:4]), "torchrl"):
        assert told in sheet
    assert "{" not in sheet.replace("{}", "")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "x").iterdir()}
    status, again, err = run(*arguments[::-1])
    assert (status, err) == (0, "")
    assert again.splitlines()[:-1] == out.splitlines()[:-1]
    assert again.splitlines()[-1] == "written before, and its checksums agree: x"
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "x").iterdir()} == before
    status, _, err = run(*arguments, "seed=3")
    assert (status, err) == (
        2,
        "softgm_bench.dataset: out=x holds a data set with seed=0 and not 3: choose another folder\n",
    )
    (tmp_path / "x/chunk-00001.tdz").write_bytes(b"")
    assert run(*arguments)[2].startswith("softgm_bench.dataset: x/chunk-00001.tdz: ")


def test_an_interruption_says_how_far_it_came(run, monkeypatch):
    interrupt_second_chunk(monkeypatch)
    status, out, err = run("out=x", "task=basic", *QUICK)
    assert (status, out) == (130, "")
    says = "interrupted; whole chunks so far: 1, the same command goes on from there"
    assert err == f"softgm_bench.dataset: {says}\n"
    assert run("out=x", "task=basic", *QUICK)[0] == 0


MISTAKES = {
    "no folder": ([], "name a folder for the data set: out=FOLDER"),
    "no task": (["out=x"], "policies are all random: name a task too"),
    "no such task": (["out=x", "task=wal"], "task=wal: no such task; choose one of basic, structured, "),
    "no such policy": (["out=x", "policies=[nowhere.pt]"], "nowhere.pt: No such file or directory"),
    "two tasks": (["out=x", f"policies=[{SOFTGM},{WALL}]"], f"{WALL} acts in another task than {SOFTGM}: add task="),
    "misspelt": (["out=x", "transition=3"], "transition: no such setting; did you mean transitions?"),
    "no policies": (["out=x", "policies=[]"], "policies=[]: name random or a policy's file at least"),
    "too few shares": (["out=x", "policies=[random,random]", "shares=[1]"], "shares has 1 numbers: policies has 2"),
    "a negative share": (["out=x", "shares=[-1]"], "shares=[-1.0]: every share must be above 0"),
    "no number": (["out=x", "shares=[much]"], "shares[0]: "),
    "nothing": (["out=x", "transitions=0"], "transitions=0: it must be at least 1"),
    "less than one each": (["out=x", "policies=[random,random]", "transitions=1"], "2 policies need one each at least"),
    "no batch": (["out=x", "batch=0"], "batch=0: it must be at least 1"),
    "no horizon": (["out=x", "horizon=0"], "horizon=0: it must be at least 1"),
    "negative seed": (["out=x", "seed=-1"], "seed=-1: a seed is a whole number from 0 to 2**63 - 1"),
    "too many threads": (["out=x", "threads=1000"], "threads=1000: choose 1 to "),
    "no such device": (["out=x", f"policies=[{SOFTGM}]", "device=tpu"], "device=tpu: choose cpu, cuda or cuda:<index>"),
    "no device for random": (["out=x", "task=basic", "device=tpu"], "device=tpu: choose cpu, cuda or cuda:<index>"),
    "something in the way": (["out=full", "task=basic"], "out=full exists and is no data set: choose another folder"),
    "a file in the way": (["out=full/file/x", "task=basic"], "out=full/file/x: Not a directory; choose a folder that"),
}


@pytest.mark.parametrize(("arguments", "says"), MISTAKES.values(), ids=MISTAKES)
def test_a_mistake_is_answered_by_one_line_and_leaves_nothing_behind(run, tmp_path, arguments, says):
    (tmp_path / "full").mkdir()
    (tmp_path / "full/file").touch()
    before = sorted(path.name for path in tmp_path.rglob("*"))
    status, out, err = run(*arguments)
    assert says in err
    assert err.startswith("softgm_bench.dataset: ")
    assert err.count("\n") == 1
    assert (status, out) == (2, "")
    assert sorted(path.name for path in tmp_path.rglob("*")) == before
