"""An encoder of observations that are a plain vector per agent, as other people's tasks have them."""

from dataclasses import dataclass

from tensordict import TensorDictBase
from torch import Tensor, nn

from softgm_bench.envs.interface import Sizes
from softgm_bench.envs.vmas import OBSERVATION
from softgm_bench.models.activation import tanh
from softgm_bench.models.mlp import orthogonal_layers
from softgm_bench.models.registry import Encoder, register_model


@dataclass
class VectorMLPConfig:
    """Architecture. Values: ``conf/model/vector_mlp.yaml``.

    Attributes:
        widths: hidden layers, each followed by tanh. Without any, g_i is agent i's observation itself, and all layers
            are the heads'; critics of actions then read actions in their first layer, as BenchMARL's do.
    """

    widths: list[int]


@register_model("vector_mlp", config=VectorMLPConfig)
class VectorMLPEncoder(Encoder):
    """Parameters shared by all agents; heads put nothing beside its embeddings."""

    in_keys = (OBSERVATION,)
    own_features = 0

    def __init__(self, config: VectorMLPConfig, sizes: Sizes) -> None:
        """Draw the parameters for observations of F numbers; none depends on N."""
        widths = [sizes.n_features, *config.widths]
        super().__init__(widths[-1], velocity_scale=1.0)
        self.layers = nn.ModuleList(orthogonal_layers(widths))

    def own(self, td: TensorDictBase) -> Tensor:
        """Nothing, ``(..., N, 0)``."""
        return td.get(OBSERVATION)[..., :0]

    def forward(self, td: TensorDictBase) -> Tensor:
        """Embeddings ``(..., N, out_features)`` from the entry ``OBSERVATION``."""
        hidden = td.get(OBSERVATION)
        for layer in self.layers:
            hidden = tanh(layer(hidden))
        return hidden
