"""Evaluate a trained policy: ``softgm-bench evaluate SOURCE key=value ...``.

SOURCE is a run folder (its newest checkpoint), a checkpoint or a policy's file. Settings, with their defaults:

  episodes=100         of which each environment plays one
  seed=0               of targets, obstacles and perturbations; never training's
  deterministic=true   false: actions are sampled, as in training
  horizon=null         control steps of an episode; null: the task's own
  gamma=0.99           of the discounted return
  batch=null           environments at once, to save memory; null: all. Other batches play other episodes
  intervention=none    what the policy is shown in place of what its agents see, on the same scenes: blind, no obstacle;
                       swap_obstacles, another scene's; sensed_only, none from memory; hide_lengths, without their
                       lengths; swap_opening, an oracle is told another scene's opening; forget, a recurrent
                       policy's memory is emptied before every step
  threads=null         null: every core that this process may use
  device=cpu           cpu, cuda or cuda:<index>
  out=null             folder for episodes.csv and summary.json; null: SOURCE/evaluations/... of a run folder,
                       outputs/evaluations/... of a file
  overwrite=false      true: replace the evaluation that out holds

Any other setting changes what the policy acts in:

  task=wall                      any task of conf/task, also one that it was not trained on
  task.n_agents=8                any single setting of the task; rod.<key> and dtype likewise. A list, [4,6,8], shares
                                 the episodes among arms of these numbers of sections
  backend=pyelastica             PyElastica itself moves the arm: slow, float64 alone, pip install '.[pyelastica]';
                                 numba, torch (CPU), cuda and torch (GPU) are the same arm's implementations of ours
  perturbation=noise             none, noise, section_failure or disturbance (conf/perturbation)
  perturbation.tip_force=30      any single setting of it
  randomise=moderate             none, moderate or wide (conf/randomise): an arm of its own for every episode
  randomise.base_radius=[1,1]    any single range of it
"""

import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from softgm_bench import command
from softgm_bench.config import available_threads
from softgm_bench.episodes.protocol import Protocol
from softgm_bench.errors import UserError
from softgm_bench.progress import Progress

if TYPE_CHECKING:
    from softgm_bench.episodes.evaluation import EpisodeRecords
    from softgm_bench.episodes.policy import TrainedPolicy


@dataclass
class Options(Protocol):
    """The command's own settings; meanings above."""

    threads: int | None = None
    device: str = "cpu"
    out: str | None = None
    overwrite: bool = False

    def check(self) -> None:
        """Refuse values that make no sense.

        Raises:
            UserError: naming the first such setting, its value and what would be right.
        """
        super().check()
        if self.threads is not None and not 1 <= self.threads <= available_threads():
            raise UserError(f"threads={self.threads}: choose 1 to {available_threads()}, the cores here, or null")
        if self.out == "":
            raise UserError("out is empty: name a folder for the evaluation")


def main() -> int:
    """Run what the command line says; 0, or 2 after one line about what is wrong."""
    return command.run("evaluate", __doc__, _evaluate)


def _evaluate(arguments: list[str]) -> None:
    source, options, overrides = command.parse(
        arguments, Options, "run folder, checkpoint or policy's file", others=True
    )
    options.check()
    # late: a refused command need not wait for torch
    from softgm_bench.episodes import folder as evaluation_folder
    from softgm_bench.episodes import policy
    from softgm_bench.episodes.summary import table
    from softgm_bench.runs.machine import keep_memory, set_threads

    trained = policy.load(source, options.device, overrides)
    options.check_fits(trained)
    intervention = None if options.intervention == "none" else options.intervention
    unusual = {"horizon": options.horizon, "intervention": intervention, "sampled": not options.deterministic}
    folder = Path(options.out or evaluation_folder.default_folder(source, trained, overrides, options.seed, unusual))
    under = trained.config.perturbation.name
    shown = f", intervention {intervention}" if intervention else ""
    if not trained.config.randomise.nothing:
        shown += f", bodies {trained.config.randomise.name}"
    if policy.backend_of(trained.config) == "pyelastica":
        shown += ", in PyElastica"
    title = f"{trained.label} on {trained.config.task.name}, perturbation {under}{shown}, seed {options.seed}:"
    if not options.overwrite:
        held = evaluation_folder.same(folder, trained, options.episodes, options.describe(trained, overrides))
        if held is not None:
            print(table(held["metrics"], title))
            print(f"evaluated before, in {folder}; overwrite=true plays again")
            return
    evaluation_folder.check(folder, options.overwrite)
    set_threads(options.threads)
    keep_memory()
    began = time.perf_counter()
    records = _play(options, trained)
    seconds = time.perf_counter() - began
    summary = evaluation_folder.describe(trained, records, options.describe(trained, overrides))
    print(table(summary["metrics"], title), flush=True)  # before anything is written: a full disk leaves it
    try:
        evaluation_folder.write(folder, records, summary)
    except OSError as error:
        raise UserError(f"out={folder}: {error.strerror}; the table above is all that there is") from error
    print(f"{seconds:.1f} s; written to {folder}")


def _play(options: Options, trained: "TrainedPolicy") -> "EpisodeRecords":
    from softgm_bench.episodes.evaluation import watched

    parts = math.ceil(options.episodes / (options.batch or options.episodes))
    numbers = len(trained.config.task.n_agents) if trained.config.mixed else 1
    steps = parts * numbers * (options.horizon or trained.config.task.horizon)
    with Progress("evaluating", steps, "steps", at_most=True) as progress:
        return options.play(trained, watched(options.episodes, progress.advance))


if __name__ == "__main__":
    sys.exit(main())
