"""Find actions that succeed in a task's held-out scenes: ``softgm-bench certify task=NAME key=value ...``.

The scenes are those of ``evaluate episodes=EPISODES seed=SEED``. What is found is written after every round, and a
search goes on from what ``out`` holds. Settings, with their defaults:

  task=NAME            any task of the arm; single settings of it too, such as task.opening_side=0.3, and rod.<key>
  episodes=500         scenes
  seed=0               of the evaluation whose scenes they are
  policies=[]          policies' files, run folders or checkpoints whose episodes are tried first
  samples=1            how often each of them is tried with sampled actions, beside once without
  borrow=[]            files of other tasks' certified scenes, of which the most similar ones are tried next,
  nearest=8            so many for each scene
  minutes=10           for the search after that; it ends sooner if all scenes are certified
  steps=60             control steps of a sequence at most
  children=8           new sequences a scene and round
  out=null             file; null: the one that evaluations read
  threads=1            null: every core that this process may use
"""

import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from softgm_bench import command
from softgm_bench.config import available_threads
from softgm_bench.errors import UserError

if TYPE_CHECKING:
    from softgm_bench.certification import Search
    from softgm_bench.config import Config


@dataclass
class Options:
    """The command's own settings; meanings above."""

    episodes: int = 500
    seed: int = 0
    policies: list[str] = field(default_factory=list)
    samples: int = 1
    borrow: list[str] = field(default_factory=list)
    nearest: int = 8
    minutes: float = 10.0
    steps: int = 60
    children: int = 8
    out: str | None = None
    threads: int | None = 1

    def check(self) -> None:
        """Refuse values that make no sense.

        Raises:
            UserError: naming the first such setting, its value and what would be right.
        """
        for key, lowest in (("episodes", 1), ("seed", 0), ("samples", 0), ("steps", 1), ("children", 1)):
            if getattr(self, key) < lowest:
                raise UserError(f"{key}={getattr(self, key)}: it must be at least {lowest}")
        if not self.minutes >= 0.0:
            raise UserError(f"minutes={self.minutes}: it must be at least 0")
        if self.threads is not None and not 1 <= self.threads <= available_threads():
            raise UserError(f"threads={self.threads}: choose 1 to {available_threads()}, the cores here, or null")


def main() -> int:
    """Run what the command line says; 0, or 2 after one line about what is wrong."""
    return command.run("certify", __doc__, _certify)


def _certify(arguments: list[str]) -> None:
    options, overrides = command.split(arguments, Options, others=True)
    options.check()
    if not any(override.startswith("task=") for override in overrides):
        raise UserError("name a task: task=wall, for example")
    # late: a refused command need not wait for torch
    from softgm_bench.assembly import configure
    from softgm_bench.certification import Bench, Search
    from softgm_bench.certification.bench import to_tensor
    from softgm_bench.certification.search import described, run
    from softgm_bench.envs import kind_of
    from softgm_bench.envs.tasks import TASKS
    from softgm_bench.episodes import certified
    from softgm_bench.runs.machine import keep_memory, set_threads

    set_threads(options.threads)
    keep_memory()
    config = configure(["recipe=paper", *overrides])
    if not kind_of(config.task).has_arm:
        raise UserError(f"task={config.task.name}: there is no arm in it")
    if TASKS[config.task.name].moves:
        raise UserError(f"task={config.task.name}: its obstacles move; scenes are certified where they stand still")
    if not config.randomise.nothing:
        raise UserError(f"randomise={config.randomise.name}: scenes are certified for the nominal arm; it must be none")
    path = Path(options.out or certified.FOLDER / f"{config.task.name}.npz")
    bench, judge = (Bench(config, options.episodes, options.seed, dtype) for dtype in ("float32", "float64"))
    search = Search(bench, judge, options.steps, options.seed)
    if path.exists():
        _resume(search, path, config, options)

    def note() -> None:
        certified.save(search.found(config.task.name, options.seed), path)
        print(_progress(search), flush=True)

    note()
    _follow(search, config, options, note)
    for name in options.borrow:
        other = certified.load(Path(name))
        search.borrow(other, described(*map(to_tensor, (other.privileged, other.target))).numpy(), options.nearest)
        note()
    until = time.monotonic() + 60.0 * options.minutes
    run(search, lambda: time.monotonic() >= until, options.children, note)
    print(f"written to {path}")


def _resume(search: "Search", path: Path, config: "Config", options: Options) -> None:
    from softgm_bench.episodes import certified

    known, fresh = certified.load(path), search.found(config.task.name, options.seed)
    same = known.physics == fresh.physics and known.target.tobytes() == fresh.target.tobytes()
    if not same or known.privileged.tobytes() != fresh.privileged.tobytes():
        raise UserError(f"out={path} holds other scenes or another arm: choose another file")
    search.take(known)


def _follow(search: "Search", config: "Config", options: Options, note) -> None:
    from softgm_bench.episodes import policy

    for source in options.policies:
        trained = policy.load(Path(source))
        if trained.config.task.name != config.task.name or trained.config.task != config.task:
            trained = policy.load(Path(source), overrides=[f"task={config.task.name}"])
        for sample in range(options.samples + 1):
            search.follow(trained.policy, sampled=sample > 0, seed=sample)
            note()


def _progress(search: "Search") -> str:
    known, scenes = int((search.length > 0).sum()), len(search.length)
    tried = int((search.tried > 0).sum())
    spent = sum(bench.steps for bench in (search.bench, search.judge))
    return f"{known} certified of {tried} tried of {scenes}; {int(search.tried.sum())} sequences, {spent} control steps"


if __name__ == "__main__":
    sys.exit(main())
