"""Rates as the best of several repetitions, so that other load on the machine spoils little; where the time goes."""

import time
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import torch

from softgm_bench.rod.backend import make_backend
from softgm_bench.rod.parameters import RodParameters
from softgm_bench.rod.state import Cylinders, straight_rods


def best_rate(
    work: Callable[[], object],
    count: float,
    seconds: float,
    repetitions: int = 5,
    clock: Callable[[], float] = time.perf_counter,
) -> float:
    """``count`` over the shortest time of ``work``, repeated at least ``repetitions`` times and ``seconds`` long.

    With ``time.process_time`` as ``clock`` the time is that of the processor, where others keep it busy too.
    """
    shortest, begin, done = float("inf"), time.perf_counter(), 0
    while done < repetitions or time.perf_counter() - begin < seconds:
        start = clock()
        work()
        shortest, done = min(shortest, clock() - start), done + 1
    return count / shortest


def sideways(parameters: RodParameters, num_envs: int, dtype: torch.dtype, peak: float = 4.0) -> torch.Tensor:
    """A constant couple about d2 that leans the arm towards y, N m: ``(num_envs, 3, n_elements)``."""
    couple = torch.zeros(num_envs, 3, parameters.n_elements, dtype=dtype)
    couple[:, 1] = peak * parameters.base_length / parameters.n_elements
    return couple


def kernel_rate(
    parameters: RodParameters,
    dtype: torch.dtype,
    num_envs: int,
    cylinders: Cylinders | None = None,
    couple: torch.Tensor | None = None,
    backend: str = "numba",
    seconds: float = 1.0,
    warm_up: int = 10,
    repetitions: int = 5,
) -> float:
    """Substeps per second over all rods, in whole control steps after ``warm_up`` of them."""
    rod = make_backend(backend, parameters)
    couple = sideways(parameters, num_envs, dtype) if couple is None else couple
    state = straight_rods(parameters, num_envs, dtype)
    for _ in range(warm_up):
        state = rod.control_step(state, couple, cylinders=cylinders)

    def work() -> None:
        nonlocal state
        state = rod.control_step(state, couple, cylinders=cylinders)

    return best_rate(work, num_envs * parameters.substeps, seconds, repetitions)


class Stopwatch:
    """Seconds by part; time inside a nested part counts for that one alone."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self._stack: list[str] = []
        self._since = 0.0

    def watch(self, owner: Any, name: str, part: str) -> None:
        """Time every call of the method ``name`` of one object."""
        method: Callable[..., Any] = getattr(owner, name)

        def timed(*args: Any, **kwargs: Any) -> Any:
            self._switch()
            self._stack.append(part)
            try:
                return method(*args, **kwargs)
            finally:
                self._switch()
                self._stack.pop()

        setattr(owner, name, timed)

    def _switch(self) -> None:
        now = time.perf_counter()
        if self._stack:
            self.seconds[self._stack[-1]] += now - self._since
        self._since = now
