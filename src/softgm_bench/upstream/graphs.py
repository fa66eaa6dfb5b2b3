"""CUDA graphs: a function of tensors is recorded once and replayed, one launch instead of hundreds.

What a graph replays are kernels on the memory that they were recorded with. So a recorded function must read and write
the same tensors every time: what changes is changed in place, numbers that change are tensors, shapes depend on no
value, and random numbers come from generators that the graph knows. ``Recorded`` sees to the rest: inputs are copied
into tensors of their own, what the attempts before and during recording change is put back, and where recording fails
the function is called as it always was, after one line on stderr.
"""

import contextlib
import gc
import itertools
import sys
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import torch
from tensordict import TensorDictBase
from torch import Tensor

WARM_UPS = 3  # compile kernels, choose algorithms and take workspaces, which must not happen while recording


class CudaGraph:
    """One recording on one device, by ``torch.cuda.CUDAGraph``."""

    def __init__(self, device: torch.device, generators: Iterable[torch.Generator]) -> None:
        """Prepare to record what draws from ``generators``; the device's default one is known anyway."""
        self._device, self._stream = device, torch.cuda.Stream(device)
        self._graph = torch.cuda.CUDAGraph()
        for generator in generators:
            self._graph.register_generator_state(generator)

    def warm_up(self, function: Callable[[], Any]) -> None:
        """Call the function a few times, on another stream as recording does.

        Raises:
            RuntimeError: in the last call something waited for the device, which would spoil a recording.
        """
        current = torch.cuda.current_stream(self._device)
        self._stream.wait_stream(current)
        waiting = torch.cuda.get_sync_debug_mode()
        try:
            with torch.cuda.stream(self._stream):
                for call in range(WARM_UPS):
                    torch.cuda.set_sync_debug_mode("error" if call == WARM_UPS - 1 else waiting)
                    function()
        finally:
            torch.cuda.set_sync_debug_mode(waiting)
            current.wait_stream(self._stream)

    def record(self, function: Callable[[], Any]) -> Any:
        """Record one call, whose kernels do not run; returns its tensors, which every replay writes."""
        torch.cuda.synchronize(self._device)
        gc.collect()
        torch.cuda.empty_cache()
        with torch.cuda.stream(self._stream):
            # other threads, such as a logger's, may go on as they like
            self._graph.capture_begin(capture_error_mode="thread_local")
            try:
                output = function()
            except BaseException:
                with contextlib.suppress(RuntimeError):  # the recording is spoilt; why, the first error says
                    self._graph.capture_end()
                raise
            self._graph.capture_end()
        return output

    def replay(self) -> None:
        """Enqueue all that was recorded on the current stream."""
        self._graph.replay()


class Recorded:
    """A function that is recorded at its first call and replayed at later ones.

    Calls with a batch of another size than the first one's go to the function itself.

    Attributes:
        failed: recording failed; every call goes to the function itself.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        changed: Callable[[], Sequence[Tensor]],
        device: torch.device,
        what: str,
        generators: Sequence[torch.Generator] = (),
    ) -> None:
        """Nothing is called yet.

        Args:
            function: of one tensordict or of nothing; gives a tensor or nothing.
            changed: gives the tensors, other than the result, that a call changes in place: attempts are undone there.
            device: of everything.
            what: names the function on stderr.
            generators: that it draws from, beside the device's default one.
        """
        self._function, self._changed, self._device, self._what = function, changed, device, what
        self._generators = tuple(generators)
        self.failed = False
        self.forget()

    def forget(self) -> None:
        """Record anew at the next call: some tensor has been replaced by another one."""
        self._graph: CudaGraph | None = None
        self._inputs: TensorDictBase | None = None
        self._output: Tensor | None = None

    def __call__(self, inputs: TensorDictBase | None = None) -> Any:
        """What the function gives, in a tensor of its own."""
        if self._graph is None and not self.failed:
            self._record(inputs)
        if self._graph is None or _size(inputs) != _size(self._inputs):
            return self._call(inputs)
        if inputs is not None and self._inputs is not None:
            copy_into(leaves(self._inputs), leaves(inputs))
        self._graph.replay()
        return None if self._output is None else self._output.clone()

    def _call(self, inputs: TensorDictBase | None) -> Any:
        return self._function() if inputs is None else self._function(inputs)

    def _record(self, inputs: TensorDictBase | None) -> None:
        """Try to record; whatever comes of it, nothing has changed."""
        changed = list(self._changed())
        before = [tensor.detach().clone() for tensor in changed]
        generators = [_default_generator(self._device), *self._generators]
        states = [generator.get_state() for generator in generators]
        held = None if inputs is None else inputs.clone()
        try:
            graph = CudaGraph(self._device, self._generators)
            graph.warm_up(lambda: self._call(_shallow(held)))
            output = graph.record(lambda: self._call(_shallow(held)))
        except Exception as error:
            self.failed = True
            reason = next(iter(str(error).splitlines()), "")
            print(f"{self._what} runs without a CUDA graph: {type(error).__name__}: {reason}", file=sys.stderr)
            for generator in generators:
                _detach_from_graphs(generator)
        else:
            self._graph, self._inputs, self._output = graph, held, output
        copy_into(changed, before)
        for generator, state in zip(generators, states, strict=True):
            generator.set_state(state)


def leaves(td: Any) -> list[Tensor]:
    """Give the tensors of a tensordict or tensorclass, nested ones too, in the order of their keys."""
    return [value for _, value in sorted(td.items(True, True), key=lambda item: _path(item[0]))]


@torch.no_grad()
def copy_into(targets: Sequence[Tensor], sources: Sequence[Tensor]) -> None:
    """Copy every source into its target, in a few launches."""
    pairs = [(target, source) for target, source in zip(targets, sources, strict=True) if target is not source]
    for _, group in itertools.groupby(sorted(pairs, key=_kind), key=_kind):
        into, what = zip(*group, strict=True)
        torch._foreach_copy_(into, what)


def prepare_optimizer(optimizer: torch.optim.Optimizer) -> None:
    """Make an optimiser's step recordable: its state exists, and its learning rate is a tensor (``set_lr``).

    A fresh optimiser's state is all zeros, here as where it is made by the first step.
    """
    for group in optimizer.param_groups:
        parameters = group["params"]
        lr = torch.as_tensor(group["lr"], dtype=torch.float32, device=parameters[0].device)
        group.update(capturable=True, lr=lr)
    if optimizer.state:
        return
    parameters = [parameter for group in optimizer.param_groups for parameter in group["params"]]
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    optimizer.step()
    optimizer.zero_grad(set_to_none=True)
    for tensor in optimizer_tensors(optimizer):
        tensor.zero_()


def gradient_step(
    step: Callable[[TensorDictBase], Tensor],
    networks: Callable[[], Sequence[Tensor]],
    optimizers: Sequence[torch.optim.Optimizer],
    what: str,
) -> Recorded:
    """Give a gradient step that is recorded; the optimisers are made ready for that.

    Args:
        step: of a minibatch.
        networks: gives the tensors that a step changes beside the optimisers' own.
        optimizers: whose steps it takes.
        what: names the step on stderr.
    """
    for optimizer in optimizers:
        prepare_optimizer(optimizer)

    def changed() -> list[Tensor]:
        return [*networks(), *(tensor for optimizer in optimizers for tensor in optimizer_tensors(optimizer))]

    return Recorded(step, changed, networks()[0].device, what)


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> list[Tensor]:
    """Give the tensors that an optimiser's step changes, beside the parameters."""
    values = (value for state in optimizer.state.values() for value in state.values())
    return [value for value in values if isinstance(value, Tensor)]


def set_lr(optimizer: torch.optim.Optimizer, lr: float) -> None:
    """Set the learning rate, in place where it is a tensor that a graph may read."""
    for group in optimizer.param_groups:
        if isinstance(group["lr"], Tensor):
            group["lr"].fill_(lr)
        else:
            group["lr"] = lr


def portable_state(optimizer: torch.optim.Optimizer, lr: float) -> dict[str, Any]:
    """Give an optimiser's state with the learning rate as a number, whether its steps are recorded or not."""
    state = optimizer.state_dict()
    for group in state["param_groups"]:
        group.update(capturable=False, lr=lr)
    return state


def _size(inputs: TensorDictBase | None) -> torch.Size | None:
    return None if inputs is None else inputs.batch_size


def _shallow(inputs: TensorDictBase | None) -> TensorDictBase | None:
    """The same tensors in a tensordict that the function may add entries to, as losses do."""
    return None if inputs is None else inputs.copy()


def _path(key: Any) -> tuple[str, ...]:
    return (key,) if isinstance(key, str) else key


def _kind(pair: tuple[Tensor, Tensor]) -> tuple[str, str]:
    return str(pair[0].dtype), str(pair[1].dtype)


def _default_generator(device: torch.device) -> torch.Generator:
    if device.type != "cuda":
        return torch.default_generator
    index = torch.cuda.current_device() if device.index is None else device.index
    return torch.cuda.default_generators[index]


def _detach_from_graphs(generator: torch.Generator) -> None:
    """Give a generator another state: a recording that was broken off may have left it waiting for the end."""
    if generator.device.type == "cuda":
        generator.graphsafe_set_state(torch.Generator(generator.device))
