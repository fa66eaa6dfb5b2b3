"""A transformer over an arm's sections and obstacle bins, after Amorpheus (Kurin et al. 2021, "My Body is a Cage: the
Role of Morphology in Graph-Based Incompatible Control").

Every section and every bin is a token: its features through one linear layer, plus the learnt embedding of its type.
Blocks are torch's ``nn.TransformerEncoderLayer``, normalised before attention and feed-forward network, with a
normalisation after the last; the actor reads [o_i || g_i], the token's features beside its embedding, which is
Amorpheus's residual connection from node features to decoder. What differs:

- attention is masked by who hears whom in SoftGM: a section hears its neighbours on the chain, itself and the bins
  that it senses, a bin itself alone. Execution is decentralised so, and L blocks reach L places. Amorpheus lets all
  limbs attend to all, which ``everyone`` allows to sections (``section_transformer_all``); that is one controller of
  the whole arm, which no other model here is.
- Amorpheus has no obstacles, hence no bins, and no types.
- blocks are normalised before instead of after, Amorpheus's torch default; inputs are not multiplied by sqrt(width).
  64 channels, 4 heads, 2 blocks and 128 hidden units instead of 128, 2, 3 and 256: SoftGM's cost.
- one body and one task at a time with this package's algorithms and heads, tanh networks; Amorpheus trains one TD3 on
  many bodies with a linear decoder.

Of the Multi-Agent Transformer (Wen et al. 2022) this has the encoder, with the mask. Its decoder emits the agents'
actions one after another, each with those before it in view: that fits neither decentralised execution nor the
algorithms here. There is no embedding of a token's place, as in Amorpheus: no other model is told it, and it would tie
the parameters to N.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import torch
from tensordict import TensorDictBase
from torch import Tensor, nn
from torch.nn import functional

from softgm_bench.envs.interface import Sizes
from softgm_bench.models import dot_product, graph
from softgm_bench.models.dot_product import Heard, Hearing
from softgm_bench.models.registry import Encoder, register_model


@dataclass
class SectionTransformerConfig:
    """Architecture. Values: ``conf/model/section_transformer.yaml``.

    Attributes:
        name: of the file in ``conf/model``.
        hidden: length of a token's embedding, over all heads.
        heads: attention heads; divides ``hidden``.
        layers: L, blocks; how many places away on the chain a section is heard.
        feedforward: hidden units of a block's feed-forward network.
        velocity_scale: factor of the sections' velocity channels at the input.
        remember: every section hears all bins that the team has discovered, not those alone that it senses.
        everyone: every section hears every other one, not its neighbours alone.
    """

    name: str
    hidden: int
    heads: int
    layers: int
    feedforward: int
    velocity_scale: float
    remember: bool
    everyone: bool

    def __post_init__(self) -> None:
        """Refuse values that give no network.

        Raises:
            ValueError: with one line naming the key, its value and what would be right.
        """
        dot_product.check_sizes(self, "layers", "feedforward")


@register_model(
    "section_transformer",
    "section_transformer_all",
    "section_transformer_remember",
    config=SectionTransformerConfig,
)
class SectionTransformerEncoder(Encoder):
    """Turns the observation into one embedding g_i per agent, its token after L blocks.

    The blocks' own ``forward`` would take every slot for a listener. What a bin makes of itself needs no attention, so
    sections alone have queries; with the mask, ``forward`` of the blocks gives the same to rounding (a test).
    """

    def __init__(self, config: SectionTransformerConfig, sizes: Sizes) -> None:
        """Draw the parameters; none depends on N or M, which ``forward`` takes from the observation."""
        super().__init__(config.hidden, config.velocity_scale)
        self.config = config
        self.input = nn.Linear(graph.CHANNELS, config.hidden)
        self.types = nn.Embedding(2, config.hidden)
        self.blocks = nn.ModuleList(
            nn.TransformerEncoderLayer(
                config.hidden, config.heads, config.feedforward, dropout=0.0, batch_first=True, norm_first=True
            )
            for _ in range(config.layers)
        )
        self.norm = nn.LayerNorm(config.hidden)

    def forward(self, td: TensorDictBase) -> Tensor:
        """Embeddings ``(..., N, hidden)`` from the entries ``entries.OBSERVATION``."""
        return self._embed(td, None)

    def forward_with_weights(self, td: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Embeddings as ``forward``, and the attention weights of every block.

        Returns:
            Embeddings and ``(..., L, H, N, N + M)``, of every token (sections, then slots) for every section. Rows
            sum to one.
        """
        record: list[Tensor] = []
        embeddings = self._embed(td, record)
        weights = torch.stack(record, dim=1)
        return embeddings, weights.reshape(*embeddings.shape[:-2], *weights.shape[1:])

    def _embed(self, td: TensorDictBase, record: list[Tensor] | None) -> Tensor:
        channels = graph.agent_channels(td, self.velocity_scale)
        reach = None if self.config.everyone else 1
        hearing = dot_product.listen(td, reach, itself=True, discovered=self.config.remember)
        sections = self._enter(channels.flatten(0, -2), graph.AGENT)
        bins = self._enter(hearing.bins, graph.OBSTACLE)
        for depth, block in enumerate(cast(Iterable[nn.TransformerEncoderLayer], self.blocks), start=1):
            # nobody reads what the last block makes of bins
            sections, bins, heard = _block(block, sections, bins, hearing, last=depth == len(self.blocks))
            if record is not None:
                record.append(dot_product.weights(heard, hearing))
        return self.norm(sections).unflatten(0, channels.shape[:-1])

    def _enter(self, channels: Tensor, node_type: int) -> Tensor:
        """Make tokens of one type, ``(K, 15)`` to ``(K, hidden)``."""
        return functional.linear(channels, self.input.weight, self.input.bias + self.types.weight[node_type])


def _block(
    block: nn.TransformerEncoderLayer, sections: Tensor, bins: Tensor, hearing: Hearing, *, last: bool
) -> tuple[Tensor, Tensor, Heard]:
    """Give new sections ``(T, hidden)``, bins ``(K, hidden)``, old ones in the ``last`` block, and what was heard."""
    attention = block.self_attn
    weight, bias, hidden = attention.in_proj_weight, attention.in_proj_bias, attention.embed_dim
    shape = (attention.num_heads, attention.head_dim)
    of_sections = functional.linear(block.norm1(sections), weight, bias).unflatten(-1, (3, *shape))
    of_bins = functional.linear(block.norm1(bins), weight[hidden:], bias[hidden:]).unflatten(-1, (2, *shape))
    heard = dot_product.attend(of_sections, of_bins, hearing)
    sections = _feed(block, sections + attention.out_proj(heard.values.flatten(-2)))
    if not last:  # a bin hears itself, with weight 1
        bins = _feed(block, bins + attention.out_proj(of_bins[:, 1].flatten(-2)))
    return sections, bins, heard


def _feed(block: nn.TransformerEncoderLayer, tokens: Tensor) -> Tensor:
    return tokens + block.linear2(functional.relu(block.linear1(block.norm2(tokens))))
