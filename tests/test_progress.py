"""Progress where nobody has a terminal, where nobody reads, and beside a compilation."""

import re
import sys

import numba
import pytest

from softgm_bench import compilation, progress
from softgm_bench.progress import Progress, tracked


@pytest.fixture
def clock(monkeypatch):
    """Seconds that pass when the test says so."""
    now = [0.0]
    monkeypatch.setattr(progress, "SECONDS_BETWEEN_LINES", 10.0)  # which conftest.py has made endless
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    return now


def test_lines_come_every_ten_seconds_and_tell_rate_and_time_left(clock, capsys):
    with Progress("drawing", 100, "frames") as bar:
        for _ in range(8):
            clock[0] += 3.0
            bar.advance(note="well")
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "drawing:   4%  4 frames  0.333 frames/s  well  04:48 left",
        "drawing:   8%  8 frames  0.333 frames/s  well  04:36 left",
    ]


def test_quick_work_is_silent_and_a_run_says_when_it_is_whole(clock, capsys):
    assert list(tracked("abc", "drawing", 3, "frames")) == ["a", "b", "c"]
    assert capsys.readouterr().err == ""
    with Progress("", 2, "frames", keep=True) as run:
        clock[0] = 1.0
        run.advance(2)
    assert capsys.readouterr().err == "100%  2 frames  2 frames/s  00:00 left\n"


def test_work_that_may_end_before_says_at_most(clock, capsys):
    bar = Progress("evaluating", 100, "steps", at_most=True)
    clock[0] = 20.0
    bar.advance(50)
    assert capsys.readouterr().err.endswith("at most 00:20 left\n")


def test_what_was_done_before_is_no_part_of_the_rate(clock, capsys):
    bar = Progress("", 100, "frames", done=60)
    clock[0] = 20.0
    bar.advance(20)
    assert "80%  80 frames  1 frames/s  00:20 left" in capsys.readouterr().err


def test_compilation_is_no_part_of_the_rate(clock, capsys, monkeypatch):
    compiled = [0.0]
    monkeypatch.setattr(progress.compilation, "seconds", lambda: compiled[0])
    bar = Progress("", 100, "frames")
    clock[0], compiled[0] = 70.0, 50.0
    bar.advance(40)
    assert "40 frames  2 frames/s  00:30 left" in capsys.readouterr().err


class Terminal:
    """Keeps what is written to it."""

    encoding = "utf-8"

    def __init__(self):
        self.text = ""

    def write(self, text):
        self.text += text

    def flush(self):
        pass

    def isatty(self):
        return True


def test_a_terminal_gets_a_bar_with_a_note(monkeypatch):
    terminal = Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    with Progress("", 4, "frames", keep=True) as bar:
        bar.advance(1, "success 0.25")
        bar.note("evaluating")
    assert re.search(r"25%\|.*1/4 .*success 0.25|25%.*evaluating", terminal.text)
    assert "evaluating" in terminal.text


class Broken(Terminal):
    def write(self, text):
        raise BrokenPipeError


@pytest.mark.parametrize("stream", [None, Broken()])
def test_nobody_who_reads_is_no_reason_to_stop(stream, monkeypatch):
    monkeypatch.setattr(sys, "stderr", stream)
    with Progress("", 3, "frames", keep=True) as bar:
        bar.say("line")
        bar.note("note")
        for _ in range(3):
            bar.advance(note="on")


def test_a_compilation_is_told_once_and_measured(capsys, monkeypatch):
    listener = compilation._Compilations()
    monkeypatch.setattr(compilation, "_LISTENER", listener)
    compilation.event.register("numba:compile", listener)
    try:
        for offset in (1, 2):
            numba.njit(lambda x, offset=offset: x + offset)(1)
    finally:
        compilation.event.unregister("numba:compile", listener)
    assert capsys.readouterr().err == f"softgm_bench: {compilation.LINE}\n"
    assert 0.0 < listener.seconds < 60.0
    before = listener.seconds
    assert compilation.seconds() == before
