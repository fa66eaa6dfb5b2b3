"""Printing cannot end anything, whatever has become of who reads it."""

import os
import subprocess
import sys

import pytest

from softgm_bench.output import unbreakable

CODE = """
import os, sys
from softgm_bench.output import unbreakable
with unbreakable():
    for line in range(10_000):
        print("line", line)
        print("line", line, file=sys.stderr)
    open(sys.argv[1], "w").write("the end")
"""
WAYS = {"nobody reads on": "| head -1", "closed": ">&- 2>&-", "a full disk": "> /dev/full 2>&1", "heard": ""}


@pytest.mark.parametrize("way", WAYS.values(), ids=WAYS)
def test_work_goes_on_whatever_becomes_of_what_it_prints(tmp_path, way):
    if way.startswith("> /dev/full") and not os.path.exists("/dev/full"):
        pytest.skip("this system has no full device")
    end = tmp_path / "end"
    command = f'set -o pipefail; "$0" -c "$1" "$2" {way}'
    result = subprocess.run(
        ["bash", "-c", command, sys.executable, CODE, str(end)], capture_output=True, text=True, check=False, timeout=60
    )
    assert result.returncode == 0, result.stderr
    assert end.read_text() == "the end"  # and nothing that was printed
    assert "Traceback" not in result.stderr
    if not way:
        assert result.stdout.splitlines() == [f"line {line}" for line in range(10_000)]


def test_streams_are_themselves_again_and_keep_the_order_of_what_is_printed(capsys):
    before = sys.stdout, sys.stderr
    print("before")
    with unbreakable(), unbreakable():
        print("within", end="")
        print(" it", file=sys.stdout, flush=True)
    print("after")
    assert (sys.stdout, sys.stderr) == before
    assert capsys.readouterr().out == "before\nwithin it\nafter\n"
