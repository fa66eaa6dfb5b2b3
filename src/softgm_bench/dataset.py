"""Write a data set of transitions: ``softgm-bench dataset out=FOLDER policies=[...] key=value ...``.

Policies play whole episodes, and what they saw, did and got is written into files that TorchRL's replay buffers map
into memory; docs/datasets.md describes them. The same command goes on where an interrupted one has stopped.
Settings, with their defaults:

  out=FOLDER           of the data set
  policies=[random]    who acts: random (uniform actions), run folders, checkpoints of any time, policies' files
  shares=null          of the transitions that each has, in any unit, such as [1,1,2]; null: equal ones
  transitions=100000   at least so many in all; episodes are whole
  seed=0               of scenes and sampled actions; never training's nor an evaluation's
  deterministic=false  true: policies act by their mode, otherwise by samples as in training
  horizon=null         control steps of an episode; null: the task's own
  batch=64             episodes side by side, which share a seed. Other batches are other episodes
  chunk=100000         transitions of a file at least, or as many as its policy has left
  threads=1            null: every core that this process may use. Other numbers may give other last bits
  device=cpu           cpu, cuda or cuda:<index>
  name=null            of the data set; null: the folder's
  purpose=null         for its datasheet: what it was made for,
  author=null          by whom,
  licence=MIT          and under which terms it may be used

Any other setting changes what is acted in, for all policies:

  task=wall                      any task; needed if all act at random. Single settings too, such as task.n_agents=8,
                                 rod.<key>, dtype, backend
  perturbation=noise             none, noise, section_failure or disturbance (conf/perturbation)
  randomise=moderate             none, moderate or wide (conf/randomise): an arm of its own for every episode
"""

import shlex
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from softgm_bench import command
from softgm_bench.config import available_threads
from softgm_bench.episodes.protocol import check_seed, whole_from_one
from softgm_bench.errors import UserError
from softgm_bench.progress import Progress

if TYPE_CHECKING:
    from softgm_bench.datasets.writing import Progressed


@dataclass
class Options:
    """The command's own settings; meanings above."""

    out: str | None = None
    policies: list[str] = field(default_factory=lambda: ["random"])
    shares: list[float] | None = None
    transitions: int = 100_000
    seed: int = 0
    deterministic: bool = False
    horizon: int | None = None
    batch: int = 64
    chunk: int = 100_000
    threads: int | None = 1
    device: str = "cpu"
    name: str | None = None
    purpose: str | None = None
    author: str | None = None
    licence: str = "MIT"

    def check(self) -> None:
        """Refuse values that make no sense.

        Raises:
            UserError: naming the first such setting, its value and what would be right.
        """
        if not self.out:
            raise UserError("name a folder for the data set: out=FOLDER")
        for key in ("transitions", "batch", "chunk", "horizon"):
            whole_from_one(key, getattr(self, key), optional=key == "horizon")
        check_seed(self.seed)
        if not self.policies:
            raise UserError("policies=[]: name random or a policy's file at least")
        if self.shares is not None:
            if len(self.shares) != len(self.policies):
                raise UserError(f"shares has {len(self.shares)} numbers: policies has {len(self.policies)}")
            if not all(share > 0.0 for share in self.shares):
                raise UserError(f"shares={self.shares}: every share must be above 0")
        if self.transitions < len(self.policies):
            raise UserError(f"transitions={self.transitions}: {len(self.policies)} policies need one each at least")
        if self.threads is not None and not 1 <= self.threads <= available_threads():
            raise UserError(f"threads={self.threads}: choose 1 to {available_threads()}, the cores here, or null")


def main() -> int:
    """Run what the command line says; 0, or 2 after one line about what is wrong."""
    return command.run("dataset", __doc__, _dataset)


def _dataset(arguments: list[str]) -> None:
    options, overrides = command.split(arguments, Options, others=True)
    options.check()
    # late: a refused command need not wait for torch
    from softgm_bench.datasets import mixture, sheet, writing
    from softgm_bench.envs import kind_of
    from softgm_bench.runs.machine import keep_memory, set_threads

    folder = Path(options.out or "")
    threads = set_threads(options.threads)
    keep_memory()
    shares = options.shares or [1.0] * len(options.policies)
    behaviours, config = mixture.load(options.policies, shares, options.transitions, options.device, overrides)
    settings = _settings(options, arguments, behaviours, config, threads)
    sizes = kind_of(config.task).sizes(config.task)
    finished = writing.begin(folder, settings)
    if finished:
        writing.verify(folder)
    else:
        done = writing.Progressed(folder, len(behaviours))
        _collect(options, folder, behaviours, config, settings, done)
        writing.finish(folder, sheet.fill(folder, settings, sizes))
    print(sheet.table(settings, writing.episodes_of(folder)))
    print(f"written before, and its checksums agree: {folder}" if finished else f"written to {folder}")


def _collect(options: Options, folder: Path, behaviours: Any, config: Any, settings: Any, done: "Progressed") -> None:
    """Write what is missing, while somebody may watch or interrupt it."""
    from softgm_bench.datasets import writing

    left = max(0, options.transitions - sum(done.transitions))
    with Progress("collecting", options.transitions, "transitions", options.transitions - left) as progress:

        def tell(count: int) -> None:
            nonlocal left
            count = min(count, left)  # the last episodes may be more than were asked for
            left -= count
            progress.advance(count, f"whole chunks: {done.chunks}")

        try:
            writing.write(folder, behaviours, config, settings, done, tell)
        except KeyboardInterrupt as interruption:
            whole = f"whole chunks so far: {done.chunks}, the same command goes on from there"
            raise KeyboardInterrupt(f"interrupted; {whole}") from interruption


def _settings(options: Options, arguments: list[str], behaviours: Any, config: Any, threads: int) -> dict[str, Any]:
    """What ``dataset.json`` holds: all that decides what the data are, and what its datasheet tells of them."""
    from softgm_bench.config import plain
    from softgm_bench.datasets.writing import FORMAT
    from softgm_bench.episodes.policy import backend_of
    from softgm_bench.storage.versions import versions

    assert options.out is not None
    return {
        "format": FORMAT,
        "name": options.name or Path(options.out).resolve().name,
        "task": config.task.name,
        "policies": [behaviour.about for behaviour in behaviours],
        "transitions": options.transitions,
        "seed": options.seed,
        "deterministic": options.deterministic,
        "horizon": options.horizon or config.task.horizon,
        "batch": options.batch,
        "chunk": options.chunk,
        "device": options.device,
        "backend": backend_of(config),
        "purpose": options.purpose,
        "author": options.author,
        "licence": options.licence,
        "command": shlex.join(["softgm-bench", "dataset", *arguments]),
        "config": plain(config),
        "threads": threads,
        "versions": versions(),
    }


if __name__ == "__main__":
    sys.exit(main())
