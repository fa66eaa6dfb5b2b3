"""What SoftGM's encoder costs: against the MLP and against the same layers from torch_geometric.

``python benchmarks/bench_models.py`` prints milliseconds of one forward pass, and of forward and backward, over a batch
of observations with none, some and all obstacle slots discovered. torch_geometric gets the paper's graph as one large
batch of nodes (agents and discovered slots) and edge lists; building both is part of its time, as it is of ours. Matrix
products and memory are set as in training, for all three.
"""

import argparse
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import record
import torch
from tensordict import TensorDictBase
from timing import best_rate
from torch import Tensor, nn
from torch_geometric.nn import GATConv

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "models"))
from observations import observation

from softgm_bench.config import compose
from softgm_bench.envs import entries
from softgm_bench.envs.interface import Sizes
from softgm_bench.models import build_encoder, graph
from softgm_bench.models.softgm import SoftGMConfig
from softgm_bench.runs.machine import keep_memory, set_threads

N_AGENTS, N_SLOTS = 6, 128
DISCOVERED = (0, 32, 128)
SENSED = 0.05  # share of the pairs of agent and discovered slot with an edge; on the wall one agent senses a few bins


class Geometric(nn.Module):
    """SoftGM's two stages from torch_geometric's ``GATConv``."""

    def __init__(self, config: SoftGMConfig) -> None:
        super().__init__()
        self.types = nn.Embedding(3, config.type_embedding)
        self.input = nn.Linear(graph.NODE_FEATURES + config.type_embedding, config.hidden, bias=False)

        def stage() -> nn.ModuleList:
            width = config.hidden // config.heads
            return nn.ModuleList(GATConv(config.hidden, width, config.heads) for _ in range(config.layers))

        self.stage1, self.stage2 = stage(), stage()

    def forward(self, td: TensorDictBase) -> Tensor:
        """``(B, N, hidden)``."""
        nodes, entity_edges, agent_edges = packed_graph(td)
        hidden = self.input(torch.cat([nodes, self.types(self._node_types(td))], dim=-1))
        for convolution in self.stage1:
            hidden = nn.functional.elu(convolution(hidden, entity_edges))
        agents = hidden[: td.numel() * N_AGENTS]
        for depth, convolution in enumerate(self.stage2):
            agents = convolution(agents, agent_edges)
            agents = nn.functional.elu(agents) if depth < len(self.stage2) - 1 else agents
        return agents.unflatten(0, (-1, N_AGENTS))

    def _node_types(self, td: TensorDictBase) -> Tensor:
        agents = td.numel() * N_AGENTS
        slots = int(td[entries.SLOT_ACTIVE].sum())
        return torch.tensor([graph.AGENT, graph.OBSTACLE]).repeat_interleave(torch.tensor([agents, slots]))


def packed_graph(td: TensorDictBase) -> tuple[Tensor, Tensor, Tensor]:
    """All agents, then all discovered slots of a batch: features ``(V, 22)`` and the two stages' edges ``(2, E)``."""
    active = td[entries.SLOT_ACTIVE]
    agents = graph.agent_features(td).flatten(0, -2)
    nodes = torch.cat([agents, graph.slot_features(td)[active]])
    index = torch.full(active.shape, -1, dtype=torch.long)
    index[active] = len(agents) + torch.arange(int(active.sum()))
    environment, agent, slot = td[entries.EDGE].nonzero(as_tuple=True)
    entity_edges = torch.stack([index[environment, slot], environment * N_AGENTS + agent])
    first = torch.arange(len(agents)).unflatten(0, (-1, N_AGENTS))
    left, right = first[:, :-1].flatten(), first[:, 1:].flatten()
    return nodes, entity_edges, torch.stack([torch.cat([left, right]), torch.cat([right, left])])


def milliseconds(work: Callable[[], Any]) -> float:
    work()
    return 1e3 / best_rate(work, 1.0, 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--batch", type=int, default=1600)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/models.json"))
    options = parser.parse_args()
    set_threads(options.threads)
    keep_memory()
    torch.manual_seed(0)

    config = compose(["algo=softgm", "recipe=paper"]).model
    encoders = {
        "softgm": build_encoder(config, Sizes(N_AGENTS, 2, n_slots=N_SLOTS)),
        "mlp": build_encoder(compose(["model=mlp", "recipe=paper"]).model, Sizes(N_AGENTS, 2, n_slots=N_SLOTS)),
        "torch_geometric": Geometric(config),
    }
    rows = []
    print(f"batch of {options.batch}, {N_AGENTS} agents, {N_SLOTS} slots, {options.threads} thread(s); milliseconds")
    print(f"{'encoder':<18}{'discovered':>11}{'edges':>8}{'forward':>10}{'and backward':>14}{'to softgm':>11}")
    for discovered in DISCOVERED:
        td = observation((options.batch,), N_AGENTS, N_SLOTS, sensed=SENSED, discovered=1.0)
        beyond = torch.arange(N_SLOTS) >= discovered
        td[entries.SLOT_ACTIVE][:, beyond] = False
        td[entries.SLOT_DESCRIPTOR][:, beyond] = 0.0
        td[entries.EDGE][..., beyond] = False
        edges = int(td[entries.EDGE].sum())
        base = None
        for name, encoder in encoders.items():

            def forward(encoder: nn.Module = encoder, td: TensorDictBase = td) -> Tensor:
                with torch.no_grad():
                    return encoder(td)

            def both(encoder: nn.Module = encoder, td: TensorDictBase = td) -> None:
                encoder.zero_grad(set_to_none=True)
                encoder(td).square().mean().backward()

            times = milliseconds(forward), milliseconds(both)
            base = base or times[1]
            row = {"encoder": name, "discovered": discovered, "edges": edges, "forward_ms": times[0]}
            rows.append(row | {"forward_backward_ms": times[1], "ratio": times[1] / base})
            print(f"{name:<18}{discovered:>11}{edges:>8}{times[0]:>10.2f}{times[1]:>14.2f}{times[1] / base:>11.2f}")
    record.write(options.output, {"batch": options.batch, "threads": options.threads, "rows": rows})


if __name__ == "__main__":
    main()
