"""Which encoder a configuration means: one table, filled by ``register_model``."""

from collections.abc import Callable
from typing import Any, TypeVar

from tensordict import TensorDictBase
from torch import Tensor, nn


class Encoder(nn.Module):
    """What the heads and the algorithms know of an encoder: one embedding per agent.

    Attributes:
        out_features: length of an embedding.
        velocity_scale: factor that the encoder applies to the agents' velocities; heads that read them do the same.
    """

    def __init__(self, out_features: int, velocity_scale: float) -> None:
        """Remember what the heads ask for."""
        super().__init__()
        self.out_features = out_features
        self.velocity_scale = velocity_scale

    def forward(self, td: TensorDictBase) -> Tensor:
        """Embeddings ``(..., N, out_features)`` from the entries ``keys.OBSERVATION``."""
        raise NotImplementedError


EncoderClass = TypeVar("EncoderClass", bound=type[Encoder])

_configs: dict[str, type] = {}
_encoders: dict[type, Callable[..., Encoder]] = {}


def register_model(name: str, config: type) -> Callable[[EncoderClass], EncoderClass]:
    """Class decorator: ``config`` (a dataclass, the schema of ``conf/model/<name>.yaml``) means this encoder.

    The class is called with the configuration, N and M.
    """

    def register(encoder: EncoderClass) -> EncoderClass:
        if name in _configs or config in _encoders:
            raise ValueError(f"model {name!r} or its configuration {config.__name__} is registered already")
        _configs[name], _encoders[config] = config, encoder
        return encoder

    return register


def model_configs() -> dict[str, type]:
    """Configuration dataclass of every registered model, by name."""
    return dict(_configs)


def build_encoder(config: Any, n_agents: int, n_slots: int) -> Encoder:
    """The encoder that ``config`` means, for N agents and M slots.

    Raises:
        ValueError: if ``config`` is no registered model's.
    """
    if type(config) not in _encoders:
        raise ValueError(f"{type(config).__name__} is no model's configuration; models: {sorted(_configs)}")
    return _encoders[type(config)](config, n_agents, n_slots)
