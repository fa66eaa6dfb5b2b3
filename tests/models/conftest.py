"""One thread: these tensors are so small that a second thread would only be waited for."""

import numba
import pytest
import torch


@pytest.fixture(autouse=True, scope="package")
def one_thread():
    threads, of_loops = torch.get_num_threads(), numba.get_num_threads()
    torch.set_num_threads(1)
    numba.set_num_threads(1)
    yield
    torch.set_num_threads(threads)
    numba.set_num_threads(of_loops)
