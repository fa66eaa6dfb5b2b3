import json
import re
import subprocess
import sys
from pathlib import Path

import matplotlib
import pytest

from made_up_runs import write_evaluation, write_run
from softgm_bench.report import report

ROOT = Path(__file__).parents[1]
COMMITTED = ROOT / "experiments" / "report"


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def rows(text, title):
    """Cells of the Markdown table below a caption, by the first column."""
    table = text[text.index(title) :].split("\n\n")[1]
    return [[cell.strip(" *").replace("\\", "") for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The report of a few runs, of an unfinished one and a damaged one, and of evaluations beside them."""
    root = tmp_path_factory.mktemp("report")
    for seed in range(3):
        folder = write_run(root / "runs", "wall", "softgm", seed, success=0.5)
        write_evaluation(folder / "evaluations" / "n", "wall", "softgm", seed, {"name": "noise", "position_sigma": 0.1})
    beside = root / "runs" / "wall" / "softgm" / "seed0" / "evaluations"
    for name, success, further in (
        ("plain", 0.9, {}),
        ("blind", 0.1, {"intervention": "blind"}),
        ("other", 0.1, {"intervention": "blind", "evaluation_seed": 9}),
    ):
        further |= {"overrides": ("rod.substeps=50",)}  # not Table II's
        write_evaluation(beside / name, "wall", "softgm", 0, {"name": "none"}, success, **further)
    write_run(root / "runs", "wall", "mappo", 0, success=0.3)
    write_run(root / "runs", "wall", "mappo_oracle", 0, success=1.0, observation="oracle")
    write_run(root / "runs", "wall", "softgm_no_stage1", 0, success=0.1)
    write_run(root / "runs", "wall_narrow", "softgm", 0, success=0.1)
    (write_run(root / "runs", "basic", "softgm", 0) / "summary.json").unlink()
    (write_run(root / "runs", "basic", "mappo", 0) / "summary.json").write_text("{")
    report([str(root / "runs"), f"out={root / 'out'}", "resamples=200"])
    return root


@pytest.mark.slow
def test_the_committed_report_is_what_the_committed_runs_give(tmp_path, monkeypatch):
    made_with = json.loads((COMMITTED / "made_with.json").read_text())
    if made_with["matplotlib"] != matplotlib.__version__:
        pytest.skip(f"made with matplotlib {made_with['matplotlib']}, here is {matplotlib.__version__}")
    monkeypatch.setitem(matplotlib.rcParams, "axes.facecolor", "red")  # a reader's own settings do not matter
    report([str(ROOT / "experiments" / "campaign"), f"out={tmp_path}"])
    made, committed = contents(tmp_path), contents(COMMITTED)
    assert made.keys() == committed.keys()
    assert [name for name in made if made[name] != committed[name]] == []


@pytest.mark.slow
def test_the_same_runs_give_the_same_bytes_in_another_process(made, tmp_path):
    command = [sys.executable, "-m", "softgm_bench.report", "runs", f"out={tmp_path}", "resamples=200"]
    subprocess.run(command, cwd=made, check=True, capture_output=True)
    assert contents(tmp_path) == contents(made / "out")


def test_table_one_has_ours_beside_the_papers_and_says_what_was_not_run(made):
    text = (made / "out" / "report.md").read_text()
    wall = {row[0]: row for row in rows(text, "Table I, Wall with hole")}
    assert wall["SoftGM"][1:6] == ["tuned", "2.00", "10", "3 × 100", "—"]
    assert wall["SoftGM"][8] == "41.33"
    assert wall["SoftGM"][10] == "1,297.5 ± 907.0"
    assert wall["MAPPO"][5] == "1 of 3 seeds"
    assert wall["MAPPO"][7].endswith("(1 seed)")
    assert wall["MAPPO, oracle†"][5] == "not ranked"
    assert wall["IDDPG"][4] == wall["IDDPG"][6] == wall["IDDPG"][9] == "not run"
    assert wall["IDDPG"][8] == "11.00"
    assert wall["IPPO"][12] == "—"
    assert {row[6] for row in rows(text, "Table I, Basic")} == {"not run"}


def test_numbers_are_those_of_the_raw_episodes(made):
    lengths, successes = [], []
    for path in sorted((made / "runs" / "wall" / "softgm").glob("seed*/episodes.csv")):
        for line in path.read_text().splitlines()[1:]:
            cells = line.split(",")
            lengths.append(int(cells[3]))
            successes.append(cells[4] == "True")
    mean = sum(lengths) / 300
    deviation = (sum((length - mean) ** 2 for length in lengths) / 300) ** 0.5
    (row,) = [row for row in rows((made / "out" / "report.md").read_text(), "Table I, Wall") if row[0] == "SoftGM"]
    assert row[6] == f"{sum(successes) / 3:.1f}"
    assert row[9] == f"{mean:,.1f} ± {deviation:,.1f}"


def test_table_two_has_nominal_and_the_papers_three_conditions(made):
    table = rows((made / "out" / "report.md").read_text(), "Table II")
    assert [(row[2], row[3], row[6]) for row in table] == [
        ("Nominal", "3 × 100", "41.33"),
        ("Noise", "3 × 100", "37.33"),
        ("Section failure", "not run", "36.00"),
        ("Disturbance", "not run", "40.33"),
    ]


def test_ablations_are_compared_with_the_full_model(made):
    table = rows((made / "out" / "report.md").read_text(), "Ablations:")
    assert len(table) == 9
    without = {(row[0], row[1]): row for row in table}["Wall with hole", "SoftGM without stage 1"]
    assert without[2] == "1 × 100"
    assert float(without[5].replace("−", "-")) < -20
    assert (made / "out" / "figures" / "ablations.svg").exists()


def test_what_cannot_be_used_is_listed_with_the_reason(made):
    left = dict(rows((made / "out" / "report.md").read_text(), "Found, and in no table"))
    assert set(left) == {"runs/basic/softgm/seed0", "runs/basic/mappo/seed0"}
    assert left["runs/basic/softgm/seed0"].startswith("unfinished")
    assert left["runs/basic/mappo/seed0"].startswith("damaged")


def test_every_source_is_named(made):
    text = (made / "out" / "report.md").read_text()
    assert len(rows(text, "Every run that")) == 7
    assert {row[-1] for row in rows(text, "Every evaluation")} == {
        *(f"runs/wall/softgm/seed{seed}/evaluations/n" for seed in range(3)),
        *(f"runs/wall/softgm/seed0/evaluations/{name}" for name in ("plain", "blind", "other")),
    }


def test_success_by_step_ends_at_the_success_rate_and_never_falls(made):
    text = (made / "out" / "report.md").read_text()
    table = rows(text, "Success by control step")
    wall = {row[0]: row for row in rows(text, "Table I, Wall with hole")}
    assert [row[:3] for row in table if row[0] == "Wall with hole"] == [
        ["Wall with hole", "MAPPO", "1 × 100"],
        ["Wall with hole", "SoftGM", "3 × 100"],
        ["Wall with hole", "SoftGM without stage 1", "1 × 100"],
        ["Wall with hole", "MAPPO, oracle†", "1 × 100"],
    ]
    for row in table:
        shares = [float(share) for share in row[3:]]
        assert len(shares) == 5
        assert shares == sorted(shares)
        if row[0] == "Wall with hole" and row[1] in wall:
            assert row[-1] == wall[row[1]][6]


def test_interventions_are_compared_with_the_same_episodes_without(made):
    compared, refused = rows((made / "out" / "report.md").read_text(), "Interventions:")
    assert compared[:6] == ["Wall with hole", "SoftGM", "Nominal", "blind", "0", "100"]
    without, under, difference = (float(cell.replace("−", "-")) for cell in compared[6:9])
    assert difference == pytest.approx(under - without)
    assert difference < -50
    lost, won = map(int, compared[9:11])
    assert lost - won == pytest.approx(without - under)
    assert float(compared[11]) < 1e-6
    assert refused[6:] == [*["—"] * 6, "not the same scenes: seed 9 and 1"]


def test_the_page_holds_every_figure_and_no_path_of_the_machine(made):
    page = (made / "out" / "report.html").read_text()
    figures = {path.stem for path in (made / "out" / "figures").glob("*.svg")}
    assert figures == {path.stem for path in (made / "out" / "figures").glob("*.pdf")}
    assert {"learning_curves", "ablations", "time_to_target"} <= figures
    assert "probability_of_improvement" not in figures  # one algorithm alone has three seeds
    assert "No two algorithms have 3 seeds at equal frames" in page
    assert all(f'<figure class="picture" id="figure-{name}">' in page for name in figures)
    for name, content in contents(made / "out").items():
        assert str(made).encode() not in content, name


def test_a_page_has_no_identifier_twice(made):
    names = re.findall(r'\bid="([^"]+)"', (made / "out" / "report.html").read_text())
    assert len(names) == len(set(names))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["nowhere"], "nowhere: no such folder"),
        (["empty"], "empty: no finished run below it"),
        (["half"], "no finished run below it; a run's folder holds config.yaml and summary.json; half/basic"),
        ([], "give one folder of runs"),
        (["empty", "outt=x"], "outt: no such setting"),
        (["empty", "resamples=1"], "resamples=1: it must be at least 100"),
        (["empty", "resamples=many"], "resamples: "),
        (["empty", "seed=-1"], "seed=-1: it must be 0 or more"),
        (["whole", "evaluations=nowhere"], "nowhere: no such folder"),
        (["whole", "out=whole/taken"], "whole/taken"),
    ],
)
def test_a_mistake_is_one_line(tmp_path, monkeypatch, capsys, arguments, message):
    from softgm_bench.command import run

    (tmp_path / "empty").mkdir()
    (write_run(tmp_path / "half", "basic", "softgm", 0) / "summary.json").unlink()
    write_run(tmp_path / "whole", "basic", "softgm", 0)
    (tmp_path / "whole" / "taken").write_text("a file")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["report", *arguments])
    assert run("report", "", report) == 2
    printed = capsys.readouterr().err
    assert printed.startswith("softgm_bench.report: ")
    assert message in printed
    assert printed.count("\n") == 1
