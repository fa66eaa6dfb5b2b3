"""The built wheel, installed away from the repository, is complete."""

import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import pytest

pytest.importorskip("hatchling", reason="builds a wheel without fetching anything")
ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of a new virtual environment that holds the wheel and sees this one's other packages."""
    folder = tmp_path_factory.mktemp("installed")
    wheel = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--no-build-isolation", "-w", "wheels", ROOT]
    subprocess.run(wheel, check=True, cwd=folder, timeout=120)
    (built,) = (folder / "wheels").glob("softgm_bench-*.whl")
    venv.create(folder / "venv", with_pip=False)
    python = folder / "venv" / "bin" / "python"
    target = _run(python, folder, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))").strip()
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--target", target, built]
    subprocess.run(install, check=True, cwd=folder, timeout=120)
    # a line of a .pth file shows the other packages; .pth files below it, such as this checkout's, are not read
    (Path(target) / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")
    return python


@pytest.mark.slow
def test_it_trains_evaluates_and_draws_away_from_the_repository(installed: Path, tmp_path: Path):
    where = _run(installed, tmp_path, "-c", "import softgm_bench; print(softgm_bench.__file__)")
    assert Path(where.strip()).is_relative_to(installed.parents[1])
    smallest = ["experiment=smoke", "experiment.total_frames=64", "experiment.num_envs=2", "run_dir=run", "threads=1"]
    _run(installed, tmp_path, "-m", "softgm_bench", "algo=ippo", "task=basic", *smallest)
    assert (tmp_path / "run" / "summary.json").exists()
    evaluated = _run(installed, tmp_path, "-m", "softgm_bench.evaluate", "run", "episodes=2", "horizon=3", "threads=1")
    assert "success rate" in evaluated
    _run(installed, tmp_path, "-m", "softgm_bench.render", "run", "out=arm.html", "horizon=3", "threads=1")
    assert "<html" in (tmp_path / "arm.html").read_text()
    _run(installed, tmp_path, "-m", "softgm_bench.report", ".", "out=report", "resamples=100")
    assert (tmp_path / "report" / "report.html").exists()


def _run(python: Path, folder: Path, *arguments: str) -> str:
    """Standard output of a command that must succeed, without this process's way to find packages."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(
        [python, *arguments], cwd=folder, env=environment, capture_output=True, text=True, timeout=300, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
