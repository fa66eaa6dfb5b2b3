"""A run under way: what it consists of, and what of it a checkpoint holds."""

import time
from dataclasses import asdict, dataclass, field
from typing import Any, NamedTuple

import numpy as np
from tensordict import TensorDict

from softgm_bench.algorithms import Algorithm
from softgm_bench.config import Config, plain
from softgm_bench.runs import checkpoint
from softgm_bench.runs.budget import Budget
from softgm_bench.runs.loggers.guarded import Loggers
from softgm_bench.runs.metrics import EpisodeTracker
from softgm_bench.storage.run_folder import RunFolder
from softgm_bench.storage.versions import versions
from softgm_bench.upstream.collector import FrameCollector, MixtureCollector


class Seeds(NamedTuple):
    """Independent seeds derived from a run's one."""

    torch: int
    training: int
    evaluation: int
    final_evaluation: int


@dataclass
class Run:
    """A run under way.

    Attributes:
        env: an ``Environment``, of a mixture a ``SectionMixture``.
        started: when it would have begun if it had never been interrupted, on the clock of ``time.perf_counter``.
        budget: of this process's time.
        frames: control steps of single environments that the policy has learnt from.
        evaluations: made so far.
        start: the policy that it began with: ``policy`` as it was named, ``fingerprint``, ``frames``; None: with none.
    """

    config: Config
    folder: RunFolder
    seeds: Seeds
    env: Any
    algorithm: Algorithm
    collector: FrameCollector | MixtureCollector
    episodes: EpisodeTracker
    started: float
    budget: Budget
    iteration: int = 0
    frames: int = 0
    evaluations: int = 0
    start: dict[str, Any] | None = None
    loggers: Loggers = field(init=False)

    @property
    def wall_time(self) -> float:
        """Seconds since the run began, without those between an interruption and resuming."""
        return time.perf_counter() - self.started

    @property
    def evaluations_due(self) -> int:
        """The number of evaluations that ``evaluation.interval`` asks for by now, at most one an iteration."""
        return min(self.iteration, self.frames // self.config.experiment.evaluation.interval)

    def state_dict(self) -> dict[str, Any]:
        """Give everything that resuming needs, and what it belongs to: tensors and plain Python values."""
        return {
            "algorithm": self.algorithm.state_dict(),
            "random": checkpoint.random_state(),
            "environment": {
                "generator": self.env.generator_state(),
                "simulation": self.env.simulation_state().to_dict(),
                "shown": self.collector.shown(),
            },
            "episodes": self.episodes.state_dict(),
            "counters": {"iteration": self.iteration, "evaluations": self.evaluations, "wall_time": self.wall_time},
            "start": self.start,
            "policy": self.algorithm.policy.state_dict(),
            "sizes": asdict(self.env.sizes),
            "config": plain(self.config),
            "versions": versions(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Resume from a checkpoint: what ``state_dict`` returned, and ``frames``."""
        self.algorithm.load_state_dict(state["algorithm"])
        environment, counters = state["environment"], state["counters"]
        simulation = TensorDict(environment["simulation"], self.env.batch_size, device=self.env.device)
        self.env.load_simulation_state(simulation)
        self.env.set_generator_state(environment["generator"])
        self.collector.show(environment["shown"])
        self.episodes.load_state_dict(state["episodes"])
        self.iteration, self.evaluations = counters["iteration"], counters["evaluations"]
        self.frames, self.start = state["frames"], state.get("start")
        self.started -= counters["wall_time"]
        checkpoint.set_random_state(state["random"])  # last: nothing draws any more


def derive_seeds(seed: int) -> Seeds:
    """Seeds that share nothing, so that evaluation and training never draw the same targets."""
    return Seeds(*(int(word) for word in np.random.SeedSequence(seed).generate_state(4)))


def total_frames(config: Config) -> int:
    """Frames of a run: those that are asked for, rounded up to whole iterations."""
    frames = frames_per_iteration(config)
    return -(-config.experiment.total_frames // frames) * frames


def frames_per_iteration(config: Config) -> int:
    """Give the frames of an iteration, over all environments."""
    return config.experiment.num_envs * config.experiment.steps_per_batch
