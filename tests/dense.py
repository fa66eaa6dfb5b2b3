"""Sending the CPU down the way of devices whose values nobody may read, to test that the two ways agree."""

from contextlib import contextmanager
from unittest import mock

from softgm_bench.rod import sync


@contextmanager
def force_dense():
    with mock.patch.object(sync, "is_free", return_value=False):
        yield
