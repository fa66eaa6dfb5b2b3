"""The table of models by configuration, filled by ``register_model``."""

from collections.abc import Callable
from typing import Any, ClassVar, TypeVar, get_type_hints

import torch
from tensordict import NestedKey, TensorDictBase
from torch import Tensor, nn

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import graph


class Encoder(nn.Module):
    """The interface of an encoder for heads and algorithms: one embedding per agent.

    What is said here of the observation is the arm's; an encoder of another one says otherwise.

    Attributes:
        in_keys: the observation, which heads and encoder read.
        own_features: length of o_i, what heads put beside agent i's embedding g_i.
        out_features: length of an embedding.
        velocity_scale: factor that the encoder applies to the agents' velocities; heads that read them do the same.
    """

    in_keys: ClassVar[tuple[NestedKey, ...]] = entries.OBSERVATION
    own_features: ClassVar[int] = graph.CHANNELS

    def __init__(self, out_features: int, velocity_scale: float) -> None:
        """Remember what the heads ask for."""
        super().__init__()
        self.out_features = out_features
        self.velocity_scale = velocity_scale

    def own(self, td: TensorDictBase) -> Tensor:
        """o_i, the agents' own nodes, ``(..., N, own_features)``."""
        return graph.agent_channels(td, self.velocity_scale)

    def forward(self, td: TensorDictBase) -> Tensor:
        """Embeddings ``(..., N, out_features)`` from the entries ``in_keys``."""
        raise NotImplementedError


class TeamEncoder(nn.Module):
    """The interface of an encoder for centralised critics: one embedding of the whole team and of further inputs.

    Attributes:
        in_keys: the observation.
        out_features: length of the embedding.
    """

    def __init__(self, out_features: int, in_keys: tuple[NestedKey, ...] = entries.OBSERVATION) -> None:
        """Remember what the heads ask for."""
        super().__init__()
        self.out_features, self.in_keys = out_features, in_keys

    def forward(self, td: TensorDictBase, further: Tensor) -> Tensor:
        """Embeddings ``(..., out_features)`` of the entries ``in_keys`` and inputs ``(..., n_further)``."""
        raise NotImplementedError


class Normalised(Encoder):
    """Another encoder's embeddings in a scale of one: layer normalisation over the channels of each g_i.

    A head begins with a tanh. Nothing bounds what residual layers add up to: embeddings of a root mean square of 4 to 7
    drive three of four units of the head to where their gradient is nothing, and drown o_i, which stands beside them.
    Not the root mean square alone: on a CPU torch's RMS norm takes four to six times as long, and the mean that this
    one takes off too is one of a hundred directions. The head has a bias already, hence none here.
    """

    def __init__(self, encoder: Encoder) -> None:
        """Put the normalisation, with a gain per channel that is learnt, behind an encoder."""
        super().__init__(encoder.out_features, encoder.velocity_scale)
        self.in_keys, self.own_features = encoder.in_keys, encoder.own_features  # type: ignore[misc]
        self.encoder, self.norm = encoder, nn.LayerNorm(encoder.out_features, bias=False)

    def own(self, td: TensorDictBase) -> Tensor:
        """The encoder's own."""
        return self.encoder.own(td)

    def forward(self, td: TensorDictBase) -> Tensor:
        """Embeddings ``(..., N, out_features)`` with mean 0 and variance 1, times the gain."""
        return self.norm(self.encoder(td))


class NormalisedTeam(TeamEncoder):
    """``Normalised`` for a model's own form for centralised critics."""

    def __init__(self, encoder: TeamEncoder) -> None:
        """Put the normalisation behind an encoder."""
        super().__init__(encoder.out_features, encoder.in_keys)
        self.encoder, self.norm = encoder, nn.LayerNorm(encoder.out_features, bias=False)

    def forward(self, td: TensorDictBase, further: Tensor) -> Tensor:
        """Embeddings ``(..., out_features)`` with mean 0 and variance 1, times the gain."""
        return self.norm(self.encoder(td, further))


class SideBySide(TeamEncoder):
    """[o_1 || g_1 || .. || o_N || g_N || further], for models without a form of their own."""

    def __init__(self, encoder: Encoder, n_agents: int, n_further: int) -> None:
        """Put N agents' own nodes and embeddings side by side."""
        of_agent = encoder.own_features + encoder.out_features
        super().__init__(n_agents * of_agent + n_further, encoder.in_keys)
        self.encoder = encoder

    def forward(self, td: TensorDictBase, further: Tensor) -> Tensor:
        """``(..., out_features)``."""
        of_agents = torch.cat([self.encoder.own(td), self.encoder(td)], dim=-1)
        return torch.cat([of_agents.flatten(-2), further], dim=-1)


EncoderClass = TypeVar("EncoderClass", bound=type[Encoder])

_configs: dict[str, type] = {}
_encoders: dict[type, Callable[..., Encoder]] = {}
_team_encoders: dict[type, Callable[..., TeamEncoder]] = {}


def register_model(
    *names: str, config: type, team: Callable[..., TeamEncoder] | None = None
) -> Callable[[EncoderClass], EncoderClass]:
    """Class decorator: each of ``names`` means this encoder with a configuration of type ``config``.

    ``config`` is a dataclass, the schema of ``conf/model/<name>.yaml`` for every one of the names; where several share
    it, it has a field ``name: str``. The class is called with the configuration and the environment's ``Sizes``.
    ``team``, called with the number of further inputs besides, is the model's own form for centralised critics; without
    one they put the agents' embeddings side by side.

    Raises:
        ValueError: a name or the configuration is another model's, or it does not say which of several names it has.
    """

    def register(encoder: EncoderClass) -> EncoderClass:
        for name in names:
            if name in _configs or config in _encoders:
                raise ValueError(f"model {name!r} or its configuration {config.__name__} is registered already")
        if len(names) > 1 and get_type_hints(config).get("name") is not str:
            raise ValueError(f"{config.__name__} is shared by {', '.join(names)}: it needs a field name: str")
        _configs.update(dict.fromkeys(names, config))
        _encoders[config] = encoder
        if team is not None:
            _team_encoders[config] = team
        return encoder

    return register


def model_configs() -> dict[str, type]:
    """Configuration dataclass of every registered model, by name; several names may share one."""
    return dict(_configs)


def build_encoder(config: Any, sizes: Sizes, norm: bool = False) -> Encoder:
    """Build the encoder that ``config`` means, for an environment's sizes; ``norm``: with normalised embeddings.

    Raises:
        ValueError: if ``config`` is no registered model's.
    """
    if type(config) not in _encoders:
        raise ValueError(f"{type(config).__name__} is no model's configuration; models: {sorted(_configs)}")
    encoder = _encoders[type(config)](config, sizes)
    return Normalised(encoder) if norm else encoder


def build_team_encoder(config: Any, sizes: Sizes, n_further: int, norm: bool = False) -> TeamEncoder:
    """Build what the model of ``config`` offers to centralised critics; ``n_further`` inputs beside observations.

    ``norm``: with normalised embeddings, of each agent where the model puts agents side by side.

    Raises:
        ValueError: if ``config`` is no registered model's.
    """
    if type(config) in _team_encoders:
        encoder = _team_encoders[type(config)](config, sizes, n_further)
        return NormalisedTeam(encoder) if norm else encoder
    return SideBySide(build_encoder(config, sizes, norm), sizes.n_agents, n_further)
