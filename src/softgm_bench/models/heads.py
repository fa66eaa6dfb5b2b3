"""TorchRL actors and critics from embeddings, with the same heads for every encoder.

Each network reads the observation from the tensordict itself: an encoder and its head cost one module call. A head
that is built with ``n_privileged`` above 0 reads that many channels of ``entries.PRIVILEGED`` too: an asymmetric
critic's or an oracle's. No encoder ever does.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    InteractionType,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModuleBase,
)
from torch import Tensor, nn

from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import graph
from softgm_bench.models.activation import Tanh
from softgm_bench.models.memory import Memory, MemoryConfig
from softgm_bench.models.mirror import WAYS, MirroredHead, check_mirror
from softgm_bench.models.mlp import MLPConfig
from softgm_bench.models.registry import Encoder, TeamEncoder, build_encoder, build_team_encoder
from softgm_bench.upstream.squashed_normal import SquashedNormal

LOC = ("agents", "loc")  # (B, N, 2), before the bound
SCALE = ("agents", "scale")  # (B, N, 2)
STATE_VALUE = "state_value"  # (B, 1) of a centralised critic, (B, N, 1) of an independent one
POOLINGS = ("mean", "concat")
SATURATED = 3.0  # |x| beyond which tanh has 1 % of its slope left
SATURATION_FRAMES = 256  # of a batch, of which an actor's saturation is told


@dataclass
class ActorConfig:
    """The policy's head f_pi. Values: ``conf/algo``.

    Attributes:
        widths: hidden layers, each followed by tanh.
        initial_sigma: standard deviation of the pre-tanh Gaussian at the start, between the bounds.
        min_sigma: lower bound of the standard deviation.
        max_sigma: upper bound of the standard deviation.
        state_dependent_sigma: sigma is an output of the network instead of the paper's free parameter.
        mean_bound: bound b of the pre-tanh mean, applied as b tanh(mu / b).
        persistence: share p of the previous action in the pre-tanh mean, ``p atanh(a_{t-1}) + (1 - p) mu`` (paper: 0).
            Above 0, exploration is correlated in time: it moves a slow arm where independent noise only shakes it.
        embedding_norm: g_i is normalised before it enters the head (paper: no); see ``models.registry.Normalised``.
        hidden_norm: what enters each tanh of the head is normalised (paper: no); see ``feedforward``.
        relative_points: an oracle's actor is told the privileged points relative to each agent too.
        memory: each agent remembers, by a recurrent cell before the head; None: it does not (paper).
        mirror: the way in which the mean commutes with the mirror in the plane y = 0, ``average`` or ``canonical`` (see
            ``models.mirror``); None: it does not (paper).
    """

    widths: list[int]
    initial_sigma: float
    min_sigma: float
    max_sigma: float
    state_dependent_sigma: bool
    mean_bound: float
    persistence: float
    embedding_norm: bool
    hidden_norm: bool
    relative_points: bool
    memory: MemoryConfig | None
    mirror: str | None

    def __post_init__(self) -> None:
        """Refuse values that give no policy.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        if not 0.0 < self.min_sigma < self.initial_sigma < self.max_sigma:
            raise ValueError(
                f"algo.actor.initial_sigma is {self.initial_sigma}: it must lie between min_sigma {self.min_sigma} and "
                f"max_sigma {self.max_sigma}, and all must be above 0"
            )
        if not self.mean_bound > 0.0:
            raise ValueError(f"algo.actor.mean_bound is {self.mean_bound}: it must be above 0")
        if not 0.0 <= self.persistence < 1.0:
            raise ValueError(f"algo.actor.persistence is {self.persistence}: it must be at least 0 and below 1")
        check_mirror(self.mirror)


@dataclass
class ValueConfig:
    """The critic's head f_V. Values: ``conf/algo``.

    Attributes:
        widths: hidden layers, each followed by tanh.
        pooling: what a centralised critic makes of N agents. ``mean``: the mean of their embeddings g_i, the paper's;
            ``concat``: all agents side by side, MAPPO's, in the form that the model gives it. An independent critic
            pools nothing.
        mlp: the critic's encoder is this MLP, whatever the actor's; None: the same model as the actor's.
        asymmetric: the head reads ``entries.PRIVILEGED`` too. Only training has a critic; execution does not need it.
        embedding_norm: as the actor's, of the critic's own encoder.
        hidden_norm: as the actor's.
    """

    widths: list[int]
    pooling: str
    mlp: MLPConfig | None
    asymmetric: bool
    embedding_norm: bool
    hidden_norm: bool

    def __post_init__(self) -> None:
        """Refuse values that give no critic.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        if self.pooling not in POOLINGS:
            raise ValueError(f"algo.critic.pooling is {self.pooling}: choose one of {', '.join(POOLINGS)}")


def input_keys(encoder: Encoder | TeamEncoder, n_privileged: int) -> list[NestedKey]:
    """List the entries that a network on this encoder with ``n_privileged`` privileged channels reads."""
    return [*encoder.in_keys, entries.PRIVILEGED] if n_privileged else list(encoder.in_keys)


def privileged(td: TensorDictBase, n_privileged: int, like: Tensor) -> Tensor:
    """Give the channels ``(..., n_privileged)`` of ``entries.PRIVILEGED``, which need not exist where that is 0.

    ``like``: ``(..., n, m)``, whose leading dimensions and device nothing then has.
    """
    return td.get(entries.PRIVILEGED) if n_privileged else like[..., 0, :0]


def feedforward(
    in_features: int, widths: Sequence[int], out_features: int, last_gain: float, norm: bool = False
) -> nn.Sequential:
    """Linear layers with tanh between them, orthogonal weights (gain sqrt 2, the last ``last_gain``), zero biases.

    With ``norm`` a layer normalisation stands before every tanh: however far the weights grow, its input has mean 0 and
    variance 1 over the layer's units, times a gain that is learnt, so that few of them can leave the range where the
    tanh has a slope.
    """
    sizes = [in_features, *widths, out_features]
    layers: list[nn.Module] = []
    for index, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
        linear = nn.Linear(fan_in, fan_out)
        nn.init.orthogonal_(linear.weight, last_gain if index == len(widths) else math.sqrt(2))
        nn.init.zeros_(linear.bias)
        hidden = index < len(widths)
        layers += [linear, *([nn.LayerNorm(fan_out)] if norm and hidden else []), *([Tanh()] if hidden else [])]
    return nn.Sequential(*layers)


class AgentHead(nn.Module):
    """``f([o_i || g_i])`` for every agent with shared parameters; o_i is the agent's own node (15 channels).

    With privileged channels w it is ``f([o_i || g_i || w])``; with points p_k among them, ``f([o_i || g_i || w ||
    p_1 - p_i || ..])`` with p_i the agent's position, as o_i holds the target. With a memory f reads the agent's hidden
    state too, beside all that the memory reads: ``f([x_i || h_i])``, where x_i is f's input without one.

    Attributes:
        in_keys: the entries that are read.
        out_features: numbers that f gives an agent.
    """

    def __init__(
        self,
        encoder: Encoder,
        widths: Sequence[int],
        out_features: int,
        last_gain: float,
        n_privileged: int = 0,
        n_points: int = 0,
        memory: MemoryConfig | None = None,
        hidden_norm: bool = False,
    ) -> None:
        """Put f (hidden layers ``widths``, last layer scaled by ``last_gain``) on an encoder, which gives g_i.

        Of the ``n_privileged`` channels ``n_points`` points are given relative to each agent too.
        """
        super().__init__()
        self.encoder = encoder
        self.out_features, self.n_privileged, self.n_points = out_features, n_privileged, n_points
        in_features = encoder.own_features + encoder.out_features + n_privileged + 3 * n_points
        self.memory = None if memory is None else Memory(memory, in_features)
        in_features += 0 if memory is None else memory.size
        self.in_keys = input_keys(encoder, n_privileged) + ([] if self.memory is None else self.memory.in_keys)
        self.function = feedforward(in_features, widths, out_features, last_gain, hidden_norm)

    def forward(self, td: TensorDictBase) -> Tensor:
        """``(..., N, out_features)``."""
        return self.function(self.inputs(td))

    def inputs(self, td: TensorDictBase) -> Tensor:
        """What f reads, ``(..., N, in_features)``; a memory's next state is written to ``td``."""
        parts = [self.encoder.own(td), self.encoder(td)]
        if self.n_privileged:
            known = td.get(entries.PRIVILEGED).unsqueeze(-2)
            parts.append(known.expand(*parts[0].shape[:-1], self.n_privileged))
        if self.n_points:
            parts.append(graph.relative_points(td, self.n_points))
        own = torch.cat(parts, dim=-1)
        return own if self.memory is None else torch.cat([own, self.memory(td, own)], dim=-1)


def build_head(
    encoder: Encoder, sizes: Sizes, config: Any, outputs: int, n_privileged: int, memory: MemoryConfig | None = None
) -> AgentHead | MirroredHead:
    """Build an actor's head, ``outputs`` numbers an agent, from its configuration; ``n_privileged`` > 0: an oracle's.

    The points among the privileged numbers are told relative to each agent too where the configuration says so.
    """
    points = sizes.n_points if n_privileged and config.relative_points else 0
    head = AgentHead(encoder, config.widths, outputs, 0.01, n_privileged, points, memory, config.hidden_norm)
    return WAYS[config.mirror](head, sizes.privileged_image) if config.mirror else head


@torch.no_grad()
def actor_saturation(policy: nn.Module, batch: TensorDictBase) -> dict[str, float]:
    """Tell how far the first tanh of an actor's head is driven, over evenly spaced frames of a batch.

    Nothing is drawn, so no random stream moves.

    Args:
        policy: with an ``AgentHead`` somewhere in it.
        batch: ``(num_envs, steps)`` frames that the policy can read.

    Returns:
        ``actor_saturation``, the share of units with a pre-activation beyond +- ``SATURATED``, and
        ``actor_preactivation``, the mean of its absolute value. Empty for a head without hidden layers or none at all.
    """
    head = next((module for module in policy.modules() if isinstance(module, AgentHead | MirroredHead)), None)
    if head is None or len(head.function) == 1:
        return {}
    count = min(batch.numel(), SATURATION_FRAMES)
    frames = torch.arange(count, device=batch.device) * batch.numel() // count
    chosen = (frames // batch.shape[1], frames % batch.shape[1])
    read = batch.select(*head.in_keys)[chosen]
    until = next(index for index, layer in enumerate(head.function) if isinstance(layer, Tanh))
    size = head.function[:until](head.inputs(read)).abs()
    share, mean = torch.stack([(size > SATURATED).float().mean(), size.mean()]).tolist()
    return {"actor_saturation": share, "actor_preactivation": mean}


class GaussianPolicy(TensorDictModuleBase):
    """Writes the pre-tanh mean ``LOC`` and standard deviation ``SCALE`` of every agent's action, ``(..., N, 2)``."""

    def __init__(self, encoder: Encoder, sizes: Sizes, config: ActorConfig, n_privileged: int = 0) -> None:
        """Put the policy's head on an encoder."""
        super().__init__()
        actions = sizes.action
        outputs = 2 * actions if config.state_dependent_sigma else actions
        self.head = build_head(encoder, sizes, config, outputs, n_privileged, config.memory)
        self.in_keys = self.head.in_keys
        self.out_keys = [LOC, SCALE, *([] if self.head.memory is None else self.head.memory.out_keys)]
        self.persistence = config.persistence
        self.low, self.range = math.log(config.min_sigma), math.log(config.max_sigma / config.min_sigma)
        fraction = torch.tensor((math.log(config.initial_sigma) - self.low) / self.range)
        self.sigma = nn.Parameter(fraction.logit().repeat(actions))

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write ``LOC`` and ``SCALE``.

        log sigma moves between its bounds on a logistic curve, along the parameter or, if it depends on the state,
        along the parameter plus the network's output. (A clamp would have no gradient beyond a bound and never return.)
        """
        output = self.head(td)
        actions = len(self.sigma)
        loc, sigma = output[..., :actions], self.sigma
        if output.shape[-1] > actions:
            sigma = sigma + output[..., actions:]
        if self.persistence:
            # the previous action before its tanh; near the bound it is cut, where atanh has no finite value
            previous = td.get(entries.PREVIOUS_ACTION).clamp(-0.99, 0.99).atanh()
            loc = torch.lerp(loc, previous, self.persistence)
        td.set(LOC, loc)
        td.set(SCALE, (self.low + self.range * sigma.sigmoid()).exp().expand_as(loc))
        return td


class TeamValue(TensorDictModuleBase):
    """A centralised critic: writes one value of the state, ``(..., 1)``.

    Pooling ``mean``: V(s) = f_V(mean over agents of g_i || w) (section "Distributed Control Policy"), w the privileged
    channels. Pooling ``concat``: V(s) = f_V(e) with the model's ``TeamEncoder``, which reads w too.
    """

    def __init__(self, encoder: Encoder | TeamEncoder, config: ValueConfig, n_privileged: int = 0) -> None:
        """Put the critic's head on an encoder of agents (pooling ``mean``) or of the team (``concat``)."""
        super().__init__()
        self.in_keys, self.out_keys = input_keys(encoder, n_privileged), [STATE_VALUE]
        self.encoder, self.n_privileged = encoder, n_privileged
        in_features = encoder.out_features + (n_privileged if isinstance(encoder, Encoder) else 0)
        self.function = feedforward(in_features, config.widths, 1, 1.0, config.hidden_norm)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write ``STATE_VALUE``."""
        known = privileged(td, self.n_privileged, td.get(self.in_keys[0]))
        if isinstance(self.encoder, TeamEncoder):
            return td.set(STATE_VALUE, self.function(self.encoder(td, known)))
        pooled = torch.cat([self.encoder(td).mean(dim=-2), known], dim=-1)
        return td.set(STATE_VALUE, self.function(pooled))


class AgentValue(TensorDictModuleBase):
    """An independent critic with shared parameters: writes a value per agent, ``(..., N, 1)``, of [o_i || g_i]."""

    def __init__(self, encoder: Encoder, config: ValueConfig, n_privileged: int = 0) -> None:
        """Put the critic's head on an encoder."""
        super().__init__()
        self.in_keys, self.out_keys = input_keys(encoder, n_privileged), [STATE_VALUE]
        self.head = AgentHead(encoder, config.widths, 1, 1.0, n_privileged, hidden_norm=config.hidden_norm)

    def forward(self, td: TensorDictBase) -> TensorDictBase:
        """Write ``STATE_VALUE``."""
        return td.set(STATE_VALUE, self.head(td))


def build_actor(
    encoder_config: Any, sizes: Sizes, config: ActorConfig, n_privileged: int = 0
) -> ProbabilisticTensorDictSequential:
    """Build the squashed Gaussian actor, which reads ``entries.OBSERVATION``.

    It writes ``entries.ACTION`` and ``entries.LOG_PROB`` (B, N). With a memory it goes from frame to frame ``(B,)``,
    reads ``entries.MEMORY`` and ``entries.IS_INIT`` and writes ``entries.NEXT_MEMORY``, and ``get_dist`` of frames
    ``(B, T)`` gives the distributions of T consecutive steps.

    It samples unless ``set_exploration_type`` says otherwise. tensordict's module is used and not TorchRL's
    ``ProbabilisticActor``: the latter (0.14.1) stores the log-probability of the pre-tanh sample, which differs from
    that of the stored float32 action by 2 % at |z| = 6 and without limit beyond, so that PPO's ratio of an unchanged
    policy would not be one. Losses that need the exact pathwise sample (SAC) take it from ``get_dist``.
    """
    encoder = build_encoder(encoder_config, sizes, config.embedding_norm)
    policy = GaussianPolicy(encoder, sizes, config, n_privileged)
    sample = ProbabilisticTensorDictModule(
        in_keys={"loc": LOC, "scale": SCALE},
        out_keys=[entries.ACTION],
        distribution_class=SquashedNormal,
        distribution_kwargs={"tanh_loc": True, "upscale": config.mean_bound, "event_dims": 1},
        return_log_prob=True,
        log_prob_key=entries.LOG_PROB,
        default_interaction_type=InteractionType.RANDOM,
    )
    return ProbabilisticTensorDictSequential(policy, sample)


def build_value(
    encoder_config: Any,
    sizes: Sizes,
    config: ValueConfig,
    centralised: bool = True,
    n_privileged: int = 0,
) -> TeamValue | AgentValue:
    """Build a critic with an encoder of its own, which reads ``entries.OBSERVATION``, writes ``STATE_VALUE``.

    A centralised critic says one value for the team, (B, 1); an independent one a value per agent, (B, N, 1), of what
    that agent's actor reads. With ``n_privileged`` above 0 its head reads ``entries.PRIVILEGED`` too.
    """
    encoder_config = config.mlp or encoder_config
    norm = config.embedding_norm
    if centralised and config.pooling == "concat":
        return TeamValue(build_team_encoder(encoder_config, sizes, n_privileged, norm), config, n_privileged)
    encoder = build_encoder(encoder_config, sizes, norm)
    return (TeamValue if centralised else AgentValue)(encoder, config, n_privileged)
