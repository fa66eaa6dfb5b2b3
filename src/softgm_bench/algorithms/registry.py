"""Which algorithm a configuration means: one table, filled by ``register_algorithm``."""

from collections.abc import Callable
from typing import Any, Protocol, TypeVar

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from softgm_bench.envs import SoftArmEnv


class Algorithm(Protocol):
    """What the experiment's loop knows of an algorithm.

    Attributes:
        policy: reads ``keys.OBSERVATION`` (and ``keys.PRIVILEGED`` as an oracle), writes ``keys.ACTION``; explores
            under ``ExplorationType.RANDOM`` and is deterministic under ``ExplorationType.DETERMINISTIC``. The collector
            and the evaluation call it.
    """

    policy: TensorDictModuleBase

    def update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from ``(num_envs, steps)`` consecutive frames of the current policy; returns metrics to write down.

        The names of the metrics must be the same every time.
        """

    def state_dict(self) -> dict[str, Any]:
        """Everything that going on needs: tensors and plain Python values."""

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Go on from what ``state_dict`` returned."""


AlgorithmClass = TypeVar("AlgorithmClass", bound=type)

_configs: dict[str, type] = {}
_algorithms: dict[str, Callable[..., Algorithm]] = {}


def register_algorithm(*names: str, config: type) -> Callable[[AlgorithmClass], AlgorithmClass]:
    """Class decorator: each of ``names`` means this class with a configuration of type ``config``.

    ``config`` is a dataclass with ``name: str`` and ``centralised: bool``, the schema of ``conf/algo/<name>.yaml`` for
    every one of the names. The class is called with the configuration, the model's configuration, the environment and
    ``oracle: bool``, which says that the actor's head reads ``keys.PRIVILEGED`` too.
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


def build_algorithm(config: Any, model_config: Any, env: SoftArmEnv, oracle: bool = False) -> Algorithm:
    """The algorithm that ``config.name`` means, with networks for the sizes and the device of ``env``.

    Raises:
        ValueError: if there is no such algorithm, or ``config`` is another one's.
    """
    name: str = config.name
    if _configs.get(name) is not type(config):
        raise ValueError(f"{type(config).__name__} is not the configuration of an algorithm named {name!r}")
    return _algorithms[name](config, model_config, env, oracle)
