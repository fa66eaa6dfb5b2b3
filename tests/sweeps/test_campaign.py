"""Which cells a campaign begins, with how much time each, and what it takes for done."""

import json
import subprocess
import sys
import time
from pathlib import Path

import pytest

from made_up_runs import write_run
from softgm_bench.config import compose, plain
from softgm_bench.errors import UserError
from softgm_bench.sweeps import campaign
from softgm_bench.sweeps.packing import Pack


@pytest.mark.parametrize(
    ("seconds", "cells", "jobs", "expected"),
    [
        (600.0, 6, 3, 300.0),  # two rounds
        (600.0, 7, 3, 200.0),
        (600.0, 2, 3, 600.0),  # each has a place of its own
        (600.0, 63, 3, 120.0),  # no more rounds than there is time for
        (130.0, 63, 3, 130.0),
        (119.0, 1, 3, None),
        (-5.0, 1, 3, None),
    ],
)
def test_the_time_is_shared_among_rounds_of_cells(seconds, cells, jobs, expected):
    assert campaign.share(seconds, cells, jobs, least=120.0) == expected


def test_all_of_the_time_is_used_and_none_is_given_twice():
    left, waiting = 600.0, 7
    while waiting and (seconds := campaign.share(left, waiting, 3, 60.0)) is not None:
        waiting, left = waiting - min(3, waiting), left - seconds
    assert waiting == 0
    assert left == pytest.approx(0.0)


def test_cells_are_those_of_the_grid_without_those_that_are_done():
    overrides = ["experiment=gpu", "+grids=table1", "algo=softgm,mappo", "task=wall", "device=cpu"]
    found = campaign.planned(overrides, done=["wall/mappo/seed1"])
    assert list(found) == [
        *(f"wall/softgm/seed{seed}" for seed in (0, 1, 2)),
        *(f"wall/mappo/seed{seed}" for seed in (0, 2)),
    ]
    assert {"experiment=gpu", "device=cpu", "algo=mappo", "seed=2"} <= set(found["wall/mappo/seed2"])


def test_the_last_setting_of_a_key_counts():
    found = campaign.planned(["experiment=gpu", "device=cuda", "seed=0,1", "experiment=smoke", "device=cpu", "seed=4"])
    assert found == {"basic/softgm/seed4": ["experiment=smoke", "device=cpu", "seed=4"]}


def test_cells_that_would_share_a_folder_are_refused():
    with pytest.raises(UserError, match=r"^basic/softgm/seed0: two cells have this folder; "):
        campaign.planned(["algo.gamma=0.9,0.95"])


def test_finished_runs_are_done_wherever_they_were_unpacked(tmp_path):
    write_run(tmp_path / "first/runs", "wall", "softgm", 0)
    write_run(tmp_path / "second/runs", "basic", "mappo_noise", 2)
    (write_run(tmp_path / "second/runs", "basic", "mappo", 1) / "summary.json").unlink()
    assert campaign.finished(tmp_path) == ["wall/softgm/seed0", "basic/mappo_noise/seed2"]
    assert campaign.finished(tmp_path / "nowhere") == []


def test_without_time_no_cell_begins_and_all_are_named(tmp_path):
    said = []
    cells = {"wall/softgm/seed0": ["seed=0"], "wall/softgm/seed1": ["seed=1"]}
    work = campaign.Campaign(cells, tmp_path / "runs", time.monotonic() + 100.0, jobs=2)
    campaign.run(work, Pack(tmp_path / "out"), said.append)
    assert said == ["too little time is left for wall/softgm/seed0, wall/softgm/seed1"]
    assert not (tmp_path / "runs").exists()


ANSWERING = "import json, sys; print(json.dumps({'outcome': sys.argv[1], 'line': 'in a word'}))"


def test_a_failed_cell_leaves_its_last_lines_in_the_log_and_stops_no_other(tmp_path, monkeypatch):
    def start(values, overrides, cwd, number):
        folder = Path(values["run_dir"])
        folder.mkdir(parents=True)
        (folder / "output.log").write_text("".join(f"line {k}\n" for k in range(100)))
        outcome = "failed" if values["seed"] == 0 else "interrupted"
        return subprocess.Popen([sys.executable, "-c", ANSWERING, outcome], stdout=subprocess.PIPE, text=True)

    monkeypatch.setattr(campaign.sweep_cell, "start", start)
    cells = {f"basic/softgm/seed{seed}": [f"seed={seed}"] for seed in (0, 1)}
    said = []
    work = campaign.Campaign(cells, tmp_path / "runs", time.monotonic() + 600.0, jobs=1)
    campaign.run(work, Pack(tmp_path / "out"), said.append)
    at = said.index("basic/softgm/seed0: failed, in a word")
    assert said[at + 1 : at + 1 + campaign.TAIL] == [f"    line {k}" for k in range(100 - campaign.TAIL, 100)]
    assert said[-1] == "basic/softgm/seed1: interrupted, in a word"


def test_finished_runs_in_the_way_are_packed_if_they_are_the_campaigns_own_and_never_done_again(tmp_path, monkeypatch):
    monkeypatch.setattr(campaign.sweep_cell, "start", lambda *_: pytest.fail("it was begun"))
    cells = {f"basic/softgm/seed{seed}": [f"seed={seed}", "task=basic"] for seed in (0, 1)}
    for seed, gamma in ((0, 0.95), (1, 0.5)):
        folder = write_run(tmp_path / "runs", "basic", "softgm", seed)
        config = plain(compose(["task=basic", f"seed={seed}", f"algo.gamma={gamma}", "experiment.minutes=3"]))
        (folder / "config.yaml").write_text(json.dumps(config))
        (folder / campaign.POLICY).write_bytes(b"policy")
    said = []
    pack = Pack(tmp_path / "out")
    campaign.run(campaign.Campaign(cells, tmp_path / "runs", time.monotonic() + 600.0, jobs=1), pack, said.append)
    assert pack.names == ["basic/softgm/seed0"]
    assert said[1].startswith("basic/softgm/seed1: ")
    assert said[1].endswith("holds a run with another algo.gamma; choose another --work")


def test_processes_are_stopped_all_at_once_also_those_that_will_not():
    stubborn = "import signal, time; signal.signal(signal.SIGTERM, signal.SIG_IGN); print(flush=True); time.sleep(60)"
    children = [
        subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE)
        for code in (stubborn, "import time; print(flush=True); time.sleep(60)", "print()")
    ]
    for child in children:
        child.stdout.readline()
    children[2].wait()
    began = time.monotonic()
    campaign.stop(children, patience=1.0)
    assert time.monotonic() - began < 5.0
    assert [child.returncode for child in children] == [-9, -15, 0]
