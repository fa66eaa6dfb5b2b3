"""Watching a run: what the address answers, to whom, and that a newer checkpoint takes the place of an older one."""

import json
import shutil
import sys
import threading
from http.client import HTTPConnection
from importlib import import_module
from pathlib import Path

import pytest
import torch

from softgm_bench.episodes import policy
from softgm_bench.errors import UserError
from softgm_bench.storage.run_folder import RunFolder

watch = import_module("softgm_bench.watch")
POLICY = Path(__file__).parents[1] / "experiments/policies/basic_softgm.pt"
OPTIONS = watch.Options(horizon=2, port=0)


@pytest.fixture
def run(tmp_path):
    """A run's folder as it is before its first iteration has ended."""
    folder = RunFolder(tmp_path)
    folder.config.write_text("{}")
    folder.checkpoints.mkdir()
    return folder


@pytest.fixture
def ask(run):
    """The status and the text that an address answers with."""
    threads = torch.get_num_threads()
    server = watch.serve(watch.Show(run, OPTIONS), 0)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()

    def get(address, host=None):
        connection = HTTPConnection("127.0.0.1", server.server_address[1], timeout=120)
        connection.request("GET", address, headers={"Host": host} if host else {})
        answer = connection.getresponse()
        return answer.status, answer.read().decode()

    yield get
    server.shutdown()
    server.server_close()
    torch.set_num_threads(threads)


def test_before_the_first_checkpoint_there_is_a_page_that_waits(ask):
    status, page = ask("/")
    assert status == 200
    assert "/episode" in page
    assert json.loads(ask("/state")[1]) == {
        "run": json.loads(ask("/state")[1])["run"],
        "checkpoint": None,
        "frames": 0,
        "success": None,
        "finished": False,
    }
    status, line = ask("/episode")
    assert status == 503
    assert line.endswith("no checkpoint yet")


def test_the_newest_checkpoint_plays_and_is_recorded_once(run, ask, monkeypatch):
    loaded = []
    load = policy.load
    monkeypatch.setattr(policy, "load", lambda path: loaded.append(path.name) or load(path))
    shutil.copy(POLICY, run.checkpoints / "frames-000000000100.pt")
    run.metrics.write_text("iteration,frames,success_rate\n1,50,\n2,100,0.25\n3,15")  # a row is being written
    assert json.loads(ask("/state")[1])["success"] == "0.25"
    status, first = ask("/episode?frames-000000000100.pt")
    assert status == 200
    assert 'id="episode"' in first
    assert ask("/episode")[1] == first
    shutil.copy(POLICY, run.checkpoints / "frames-000000000200.pt")
    assert json.loads(ask("/state")[1])["checkpoint"] == "frames-000000000200.pt"
    ask("/episode")
    assert loaded == ["frames-000000000100.pt", "frames-000000000200.pt"]


def test_another_machines_name_and_other_addresses_are_refused(ask):
    assert ask("/state", host="elsewhere.example:80")[0] == 403
    assert ask("/../config.yaml")[0] == 404
    assert ask("/state", host="localhost:1")[0] == 200


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["nowhere"], "nowhere: no run here; name a run's folder"),
        (["nowhere", "port=70000"], "port=70000: choose 0 to 65535"),
        (["nowhere", "horizon=0"], "horizon=0: choose 1 to"),
        (["nowhere", "seed=-1"], "seed=-1: it must be 0 or more"),
    ],
)
def test_a_mistake_is_one_line(arguments, says, monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "argv", ["watch", *arguments])
    assert watch.main() == 2
    assert capsys.readouterr().err.startswith(f"softgm_bench.watch: {says}")


def test_a_port_that_is_taken_is_one_line(run, ask, monkeypatch):
    server = watch.serve(watch.Show(run, OPTIONS), 0)
    try:
        with pytest.raises(UserError, match="choose another, or port=0"):
            watch._watch([str(run.path), f"port={server.server_address[1]}"])
    finally:
        server.server_close()
