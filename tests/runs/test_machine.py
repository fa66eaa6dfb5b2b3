"""Memory that glibc keeps, and gives back when it is told to."""

import platform
import resource
from pathlib import Path

import pytest
import torch

from softgm_bench.runs.machine import give_back_memory, keep_memory


def resident() -> int:
    """Bytes of this process that lie in memory."""
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="another C library keeps memory in its own way")
def test_freed_memory_between_what_is_in_use_is_kept_until_it_is_given_back():
    keep_memory()
    pieces = [torch.ones(2**16) for _ in range(800)]  # 0.25 MB each, 200 MB
    full = resident()
    in_use = pieces[::50]
    del pieces
    assert resident() > full - 2**25
    give_back_memory()
    assert resident() < full - 3 * 2**25
    assert all(bool((piece == 1.0).all()) for piece in in_use)
