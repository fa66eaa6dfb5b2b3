import os
import signal

import pytest

from softgm_bench.runs.interruption import STOPPING, Interrupted, Interruption


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), *((number, 128 + number) for number in STOPPING)])
def test_a_signal_waits_for_the_next_check(number, code):
    with Interruption() as interruption:
        interruption.check()
        os.kill(os.getpid(), number)
        with pytest.raises(Interrupted) as caught:
            interruption.check()
    assert caught.value.exit_code == code


def test_a_second_signal_stops_at_once():
    with Interruption():
        os.kill(os.getpid(), signal.SIGINT)
        with pytest.raises(KeyboardInterrupt, match="at once"):
            os.kill(os.getpid(), signal.SIGINT)


def test_work_that_may_be_broken_off_is():
    with Interruption() as interruption:
        with pytest.raises(Interrupted), interruption.at_once():
            os.kill(os.getpid(), signal.SIGTERM)
        os.kill(os.getpid(), signal.SIGTERM)  # outside, it waits again


def test_afterwards_signals_do_what_they_did_before():
    before = signal.getsignal(signal.SIGINT)
    with Interruption():
        assert signal.getsignal(signal.SIGINT) != before
    assert signal.getsignal(signal.SIGINT) == before


@pytest.mark.parametrize("number", STOPPING)
def test_what_the_parent_has_set_to_be_ignored_stays_ignored(number):
    """As ``nohup`` does with SIGHUP."""
    before = signal.signal(number, signal.SIG_IGN)
    try:
        with Interruption() as interruption:
            os.kill(os.getpid(), number)
            interruption.check()
    finally:
        signal.signal(number, before)


def test_a_stop_that_nobody_is_told_of_is_a_stop():
    read, write = os.pipe()
    os.close(read)
    with open(write, "w") as gone, pytest.MonkeyPatch.context() as patch, Interruption() as interruption:
        patch.setattr("sys.stderr", gone)
        os.kill(os.getpid(), signal.SIGTERM)
        with pytest.raises(Interrupted):
            interruption.check()
