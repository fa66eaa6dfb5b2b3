"""What a sweep decides before it starts: cores, cells, what counts as finished."""

import json
from itertools import product

import pytest
from omegaconf import OmegaConf

from pairwise import partly
from softgm_bench.config import config_directory
from softgm_bench.errors import UserError
from softgm_bench.sweeps import cell as sweep_cell
from softgm_bench.sweeps import launch as sweep

GRIDS = ("table1", "table2", "ablation")


@pytest.fixture
def eight_cores(monkeypatch):
    monkeypatch.setattr(sweep, "available_threads", lambda: 8)


def planned(*overrides):
    """Our settings on top of these, by key."""
    for launcher in ("joblib", "submitit_local", "submitit_slurm", "ray"):
        if f"hydra/launcher={launcher}" in overrides and not sweep.installed(launcher):
            pytest.skip(f"the launcher is not installed; extra {sweep.EXTRAS[launcher]}")
    own = sweep.plan(overrides).overrides[len(overrides) :]
    return {one.lstrip("+").partition("=")[0]: one.partition("=")[2] for one in own if "env_set" not in one}


JOBLIB = "hydra/launcher=joblib"
BOUNDS = {
    "nothing said": ((JOBLIB, "seed=0,1"), {"n_jobs": "8", "threads": "1"}),
    "threads": ((JOBLIB, "seed=0,1", "threads=3"), {"n_jobs": "2"}),
    "swept threads": ((JOBLIB, "threads=1,4"), {"n_jobs": "2"}),
    "jobs": ((JOBLIB, "seed=0,1", "hydra.launcher.n_jobs=3"), {"threads": "2"}),
    "all jobs": ((JOBLIB, "seed=0,1", "hydra.launcher.n_jobs=-1"), {"threads": "1"}),
    "in batches": (("hydra/launcher=submitit_local", "threads=2"), {"cpus_per_task": "2", "max_batch_size": "4"}),
    "a queue": (("hydra/launcher=submitit_slurm", "hydra.launcher.cpus_per_task=4"), {"threads": "4"}),
    "ray": (("hydra/launcher=ray", "threads=2"), {"num_cpus": "8"}),
    "one after another": (("hydra/launcher=basic", "seed=0,1"), {}),
}


@pytest.mark.parametrize(("overrides", "expected"), BOUNDS.values(), ids=BOUNDS)
def test_jobs_at_once_times_threads_are_at_most_the_cores(eight_cores, overrides, expected):
    own = {key.rpartition(".")[2]: value for key, value in planned(*overrides).items() if "remote" not in key}
    own.pop("batch_size", None)
    assert own == expected


def test_more_jobs_times_threads_than_cores_are_refused(eight_cores):
    with pytest.raises(UserError, match=r"n_jobs=4 with threads=3: this machine has 8 cores"):
        planned(JOBLIB, "hydra.launcher.n_jobs=4", "threads=3")


def test_a_launcher_that_is_not_installed_is_named_with_its_extra(monkeypatch):
    monkeypatch.setattr(sweep, "installed", lambda launcher: False)
    with pytest.raises(UserError, match=r"hydra/launcher=ray: not installed; pip install '\.\[ray\]'"):
        sweep.plan(["hydra/launcher=ray", "seed=0,1"])


def test_cells_are_the_product_in_the_order_of_the_jobs():
    found, top = sweep.cells(["algo=softgm,mappo", "seed=range(0,2)", "task=wall"])
    expected = [f"outputs/wall/{algo}/seed{seed}" for algo, seed in product(("softgm", "mappo"), (0, 1))]
    assert [str(cell.run_dir) for cell in found] == expected
    assert str(top) == "outputs"
    assert found[1].overrides == ("algo=softgm", "seed=1", "task=wall")


def test_a_grids_value_gives_way_to_the_command_lines():
    found, _ = sweep.cells(["+grids=ablation", "model=softgm", "seed=7", "task=wall"])
    assert [str(cell.run_dir) for cell in found] == ["outputs/full/wall/softgm/seed7"]


@pytest.mark.parametrize("size", partly(["", "_smoke"], [""]))
def test_named_grids_have_the_papers_cells_and_share_those_that_are_the_same(size):
    cells = {grid: sweep.cells([f"+grids={grid}{size}"])[0] for grid in ("table2", "ablation")}
    softgm = {cell.run_dir for cell in cells["table2"]}
    ablations = {cell.run_dir for cell in cells["ablation"]}
    assert len(softgm) == 3
    assert len(ablations) == 27
    assert softgm < ablations
    assert softgm == {cell.run_dir for cell in sweep.cells([f"+grids=table1{size}", "algo=softgm", "task=wall"])[0]}


@pytest.mark.slow
def test_the_ladder_goes_from_blind_to_told_and_shares_the_wholes_runs():
    assert len(sweep.cells(["+grids=ladder"])[0]) == 36
    rungs = [str(cell.run_dir) for cell in sweep.cells(["+grids=ladder", "seed=1", "task=wall"])[0]]
    assert rungs == [f"outputs/full/wall/{name}/seed1" for name in ("softgm_no_stage1", "softgm", "softgm_remember")]
    table, _ = sweep.cells(["+grids=ladder", "seed=1", "task=wall", "algo=mappo", "model=mlp"])
    assert [str(cell.run_dir) for cell in table] == ["outputs/full/wall/mappo/seed1"]
    told, _ = sweep.cells(["+grids=ladder", "seed=1", "task=wall", "model=softgm", "observation=oracle"])
    assert [str(cell.run_dir) for cell in told] == ["outputs/full/wall/softgm_oracle/seed1"]
    recurrent, _ = sweep.cells(["+grids=ladder", "seed=1", "model=softgm", "algo.actor.memory={cell:gru,size:128}"])
    tasks = ("wall", "wall_touch", "wall_sense", "wall_decoy")
    assert [str(cell.run_dir) for cell in recurrent] == [f"outputs/full/{task}/softgm_gru/seed1" for task in tasks]


@pytest.mark.parametrize("size", partly(["", "_smoke"], ["_smoke"]))
def test_the_rivals_differ_in_the_model_alone_and_share_softgms_runs_with_the_ladder(size):
    cells = sweep.cells([f"+grids=rivals{size}"])[0]
    assert len(cells) == 27
    names = [str(cell.run_dir.parent.name) for cell in cells if "wall_sense" in str(cell.run_dir)]
    assert sorted(set(names)) == ["softgm", "softgm_informarl", "softgm_section_transformer"]
    if not size:
        softgm = {cell.run_dir for cell in cells if cell.run_dir.parent.name == "softgm"}
        assert softgm < {cell.run_dir for cell in sweep.cells(["+grids=ladder"])[0]}


def test_table_one_has_every_algorithm_task_and_seed():
    params = OmegaConf.load(config_directory() / "grids" / "table1.yaml").hydra.sweeper.params
    assert sorted(params.algo.split(",")) == ["iddpg", "ippo", "isac", "maddpg", "mappo", "masac", "softgm"]
    assert (params.task, params.seed) == ("basic,structured,wall", "0,1,2")


@pytest.mark.parametrize("task", ["basic", "wall"])
@pytest.mark.parametrize("grid", ["table1", "table1_smoke"])
def test_a_grids_settings_are_a_valid_run_of_the_tasks_own_length(settings, grid, task):
    (cell,), _ = sweep.cells([f"+grids={grid}", "algo=mappo", "seed=1", f"task={task}"])
    config = settings(*cell.overrides)
    frames = 384 if grid.endswith("smoke") else {"basic": 1_000_000, "wall": 3_000_000}[task]
    assert (config.experiment.total_frames, config.seed, config.task.name) == (frames, 1, task)


@pytest.fixture
def finished_run(tmp_path):
    settings = {"seed": 0, "task": {"name": "wall", "wall_x": 0.4}, "experiment": {"total_frames": 100}, "threads": 1}
    metrics = {"success_rate": {"mean": 0.5, "low": 0.4, "high": 0.6}}
    (tmp_path / "config.yaml").write_text(json.dumps(settings))
    (tmp_path / "summary.json").write_text(json.dumps({"frames": 104, "final_evaluation": metrics}))
    return tmp_path, settings


def test_a_finished_run_with_the_same_settings_needs_not_be_done(finished_run):
    folder, settings = finished_run
    assert sweep_cell.finished(settings | {"threads": 4, "resume": False}, folder) == "success 0.500 [0.400, 0.600]"


CHANGES = {
    "another value": {"seed": 1},
    "another value further down": {"task": {"name": "wall", "wall_x": 0.5}},
    "a longer run": {"experiment": {"total_frames": 200}},
}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_finished_run_with_other_settings_is_another(finished_run, change):
    folder, settings = finished_run
    assert sweep_cell.finished(settings | change, folder) == ""


@pytest.mark.parametrize("name", ["config.yaml", "summary.json"])
def test_a_damaged_run_is_not_finished(finished_run, name):
    folder, settings = finished_run
    (folder / name).write_text("{")
    assert sweep_cell.finished(settings, folder) == ""


def test_a_cell_that_leaves_no_word_is_not_taken_for_done(tmp_path, capsys):
    plan = sweep.Plan([], tmp_path / "records", jobs=2)
    with sweep.reported(plan) as outcomes:
        record = {"number": 1, "run_dir": "outputs/b", "overrides": [], "outcome": "done", "line": "success"}
        (plan.records / "000001.json").write_text(json.dumps(record))
    captured = capsys.readouterr()
    assert captured.out == "[1 of 2] outputs/b: done, success\n"
    first, last = captured.err.splitlines()
    assert first == f"2 cells; softgm-bench status {tmp_path} tells of each"
    assert last == "softgm_bench: 1 of 2 cells did not come to an end"
    assert not outcomes.all_well
    assert not plan.records.exists()


def test_jobs_of_a_named_grid_are_counted_without_composing_them():
    assert sweep.plan(["+grids=table1", "task=basic"]).jobs == 21


def test_a_glob_is_the_names_that_fit_it():
    found, _ = sweep.cells(["task=glob(b*)", "seed=0,1"])
    assert [cell.overrides for cell in found] == [("task=basic", "seed=0"), ("task=basic", "seed=1")]
    assert sweep.plan(["task=glob(wall_f*)", "algo=ippo"]).jobs == 1
    with pytest.raises(UserError, match=r"^task=glob\(zz\*\): nothing in conf/task fits it$"):
        sweep.cells(["task=glob(zz*)"])
