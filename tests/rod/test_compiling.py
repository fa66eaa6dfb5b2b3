"""A place for machine code that cannot be written costs a line and time, and nothing else."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from softgm_bench.rod import compiling

CODE = "from softgm_bench.rod import compiling\n@compiling.njit()\ndef f(x):\n    return x + 1\nprint(f(1))\n"


def test_without_a_place_for_a_cache_code_compiles_and_says_what_would_help(monkeypatch, capsys):
    usual = compiling.numba.njit

    def nowhere(*function, **options):
        if options.pop("cache", False):
            raise RuntimeError("cannot cache function 'f': no locator available for file 'f.py'")
        return usual(*function, **options)

    monkeypatch.setattr(compiling.numba, "njit", nowhere)
    monkeypatch.setattr(compiling, "_told", False)
    assert compiling.njit()(lambda x: x + 1)(1) == 2
    assert compiling.njit()(lambda x: x + 2)(1) == 3
    printed = capsys.readouterr().err
    assert printed.count("\n") == 1
    assert "set NUMBA_CACHE_DIR to a folder that can be written" in printed


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "geteuid"), reason="permissions are another system's")
def test_a_package_and_a_home_that_cannot_be_written_are_no_obstacle(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(CODE)
    environment = {**os.environ, "HOME": "/proc/nowhere", "XDG_CACHE_HOME": "/proc/nowhere"}
    environment.pop("NUMBA_CACHE_DIR", None)
    environment["PYTHONPATH"] = os.pathsep.join([str(Path(compiling.__file__).parents[2]), *sys.path[1:]])
    command = [sys.executable, "-c", CODE]  # of no file at all, for which there is no place either
    result = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=300)
    assert (result.returncode, result.stdout) == (0, "2\n"), result.stderr
