"""Small data sets for tests, and everything that their environments showed, kept as it came."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
from tensordict import TensorDict

from softgm_bench.assembly import build_env
from softgm_bench.config import plain
from softgm_bench.datasets import mixture, sheet, writing
from softgm_bench.envs import kind_of
from softgm_bench.episodes.evaluation import evaluate

POLICY = str(Path(__file__).parents[2] / "experiments/policies/{task}_softgm.pt")


@dataclass
class Asked:
    """What is to be written."""

    sources: list[str]
    overrides: list[str] = field(default_factory=list)
    transitions: int = 40
    seed: int = 0
    batch: int = 3
    chunk: int = 25
    horizon: int = 6
    deterministic: bool = False

    def load(self):
        """Policies, configuration and settings."""
        shares = [1.0] * len(self.sources)
        behaviours, config = mixture.load(self.sources, shares, self.transitions, "cpu", self.overrides)
        keys = ("transitions", "seed", "batch", "chunk", "horizon", "deterministic")
        settings: dict[str, Any] = {key: getattr(self, key) for key in keys}
        settings |= {"format": writing.FORMAT, "name": "small", "task": config.task.name, "config": plain(config)}
        settings |= {"policies": [one.about for one in behaviours], "backend": "numba", "device": "cpu"}
        settings |= {"purpose": None, "author": None, "licence": "MIT", "command": "", "threads": 1, "versions": {}}
        return behaviours, config, settings


def write(folder, asked):
    """Write a data set from wherever it stands to its end."""
    behaviours, config, settings = asked.load()
    if not writing.begin(folder, settings):
        done = writing.Progressed(folder, len(behaviours))
        writing.write(folder, behaviours, config, settings, done, lambda count: None)
        writing.finish(folder, sheet.fill(folder, settings, kind_of(config.task).sizes(config.task)))


def played(asked, number, part):
    """The steps of a part as the environment gives them, ``(batch, steps)``, and which of them are the episodes'."""
    behaviours, config, _ = asked.load()
    seed = mixture.part_seed(asked.seed, number, part)
    env = build_env(config, asked.batch, seed, asked.horizon)
    steps, alive = [], []

    def keep(data, playing):
        steps.append(data.clone())
        alive.append(playing.clone())

    evaluate(behaviours[number].policy, env, deterministic=asked.deterministic, seed=seed, keep=keep)
    shared = [step.select(*steps[-1].keys(True, True), strict=False) for step in steps]
    return TensorDict.maybe_dense_stack(shared, dim=1), torch.stack(alive, dim=1)
