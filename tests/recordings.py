"""A stand-in for CUDA graphs on the CPU: it repeats the call, into the tensors that recording gave."""

from contextlib import contextmanager
from unittest import mock

from softgm_bench.upstream import graphs


class Repetition:
    """Has ``CudaGraph``'s methods; ``log`` says which were called, over all instances of a test's ``recordings``."""

    log: list[str]

    def __init__(self, device, generators):
        self.generators = list(generators)

    def warm_up(self, function):
        for _ in range(graphs.WARM_UPS):
            self.log.append("warm-up")
            function()

    def record(self, function):
        self.log.append("record")
        self._function, self._output = function, function()
        return self._output

    def replay(self):
        self.log.append("replay")
        output = self._function()
        if output is not None:
            self._output.copy_(output)


class Broken(Repetition):
    """Recording fails after all that it can have changed has changed."""

    def record(self, function):
        super().record(function)
        raise RuntimeError("operation not permitted when stream is capturing\nsecond line")


@contextmanager
def recordings(kind=Repetition):
    """Let ``Recorded`` record by ``kind``; gives the log."""
    kind.log = []
    with mock.patch.object(graphs, "CudaGraph", kind):
        yield kind.log
