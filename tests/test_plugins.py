import os
import sys

import pytest

from softgm_bench import plugins
from softgm_bench.config import compose_untyped
from softgm_bench.envs.tasks import TASKS, Task, register_task
from softgm_bench.errors import UserError


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder of plugins; whatever is imported from it is forgotten afterwards."""
    monkeypatch.setenv(plugins.VARIABLE, str(tmp_path))
    monkeypatch.setattr(plugins, "_imported", {})
    monkeypatch.setattr(sys, "path", list(sys.path))
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        del sys.modules[name]


def test_files_are_imported_once_and_those_with_an_underscore_are_left_to_the_others(folder):
    (folder / "mine_a.py").write_text("import _mine_b\nnumber = _mine_b.number\n")
    (folder / "_mine_b.py").write_text("number = 3\n")
    plugins.load()
    (folder / "mine_a.py").write_text("raise RuntimeError\n")
    plugins.load()

    assert sys.modules["mine_a"].number == 3


def test_several_folders_are_read_in_order(folder, tmp_path_factory):
    other = tmp_path_factory.mktemp("other")
    (other / "mine_c.py").write_text("")

    plugins.add(other)

    assert plugins.folders() == [folder, other]
    assert os.environ[plugins.VARIABLE] == f"{folder}{os.pathsep}{other}"
    assert "mine_c" in sys.modules


def test_a_file_that_fails_is_named_every_time(folder):
    (folder / "mine_d.py").write_text("def f(:\n")

    for _ in range(2):
        with pytest.raises(UserError, match=r"mine_d\.py: SyntaxError: "):
            plugins.load()


def test_a_file_with_the_name_of_another_module_is_refused(folder):
    (folder / "json.py").write_text("")

    with pytest.raises(UserError, match=r"json\.py: another module is called json"):
        plugins.load()


def test_a_folder_that_is_not_there_is_named(folder, monkeypatch):
    monkeypatch.setenv(plugins.VARIABLE, str(folder / "gone"))

    with pytest.raises(UserError, match="gone is no folder"):
        compose_untyped([])


def test_a_plugin_adds_settings_and_replaces_none(folder):
    (folder / "conf/task").mkdir(parents=True)
    (folder / "conf/task/basic.yaml").write_text("name: basic\nhorizon: 1\n")
    (folder / "conf/task/far.yaml").write_text("defaults: [basic, _self_]\nhorizon: 7\n")

    assert compose_untyped(["task=basic"]).task.horizon == 2000
    assert compose_untyped(["task=far"]).task.horizon == 7


def test_a_name_that_is_taken_is_refused():
    before = TASKS["wall"]

    with pytest.raises(ValueError, match="task 'wall' is registered already"):
        register_task("wall")(Task)

    assert TASKS["wall"] is before
