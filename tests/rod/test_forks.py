"""Processes that were forked too late say so instead of hanging."""

import multiprocessing
import os

import pytest

from softgm_bench.rod import forks


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_process_that_was_forked_after_the_first_step_is_told_and_one_before_works(monkeypatch):
    def exit_code():
        def child():
            try:
                forks.check()
            except RuntimeError as error:
                os._exit(3 if "spawn or forkserver" in str(error) else 4)
            os._exit(0)

        process = multiprocessing.get_context("fork").Process(target=child)
        process.start()
        process.join(60)
        return process.exitcode

    monkeypatch.setattr(forks, "_threads_of", None)
    assert exit_code() == 0
    forks.note_threads()
    assert exit_code() == 3
    forks.check()  # here all is well
