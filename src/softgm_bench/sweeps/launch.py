"""A sweep seen from its command: which launcher with how many threads, what became of each job, which cells it has."""

import json
import os
import shutil
import sys
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.util import find_spec
from itertools import product
from math import prod
from pathlib import Path
from typing import Any
from uuid import uuid4

from hydra import compose, initialize_config_dir
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.plugins import Plugins
from omegaconf import DictConfig

from softgm_bench.config import available_threads, composing, config_directory
from softgm_bench.errors import UserError
from softgm_bench.sweeps import cell as sweep_cell
from softgm_bench.sweeps import devices

JOBLIB, LOCAL, SLURM, RAY = "joblib", "submitit_local", "submitit_slurm", "ray"
EXTRAS = {JOBLIB: "sweeps", LOCAL: "slurm", SLURM: "slurm", RAY: "ray"}
POLL = 0.5  # seconds between looks for outcomes


@dataclass(frozen=True)
class Cell:
    """One job of a grid: the settings that it differs from others by, and its run folder."""

    overrides: tuple[str, ...]
    run_dir: Path


@dataclass
class Plan:
    """The settings that complete a sweep's command line.

    Attributes:
        overrides: the user's, then ours: launcher, jobs at once, threads, where outcomes go.
        records: folder of the outcomes, absolute.
        jobs: number of cells.
    """

    overrides: list[str]
    records: Path
    jobs: int


@dataclass
class Outcomes:
    """Outcomes that have been printed, by job number, and how many jobs there are."""

    jobs: int
    seen: dict[int, dict[str, Any]] = field(default_factory=dict)

    @property
    def failed(self) -> list[dict[str, Any]]:
        """In the order of the jobs."""
        return [self.seen[number] for number in sorted(self.seen) if self.seen[number]["outcome"] == sweep_cell.FAILED]

    @property
    def all_well(self) -> bool:
        """Tell whether every job has ended and none failed; a full disk can keep one from saying so."""
        return len(self.seen) == self.jobs and not self.failed


def plan(overrides: Sequence[str], directory: str | None = None) -> Plan:
    """Bound jobs at once times threads by the cores, and say where outcomes go.

    Args:
        overrides: of the command line, sweeps among them.
        directory: further one with YAML files (``--config-dir``).

    Raises:
        UserError: the launcher is not installed, or would use more cores than there are.
        HydraException, OmegaConfBaseException: settings that cannot be composed.
    """
    given = list(overrides)
    chosen = next((one.partition("=")[2] for one in reversed(given) if one.startswith("hydra/launcher=")), None)
    if chosen in EXTRAS and not installed(chosen):
        raise UserError(f"hydra/launcher={chosen}: not installed; pip install '.[{EXTRAS[chosen]}]'")
    if chosen is None and installed(JOBLIB):
        given.append(f"hydra/launcher={JOBLIB}")
        chosen = JOBLIB
    base = _compose(_first_values(given), directory)
    threads = _swept_threads(given) or base.threads
    records = Path(base.hydra.sweep.dir).resolve() / f".sweep-{uuid4().hex[:12]}"
    environment: dict[str, object] = {
        sweep_cell.RECORDS: records,
        sweep_cell.CWD: Path.cwd(),
        sweep_cell.MAIN: os.getpid(),
    }
    if base.device == "cuda" and chosen in (None, "basic", JOBLIB, LOCAL) and len(found := devices.gpus()) > 1:
        environment[devices.GPUS] = ",".join(found)  # queues give a job its own
    own = _bounds(chosen or "basic", base, threads, given)
    own += [f"+hydra.job.env_set.{name}={_quoted(str(value))}" for name, value in environment.items()]
    return Plan(given + own, records, prod(map(len, _choices(base, overrides))))


def installed(launcher: str) -> bool:
    """Tell whether Hydra's plug-in of that name can be imported."""
    package = "submitit" if launcher.startswith("submitit") else launcher
    try:
        return find_spec(f"hydra_plugins.hydra_{package}_launcher") is not None
    except ModuleNotFoundError:  # no plug-in at all
        return False


def cells(overrides: Sequence[str]) -> tuple[list[Cell], Path]:
    """The cells of a sweep in the order of its jobs, and the folder that all of it lies in.

    Cells that differ in nothing but their seed are composed once.
    """
    base = _compose(_first_values(overrides))
    known: dict[tuple[str, ...], DictConfig] = {}
    found = []
    for cell in product(*_choices(base, overrides)):
        others = tuple(text for text in cell if not text.startswith("seed="))
        if others not in known:
            known[others] = _compose(others)
        config = known[others].copy()
        for text in set(cell) - set(others):
            config.seed = int(text.partition("=")[2])
        found.append(Cell(cell, Path(config.run_dir)))
    return found, Path(base.hydra.sweep.dir)


@contextmanager
def reported(plan: Plan) -> Iterator[Outcomes]:
    """While jobs run, print a line for each that has come to an end; whatever process it was in."""
    records = plan.records
    records.mkdir(parents=True, exist_ok=True)
    outcomes, stop = Outcomes(plan.jobs), threading.Event()
    print(f"{plan.jobs} cells; softgm-bench status {_shown(records.parent)} tells of each", file=sys.stderr, flush=True)

    def watch() -> None:
        while not stop.wait(POLL):
            _print_new(records, outcomes)

    thread = threading.Thread(target=watch, daemon=True)
    thread.start()
    try:
        yield outcomes
    finally:
        stop.set()
        thread.join()
        _print_new(records, outcomes)
        shutil.rmtree(records, ignore_errors=True)
        _print_failures(outcomes)


def _shown(folder: Path) -> str:
    """A folder as one would write it here."""
    return os.path.relpath(folder) if folder.is_relative_to(Path.cwd()) else str(folder)


def _print_new(records: Path, outcomes: Outcomes) -> None:
    for path in sorted(records.glob("[0-9]*.json")):
        if int(path.stem) not in outcomes.seen:
            record = outcomes.seen[int(path.stem)] = json.loads(path.read_text())
            count = f"[{len(outcomes.seen)} of {outcomes.jobs}]"
            print(f"{count} {_name(record)}: {record['outcome']}, {record['line']}", flush=True)


def _print_failures(outcomes: Outcomes) -> None:
    if outcomes.failed:
        print(f"softgm_bench: {len(outcomes.failed)} of {outcomes.jobs} cells failed:", file=sys.stderr)
        for record in outcomes.failed:
            print(f"  {_name(record)}: {record['line']}", file=sys.stderr)
    if missing := outcomes.jobs - len(outcomes.seen):
        print(f"softgm_bench: {missing} of {outcomes.jobs} cells did not come to an end", file=sys.stderr)


def _name(record: dict[str, Any]) -> str:
    return record["run_dir"] or " ".join(record["overrides"])


def _bounds(launcher: str, base: DictConfig, threads: int | None, given: Sequence[str]) -> list[str]:
    """Settings of a launcher by which the jobs at once use as many cores as there are, at most."""
    cores = available_threads()
    if launcher == "basic":  # one after another
        return []
    if launcher == JOBLIB:
        jobs = base.hydra.launcher.n_jobs if _given(given, "hydra.launcher.n_jobs") else max(1, cores // (threads or 1))
        jobs = cores if jobs < 0 else jobs
        threads = threads or max(1, cores // jobs)
        if jobs * threads > cores:
            raise UserError(f"hydra.launcher.n_jobs={jobs} with threads={threads}: this machine has {cores} cores")
        own = [
            f"hydra.launcher.n_jobs={jobs}",
            "hydra.launcher.batch_size=1",
        ]  # or jobs would wait in one worker's queue
    elif launcher == RAY:
        threads = threads or 1
        own = [f"+hydra.launcher.ray.remote.num_cpus={threads}"]
        if not _given(given, "hydra.launcher.ray.init.address"):  # a cluster that is running knows its own
            own.append(f"+hydra.launcher.ray.init.num_cpus={cores}")
    elif launcher in (LOCAL, SLURM):
        threads = threads or base.hydra.launcher.cpus_per_task or 1
        own = [f"hydra.launcher.cpus_per_task={threads}"]
        if launcher == LOCAL:  # which would start all at once
            own.append(f"hydra.sweeper.max_batch_size={max(1, cores // threads)}")
    else:
        return []
    own = [one for one in own if not _given(given, one.lstrip("+").partition("=")[0])]
    return own + ([] if base.threads or _swept_threads(given) else [f"threads={threads}"])


def _given(overrides: Sequence[str], key: str) -> bool:
    return any(one.lstrip("+").partition("=")[0] == key for one in overrides)


def _swept_threads(overrides: Sequence[str]) -> int | None:
    """The most threads of any job, if the command line says so."""
    values = [one.partition("=")[2] for one in overrides if one.startswith("threads=")]
    counts = [int(text) for text in ",".join(values).split(",") if text.isdecimal()]
    return max(counts, default=None)


def _compose(overrides: Sequence[str], directory: str | None = None) -> DictConfig:
    """Configuration with Hydra's own part."""
    searched = [f"hydra.searchpath=[{_quoted('file://' + os.path.abspath(directory))}]"] if directory else []
    with initialize_config_dir(version_base="1.3", config_dir=str(config_directory())), composing():
        return compose("config", [*overrides, *searched], return_hydra_config=True)


def _parse(overrides: Sequence[str]) -> list[Override]:
    Plugins.instance()  # the parser asks for it
    with initialize_config_dir(version_base="1.3", config_dir=str(config_directory())):
        loader = GlobalHydra.instance().config_loader()  # knows what glob(...) finds
        return OverridesParser.create(loader).parse_overrides(list(overrides))


def _first_values(overrides: Sequence[str]) -> list[str]:
    """The first job's settings."""
    return [
        _values(parsed)[0] if parsed.is_sweep_override() else text
        for text, parsed in zip(overrides, _parse(overrides), strict=True)
    ]


def _choices(base: DictConfig, overrides: Sequence[str]) -> list[list[str]]:
    """For each key the settings that cells have of it, a grid's first; a later one replaces an earlier, as in Hydra."""
    params = base.hydra.sweeper.get("params") or {}
    parsed = _parse([*(f"{key}={value}" for key, value in params.items()), *overrides])
    by_key = {one.get_key_element(): one for one in parsed}
    return [_values(one) for key, one in by_key.items() if not key.startswith("hydra")]


def _values(override: Override) -> list[str]:
    """The settings that an override stands for, one a job."""
    key = override.get_key_element()
    if not override.is_sweep_override():
        return [f"{key}={override.get_value_element_as_str()}"]
    if not override.is_discrete_sweep():
        raise UserError(f"{override.input_line}: not a list of values")
    values = [f"{key}={value}" for value in override.sweep_string_iterator()]
    if not values:
        raise UserError(f"{override.input_line}: nothing in conf/{key} fits it")
    return values


def _quoted(text: str) -> str:
    return "'" + text.replace("\\", "\\\\").replace("'", "\\'") + "'"
