"""Cells are dealt out to the GPUs that there are, and a training is shown its own alone."""

import json
import os
import sys

import pytest
import torch

from softgm_bench.config import compose, plain
from softgm_bench.sweeps import cell as sweep_cell
from softgm_bench.sweeps import devices
from softgm_bench.sweeps import launch as sweep


@pytest.fixture
def three_gpus(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    monkeypatch.delenv(devices.VISIBLE, raising=False)


def given(*overrides):
    """What a sweep's jobs are told of GPUs."""
    own = [one for one in sweep.plan(overrides).overrides if devices.GPUS in one]
    return own[0].partition("=")[2].strip("'") if own else None


def test_a_sweep_on_cuda_deals_out_the_gpus_that_it_sees(three_gpus, monkeypatch):
    assert given("hydra/launcher=basic", "device=cuda", "seed=0,1") == "0,1,2"
    monkeypatch.setenv(devices.VISIBLE, "4,GPU-5ab,6")
    assert given("hydra/launcher=basic", "device=cuda", "seed=0,1") == "4,GPU-5ab,6"


def test_a_named_gpu_the_cpu_and_a_single_gpu_are_left_as_they_are(three_gpus, monkeypatch):
    for device in ("cpu", "cuda:1"):
        assert given("hydra/launcher=basic", f"device={device}", "seed=0,1") is None
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    assert given("hydra/launcher=basic", "device=cuda", "seed=0,1") is None


def test_jobs_take_turns():
    environment = {devices.GPUS: "4,GPU-5ab,6"}
    found = [devices.dealt("cuda", number, environment) for number in range(4)]
    assert [device for device, _ in found] == ["cuda:0", "cuda:1", "cuda:2", "cuda:0"]
    assert [variables[devices.VISIBLE] for _, variables in found] == ["4", "GPU-5ab", "6", "4"]
    assert devices.dealt("cuda", 3, {}) == ("cuda", {})
    assert devices.dealt("cpu", 3, environment) == ("cpu", {})


SHOWN = """
import json, os, sys
job = json.loads(sys.stdin.read())
seen = [os.environ.get("CUDA_VISIBLE_DEVICES"), job["device"], job["config"]["device"]]
print(json.dumps({"outcome": "done", "line": " ".join(map(str, seen))}))
"""


def test_a_training_sees_its_gpu_alone_and_its_settings_do_not_name_it(tmp_path, monkeypatch):
    program = tmp_path / "shown.py"
    program.write_text(f"#!{sys.executable}\n{SHOWN}")
    program.chmod(0o755)
    monkeypatch.setattr(sweep_cell.sys, "executable", str(program))
    monkeypatch.setenv(devices.GPUS, "4,GPU-5ab")
    values = json.loads(json.dumps(plain(compose(["device=cuda"]))))
    assert sweep_cell._train_apart(values, [], tmp_path, 1)["line"] == "GPU-5ab cuda:1 cuda"
    usual = os.environ.get(devices.VISIBLE)
    assert sweep_cell._train_apart(values | {"device": "cpu"}, [], tmp_path, 1)["line"] == f"{usual} cpu cpu"
