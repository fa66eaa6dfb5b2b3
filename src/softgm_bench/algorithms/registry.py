"""The table of algorithms, filled by ``register_algorithm``: which one a configuration means."""

from collections.abc import Callable, Iterator
from typing import Any, Protocol, TypeVar

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn

from softgm_bench.envs.interface import Environment, Sizes
from softgm_bench.upstream import default_dtype


class Algorithm(Protocol):
    """The interface of an algorithm for the loop of a run.

    One that also has ``use_graphs()`` is asked to record its gradient steps as CUDA graphs where the settings say so.
    One that also has ``begin_with(policy, critic_frames)`` can begin with a trained policy's parameters and hold the
    actor still until its critic has learnt from so many frames; ``policy`` is None where a run is resumed.
    One that also has ``update_mixture(batches)`` can learn from arms of several numbers of sections, from a batch of
    each at once; its parameters must not depend on that number.

    Attributes:
        policy: reads ``entries.OBSERVATION`` (and ``entries.PRIVILEGED`` as an oracle), writes ``entries.ACTION``;
            explores under ``ExplorationType.RANDOM`` and is deterministic under ``ExplorationType.DETERMINISTIC``. The
            collector and the evaluation call it.
    """

    policy: TensorDictModuleBase

    @staticmethod
    def build_policy(
        config: Any, model_config: Any, sizes: Sizes, oracle: bool = False, frames: int = 0
    ) -> TensorDictModuleBase:
        """Build ``policy`` alone, with fresh networks; it explores as after ``frames`` frames of training."""

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from ``(num_envs, steps)`` consecutive frames of the current policy; returns metrics to write down.

        The names of the metrics must be the same every time. A run stops as diverged where one that begins with
        ``loss_`` or ends in ``_grad_norm`` is not finite, unless ``gradient_steps`` among them is 0.
        """

    def state_dict(self) -> dict[str, Any]:
        """Give everything that resuming needs: tensors and plain Python values."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from what ``state_dict`` returned."""


AlgorithmClass = TypeVar("AlgorithmClass", bound=type)

_configs: dict[str, type] = {}
_algorithms: dict[str, Callable[..., Algorithm]] = {}


def register_algorithm(*names: str, config: type) -> Callable[[AlgorithmClass], AlgorithmClass]:
    """Class decorator: each of ``names`` means this class with a configuration of type ``config``.

    ``config`` is a dataclass with ``name: str`` and ``centralised: bool``, the schema of ``conf/algo/<name>.yaml`` for
    every one of the names. The class is called with the configuration, the model's configuration, the environment and
    ``oracle: bool``, which says that the actor's head reads ``entries.PRIVILEGED`` too.
    """

    def register(algorithm: AlgorithmClass) -> AlgorithmClass:
        for name in names:
            if name in _configs:
                raise ValueError(f"algorithm {name!r} is registered already")
            _configs[name], _algorithms[name] = config, algorithm
        return algorithm

    return register


def algorithm_configs() -> dict[str, type]:
    """Configuration dataclass of every registered algorithm, by name; several names may share one."""
    return dict(_configs)


def build_algorithm(config: Any, model_config: Any, env: Environment, oracle: bool = False) -> Algorithm:
    """Build the algorithm that ``config.name`` means, with networks for the sizes and the device of ``env``.

    Raises:
        ValueError: if there is no such algorithm, or ``config`` is another one's.
    """
    with default_dtype.float32():
        return _class_of(config)(config, model_config, env, oracle)


def build_policy(
    config: Any, model_config: Any, sizes: Sizes, oracle: bool = False, frames: int = 0
) -> TensorDictModuleBase:
    """Build what acts, and nothing that learns: the policy of the algorithm that ``config.name`` means.

    Args:
        config: the algorithm's.
        model_config: the model's.
        sizes: the environment's.
        oracle: the policy reads ``entries.PRIVILEGED`` too.
        frames: it explores as after so many frames of training, if it is asked to explore.

    Raises:
        ValueError: if there is no such algorithm, or ``config`` is another one's.
    """
    with default_dtype.float32():
        return _class_of(config).build_policy(config, model_config, sizes, oracle, frames)


def learns_mixtures(config: Any) -> bool:
    """Tell whether the algorithm that ``config.name`` means can learn from several numbers of sections at once."""
    return hasattr(_class_of(config), "update_mixture")


def named_parameters(algorithm: Algorithm) -> Iterator[tuple[str, Tensor]]:
    """Give the parameters of every network that an algorithm holds, each once, the policy's first."""
    modules = {"policy": algorithm.policy, **vars(algorithm)}
    seen: set[int] = set()
    for holder, module in modules.items():
        if isinstance(module, nn.Module):
            for name, parameter in module.named_parameters():
                if id(parameter) not in seen:
                    seen.add(id(parameter))
                    yield f"{holder}.{name}", parameter


def _class_of(config: Any) -> Any:
    name: str = config.name
    if _configs.get(name) is not type(config):
        raise ValueError(f"{type(config).__name__} is not the configuration of an algorithm named {name!r}")
    return _algorithms[name]
