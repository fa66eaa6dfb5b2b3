"""How many operations a training on a GPU has to launch: in a step of the environment, a policy call, a gradient step.

``NUMBA_ENABLE_CUDASIM=1 python benchmarks/count_operations.py`` prints a table and writes the raw figures. Every launch
costs the processor that issues it about 9 microseconds, whatever the batch, so this count bounds the rate of small and
middle-sized batches. No GPU is needed: the CPU is sent down the way of devices whose values nobody may read
(``softgm_bench.rod.sync``), and Numba's simulator runs the CUDA kernels.

Counted is what torch dispatches, as one each, and the launches of our own kernels. Views and allocations, which launch
nothing, are counted apart, and so are the arrays that our kernels are given: Numba wraps each at every launch. A few
operations launch more than one kernel (``sort``, ``cumsum``), and on a GPU the clipping of gradients works on all
parameters at once where it is counted here for each: this is no profile.
"""

import argparse
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from record import write
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode, _disable_current_modes
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench.assembly import build_algorithm, build_env
from softgm_bench.config import Config, compose
from softgm_bench.envs import SoftArmEnv, cuda_sensing, cuda_verdict, simulation
from softgm_bench.models import gat
from softgm_bench.rod import cuda_backend, cuda_checks, sync
from softgm_bench.rod.cuda_kernel import SIMULATED

TASKS = ("basic", "wall")
SETTINGS = ("algo=softgm", "recipe=tuned", "backend=cuda", "dtype=float32", "rod.substeps=1", "threads=1")
NUM_ENVS = 4
ALLOCATIONS = ("empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided", "_unsafe_view")
KERNELS = (cuda_backend, cuda_checks, cuda_sensing, cuda_verdict)  # modules that launch kernels of ours
REST = "the rest"


class Operations(TorchDispatchMode):
    """Counts operations by the innermost part that is under way."""

    def __init__(self) -> None:
        super().__init__()
        self.launched: Counter[str] = Counter()
        self.views: Counter[str] = Counter()
        self.arrays: Counter[str] = Counter()
        self._parts = [REST]

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        free = _is_view(func) or func.overloadpacket.__name__ in ALLOCATIONS
        (self.views if free else self.launched)[self._parts[-1]] += 1
        return func(*args, **(kwargs or {}))

    @contextmanager
    def watch(self, owner: Any, name: str, part: str) -> Iterator[None]:
        """Count what a function does, but for watched ones that it calls, under ``part``."""
        function: Callable[..., Any] = getattr(owner, name)

        def watched(*args: Any, **kwargs: Any) -> Any:
            self._parts.append(part)
            try:
                return function(*args, **kwargs)
            finally:
                self._parts.pop()

        with mock.patch.object(owner, name, watched):
            yield

    @contextmanager
    def kernels(self) -> Iterator[None]:
        """Count launches of our own kernels as one each, and nothing of what the simulator does in their place."""

        def counted(function: Callable[..., None]) -> Callable[..., None]:
            def launch(kernel: Any, blocks: int, threads: int, tensors: Sequence[Tensor], *scalars: Any) -> None:
                self.launched[self._parts[-1]] += 1
                self.arrays[self._parts[-1]] += len(tensors)
                with _disable_current_modes():
                    function(kernel, blocks, threads, tensors, *scalars)

            return launch

        with ExitStack() as stack:
            for module in KERNELS:
                stack.enter_context(mock.patch.object(module, "launch", counted(module.launch)))
            yield


def _is_view(func: Any) -> bool:
    if func.is_view:
        return True
    reads = [argument.alias_info for argument in func._schema.arguments if argument.alias_info is not None]
    return bool(reads) and not any(alias.is_write for alias in reads)


@contextmanager
def as_on_a_gpu() -> Iterator[None]:
    with ExitStack() as stack:
        stack.enter_context(mock.patch.object(sync, "is_free", return_value=False))
        stack.enter_context(mock.patch.object(gat.GraphAttention, "_compiles", return_value=False))
        yield


def count(config: Config) -> list[dict[str, Any]]:
    """Rows of one task: what is done, its part, operations and views."""
    env = build_env(config, NUM_ENVS, seed=0, training=True)
    algorithm = build_algorithm(config, env)
    rows = []
    with as_on_a_gpu(), torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        td = algorithm.policy(env.reset())
        _, td = env.step_and_maybe_reset(td)  # constants are copied once
        rows += _rows("policy call", _counted(lambda: algorithm.policy(td)))
        rows += _rows("environment step", _counted(lambda: env.step_and_maybe_reset(td), _parts_of(env)))
        frames = env.rollout(4, algorithm.policy)
    with as_on_a_gpu():
        minibatch = algorithm.prepare(frames)
        algorithm._step(minibatch)  # the optimisers make their state
        parts = [(algorithm.loss, "forward", "loss"), (torch.Tensor, "backward", "backward")]
        parts += [(torch.nn.utils, "clip_grad_norm_", "clipping")]
        parts += [(optimizer, "step", "optimisers") for optimizer in _optimizers(algorithm)]
        rows += _rows("gradient step", _counted(lambda: algorithm._step(minibatch), parts))
    return rows


def _parts_of(env: SoftArmEnv) -> list[tuple[Any, str, str]]:
    simulator = env.simulator
    return [
        (env, "step_and_maybe_reset", "framework"),
        (env, "_step", "step"),
        (env, "maybe_reset", "reset"),
        (env, "_frame", "frame"),
        (simulation, "judge", "verdict"),
        (simulator, "sense", "sensing"),
        (simulator, "contacts", "contacts"),
        (simulator._actuation, "couple", "actuation"),
        (simulator.backend, "control_step", "rod"),
        (simulator.task, "sample", "scenes"),
        (simulation, "cut_into_bins", "bins"),
        (simulation, "diverged", "divergence"),
    ]


def _optimizers(algorithm: Any) -> list[torch.optim.Optimizer]:
    return [algorithm.actor_optimizer, algorithm.critic_optimizer]


def _counted(work: Callable[[], Any], parts: list[tuple[Any, str, str]] | None = None) -> Operations:
    operations = Operations()
    with ExitStack() as stack:
        for owner, name, part in parts or []:
            stack.enter_context(operations.watch(owner, name, part))
        stack.enter_context(operations.kernels())
        stack.enter_context(operations)
        work()
    return operations


def _rows(what: str, counted: Operations) -> list[dict[str, Any]]:
    columns = {"operations": counted.launched, "views": counted.views, "kernel_arrays": counted.arrays}
    parts = sorted(counted.launched | counted.views, key=lambda part: -counted.launched[part])
    rows = [{"part": part} | {name: column[part] for name, column in columns.items()} for part in parts]
    rows.insert(0, {"part": "all"} | {name: column.total() for name, column in columns.items()})
    return [{"what": what, **row} for row in rows]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/operations.json"))
    options = parser.parse_args()
    if not SIMULATED:
        raise SystemExit("count_operations: set NUMBA_ENABLE_CUDASIM=1, so that CUDA kernels run without a GPU")
    torch.manual_seed(0)
    rows = []
    print(f"{'task':<8}{'':<18}{'part':<14}{'operations':>11}{'views':>8}{'arrays':>8}")
    for task in TASKS:
        for row in count(compose([f"task={task}", *SETTINGS])):
            counts = f"{row['operations']:>11}{row['views']:>8}{row['kernel_arrays']:>8}"
            print(f"{task:<8}{row['what']:<18}{row['part']:<14}{counts}")
            rows.append({"task": task, **row})
    write(options.output, {"settings": list(SETTINGS), "rows": rows})


if __name__ == "__main__":
    main()
