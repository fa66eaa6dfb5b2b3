import pytest

from softgm_bench.errors import UserError
from softgm_bench.runs import folder as run_folder

CONFIG = {"seed": 0}


def test_a_finished_run_is_refused_until_overwrite_and_then_only_its_own_files_go(tmp_path):
    folder = run_folder.create(str(tmp_path), CONFIG, overwrite=False)
    folder.summary.write_text("{}")
    folder.evaluations.write_text("old\n")
    (folder.checkpoints / "frames-000000000001.pt").write_bytes(b"old")
    (tmp_path / "notes.txt").write_text("mine")

    with pytest.raises(UserError, match=r"finished run: add overwrite=true .* or choose another run_dir"):
        run_folder.create(str(tmp_path), CONFIG, overwrite=False)
    assert folder.evaluations.exists()

    run_folder.create(str(tmp_path), {"seed": 5}, overwrite=True)
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["checkpoints", "config.yaml", "notes.txt"]
    assert folder.config.read_text() == "seed: 5\n"


def test_an_unfinished_run_is_refused_too(tmp_path):
    run_folder.create(str(tmp_path), CONFIG, overwrite=False)

    with pytest.raises(UserError, match="an unfinished run"):
        run_folder.create(str(tmp_path), CONFIG, overwrite=False)


def test_a_folder_under_a_regular_file_is_refused_in_one_line(tmp_path):
    (tmp_path / "file").write_text("")

    with pytest.raises(UserError, match=r"^run_dir=.*file/run: Not a directory; choose [^\n]*$"):
        run_folder.create(str(tmp_path / "file" / "run"), CONFIG, overwrite=False)
