"""Settings of the process and the processor: threads, matrix products, memory."""

import ctypes
import platform

import numba
import torch

from softgm_bench import process
from softgm_bench.config import available_threads
from softgm_bench.config.schema import BF16, FLOAT32
from softgm_bench.errors import UserError

M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # glibc's malloc.h


def set_threads(threads: int | None, matmul: str | None = None) -> int:
    """Let torch and Numba use this many threads, or all there are; returns how many.

    Matrix products on the CPU go to oneDNN, twice as fast as MKL on AMD's cores, and stay float32, unless ``matmul`` is
    ``bf16``: then their factors are rounded to bfloat16, and their sums are float32.

    Raises:
        UserError: ``bf16``, and this processor has no instructions for it.
    """
    process.prepare()
    if matmul == BF16:
        process.allow_bf16()
    count = threads or available_threads()
    # Numba first: when it starts its threads, it sets OpenMP's number of them, which is torch's too
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))
    torch.set_num_threads(count)
    products = torch.backends.mkldnn.matmul  # type: ignore[attr-defined]
    products.fp32_precision = "bf16"
    if matmul == BF16:
        if _products_are_float32():
            products.fp32_precision = "ieee"
            raise UserError("matmul=bf16: this processor has no instructions for it; choose float32, or null")
    elif not _products_are_float32():  # a product came before ``process.prepare``, which then had no effect
        products.fp32_precision = "ieee"
    return count


def set_matmul(precision: str | None) -> None:
    """Let matrix products of float32 on a GPU be rounded to ``tf32`` or stay ``float32``; None: tf32."""
    torch.backends.cuda.matmul.fp32_precision = "ieee" if precision == FLOAT32 else "tf32"


def keep_memory() -> None:
    """Let glibc keep freed memory: tensors of a megabyte would otherwise be mapped anew, page by page, at every use."""
    libc = _glibc()
    if libc is not None:
        libc.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)
        libc.mallopt(M_MMAP_THRESHOLD, 2**25)  # the largest that glibc accepts


def give_back_memory() -> None:
    """Return what glibc keeps to the system, in a tenth of a second; call it now and then where tensors' sizes vary.

    Freed pieces of ever other sizes lie between those in use. SoftGM's edges are as many as are sensed: a training that
    used 1 GB held 7 after an hour, and grew.
    """
    libc = _glibc()
    if libc is not None:
        libc.malloc_trim(0)


def _glibc() -> ctypes.CDLL | None:
    """The process's C library, if it is glibc."""
    return ctypes.CDLL(None) if platform.libc_ver()[0] == "glibc" else None


def _products_are_float32() -> bool:
    """Tell whether a product keeps a digit that bfloat16 has no room for."""
    values = torch.full((64, 64), 1.0 + 2.0**-12, dtype=torch.float32)
    return torch.equal(values @ torch.eye(64, dtype=torch.float32), values)
