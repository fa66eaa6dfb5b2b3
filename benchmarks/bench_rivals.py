"""Floating-point operations and time of SoftGM's encoder, of its rivals' and of the MLP, on what a trained policy sees.

``python benchmarks/bench_rivals.py`` plays the kept policy of a task, lets every encoder read the frames and prints a
row for each: parameters, operations a frame of a forward pass (two for a multiplication with its addition), and
microseconds of processor time a frame, of a forward pass and of forward and backward. Matrix products are counted by
torch. Attention's sums over what is heard are compiled loops on a CPU, which torch does not see; their operations are
added by formula. Layer normalisations, activations and exponentials are counted nowhere.
"""

import argparse
import time
from pathlib import Path
from typing import Any

import record
import torch
from tensordict import TensorDictBase
from timing import best_rate
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode
from torchrl.envs.utils import ExplorationType, set_exploration_type

from softgm_bench.assembly import build_env
from softgm_bench.config import compose
from softgm_bench.envs import entries
from softgm_bench.episodes import policy
from softgm_bench.models import build_encoder
from softgm_bench.runs.machine import keep_memory, set_threads

MODELS = ("softgm", "informarl", "section_transformer", "section_transformer_all", "mlp")
TASKS = ("basic", "wall")
POLICIES = Path("experiments/policies")


def frames(task: str, num_envs: int, steps: int, kept: int) -> tuple[TensorDictBase, Any]:
    """``kept`` frames of a trained policy's episodes, evenly spread, and the environment's sizes."""
    trained = policy.load(POLICIES / f"{task}_softgm.pt")
    env = build_env(trained.config, num_envs, seed=1)
    with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
        played = env.rollout(steps, trained.policy, break_when_any_done=False).select(*entries.OBSERVATION)
    flat = played.reshape(-1)
    return flat[torch.arange(kept) * len(flat) // kept].contiguous(), env.sizes


def loops(name: str, config: Any, td: TensorDictBase) -> int:
    """Operations of attention outside of matrix products: a weighted sum for each pair and channel, and a score.

    SoftGM's scores are a part of its matrix products.
    """
    n_agents = td[entries.EDGE].shape[-2]
    chain = td.numel() * (3 * n_agents - 2)  # pairs of an agent with itself or a neighbour
    everyone = td.numel() * n_agents**2
    edges = int(td[entries.EDGE].sum())
    if name == "softgm":
        return 2 * config.hidden * config.layers * (chain + edges + td.numel() * n_agents)  # stage 1: itself, too
    if name == "mlp":
        return 0
    agents = everyone if getattr(config, "everyone", False) else chain
    agents -= td.numel() * n_agents if name == "informarl" else 0  # no agent hears itself
    return 4 * config.hidden * config.layers * (agents + edges)


def measure(task: str, td: TensorDictBase, sizes: Any) -> list[dict[str, Any]]:
    sensed = td[entries.EDGE].any(-2).sum().item() / len(td)
    rows = []
    for name in MODELS:
        torch.manual_seed(0)
        config = compose([f"model={name}"]).model
        encoder = build_encoder(config, sizes)

        def forward(encoder: nn.Module = encoder) -> Tensor:
            with torch.no_grad():
                return encoder(td)

        def both(encoder: nn.Module = encoder) -> None:
            encoder.zero_grad(set_to_none=True)
            encoder(td).square().mean().backward()

        counter = FlopCounterMode(display=False)
        with counter:
            forward()
        counted = counter.get_total_flops() + loops(name, config, td)
        rates = [best_rate(work, len(td), 1.0, 4, time.process_time) for work in (forward, both)]
        seconds = [1.0 / rate for rate in rates]
        rows.append(
            {
                "task": task,
                "model": name,
                "bins_heard_a_frame": round(sensed, 2),
                "edges_a_frame": round(td[entries.EDGE].sum().item() / len(td), 2),
                "parameters": sum(parameter.numel() for parameter in encoder.parameters()),
                "kflop_a_frame": round(1e-3 * counted / len(td), 1),
                "forward_us_a_frame": round(1e6 * seconds[0], 3),
                "forward_backward_us_a_frame": round(1e6 * seconds[1], 3),
            }
        )
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--frames", type=int, default=1280, help="of a batch, a minibatch of PPO's")
    parser.add_argument("--tasks", nargs="+", default=TASKS)
    parser.add_argument("--output", type=Path, default=Path("benchmarks/results/rivals.json"))
    options = parser.parse_args()
    set_threads(options.threads)
    keep_memory()
    torch.manual_seed(0)
    rows = []
    print(f"{options.frames} frames, {options.threads} thread(s)")
    print(f"{'task':<8}{'model':<26}{'parameters':>11}{'kflop':>9}{'forward us':>12}{'and backward':>14}")
    for task in options.tasks:
        td, sizes = frames(task, 64, 60, options.frames)
        for row in measure(task, td, sizes):
            times = f"{row['forward_us_a_frame']:>12.2f}{row['forward_backward_us_a_frame']:>14.2f}"
            print(f"{task:<8}{row['model']:<26}{row['parameters']:>11,}{row['kflop_a_frame']:>9.1f}{times}", flush=True)
            rows.append(row)
    record.write(options.output, {"frames": options.frames, "threads": options.threads, "rows": rows})


if __name__ == "__main__":
    main()
