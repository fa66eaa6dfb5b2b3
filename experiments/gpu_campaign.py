"""Use a machine with a GPU for so many minutes, whole: benchmark, GPU tests, then cells of a grid, kept as they finish.

``python experiments/gpu_campaign.py --minutes 10 --out FOLDER [key=value ...]``, from the top of the repository; it
needs no network and no installed package, only ``PYTHONPATH=src``. FOLDER receives at most six archives of less than
15 MB: ``pack-0.tar.gz`` with ``log.txt``, the benchmark and the tests' output, the others with the runs. They are
whole at any moment, whatever happens to this process. Unpack each with ``tar xzf``;
``python -m softgm_bench.report`` reads the folder. A further campaign skips what ``--done`` holds.

Settings ``key=value`` choose the cells as in a sweep (``algo=softgm,mappo seed=0,1``), or change the grid's.
"""

import argparse
import ctypes
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path
from types import FrameType

from softgm_bench.config import available_threads, compose
from softgm_bench.config.explain import USER_ERRORS, explain
from softgm_bench.runs.interruption import STOPPING, heeded
from softgm_bench.storage.versions import versions
from softgm_bench.sweeps import campaign, devices
from softgm_bench.sweeps.packing import Pack, piece

ROOT = Path(__file__).parents[1]
CELLS = ("algo=softgm,mappo,masac", "task=basic,wall", "seed=0")  # without a grid or settings
RESERVE = 15.0  # seconds at the end, to stop trainings and to write
BENCHMARK_SHARE, BENCHMARK_SECONDS = 0.2, 120.0  # of the minutes, and at most
TESTS_SECONDS = 180.0
DEATH_SIGNAL = 1  # prctl's PR_SET_PDEATHSIG
LOG, BENCHMARK, RATES, TESTS = "log.txt", "benchmark.txt", "gpu.json", "gpu_tests.txt"


class Log:
    """Lines with the seconds since the beginning, on the screen, in a file and, when one was added, in the pack."""

    def __init__(self, work: Path, pack: Pack, began: float) -> None:
        """Go on at the end of an earlier log; ``began`` is on the clock of ``time.monotonic``."""
        self._work, self._pack, self._began = work, pack, began

    def __call__(self, line: str) -> None:
        """Add a line; a full disk does not end the campaign."""
        text = f"{time.monotonic() - self._began:7.1f} s  {line}"
        print(text, flush=True)
        with suppress(OSError):
            with (self._work / LOG).open("a") as file:
                file.write(text + "\n")
            self._pack.put(piece({name: self._work / name for name in (LOG, BENCHMARK, RATES, TESTS)}))


def main() -> int:
    """Do it; 0, 2 if the settings make no sense, 128 plus its number after a signal."""
    options = arguments()
    began = time.monotonic()
    end = began + 60.0 * options.minutes - options.reserve
    for number in heeded(STOPPING):
        signal.signal(number, interrupt)
    try:
        overrides = [*options.first, *([f"+grids={options.grid}"] if options.grid else []), *options.settings]
        done = [name for folder in options.done for name in campaign.finished(folder)]
        cells = campaign.planned(overrides, done)
        for settings in cells.values():
            compose(settings)
    except USER_ERRORS as error:
        print(f"gpu_campaign: {explain(error, overrides)}", file=sys.stderr)
        return 2
    if any(options.out.glob("pack-*.tar.gz")) and not (options.work / LOG).exists():
        print(f"gpu_campaign: --out {options.out} holds another campaign's archives: choose another", file=sys.stderr)
        return 2
    options.work.mkdir(parents=True, exist_ok=True)
    pack = Pack(options.out)
    say = Log(options.work, pack, began)
    say(f"{options.minutes:g} minutes, {options.jobs} cells at once of {len(cells)}; done before: {len(done)}")
    describe_machine(say)
    background: list[subprocess.Popen] = []
    try:
        if not options.only_cells:
            benchmark(options, say)
            background.append(start_tests(options))
        work = campaign.Campaign(cells, options.work / "runs", end, options.jobs, options.least, options.start_up)
        campaign.run(work, pack, say)
    except KeyboardInterrupt as stopped:
        say("interrupted")
        return 128 + (stopped.args[0] if stopped.args else signal.SIGINT)
    finally:
        finish_tests(background, end, say)
        say("over")
    return 0


def arguments() -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, required=True, help="of the machine; all is over by then")
    parser.add_argument("--out", type=Path, required=True, help="folder of the archives")
    parser.add_argument("--work", type=Path, help="folder of the runs; by default outputs/gpu_campaign/<OUT's name>")
    parser.add_argument("--grid", help="name of a grid in conf/grids")
    parser.add_argument("--jobs", type=int, default=3, help="cells at once on each GPU")
    parser.add_argument("--done", type=Path, nargs="*", default=[], help="folders whose finished cells are left out")
    parser.add_argument("--device", default="cuda", help="cpu: a rehearsal")
    parser.add_argument("--only-cells", action="store_true", help="neither benchmark nor tests")
    parser.add_argument("--least", type=float, default=campaign.LEAST_MINUTES, help="minutes that a cell is begun for")
    parser.add_argument(
        "--start-up", type=float, default=campaign.START_UP, help="seconds of a cell beside its minutes"
    )
    parser.add_argument("--reserve", type=float, default=RESERVE, help="seconds at the end, to stop and to write")
    parser.add_argument("settings", nargs="*", help="key=value")
    options = parser.parse_args()
    if options.minutes <= 0 or options.jobs < 1:
        parser.error("minutes must be above 0 and jobs at least 1")
    options.work = options.work or Path("outputs/gpu_campaign") / options.out.name
    options.first = ["experiment=gpu", f"device={options.device}"]
    if not options.grid and not any(one.partition("=")[0] in ("algo", "task") for one in options.settings):
        options.settings = [*CELLS, *options.settings]
    if options.device == "cuda" and len(found := devices.gpus()) > 1:
        os.environ[devices.GPUS] = ",".join(found)
        options.jobs *= len(found)
    options.jobs = min(options.jobs, available_threads())
    return options


def describe_machine(say: campaign.Say) -> None:
    """Log versions and GPUs."""
    say("versions: " + ", ".join(f"{name} {version}" for name, version in versions().items()))
    say(f"{available_threads()} cores; CUDA_VISIBLE_DEVICES={os.environ.get(devices.VISIBLE)}")
    query = ["nvidia-smi", "--query-gpu=name,driver_version,memory.total,compute_mode", "--format=csv,noheader"]
    try:
        found = subprocess.run(query, capture_output=True, text=True, timeout=30, check=False)
        for line in (found.stdout or found.stderr).splitlines():
            say(f"nvidia-smi: {line}")
    except (OSError, subprocess.TimeoutExpired) as error:
        say(f"nvidia-smi: {type(error).__name__}")


def benchmark(options: argparse.Namespace, say: campaign.Say) -> None:
    """Run the short benchmark alone, as long as it may."""
    limit = min(BENCHMARK_SECONDS, BENCHMARK_SHARE * 60.0 * options.minutes)
    script = [ROOT / "benchmarks" / "bench_gpu.py", "--short", "--device", options.device]
    command = [sys.executable, *map(str, script), "--output", str(options.work / RATES)]
    if options.device == "cpu":
        command += ["--batches", "4", "--repetitions", "1"]
    began = time.monotonic()
    child = start(command, options.work / BENCHMARK)
    try:
        status = f"exit status {child.wait(limit)}"
    except subprocess.TimeoutExpired:
        status = "stopped, its time was up"
    finally:
        stop_group(child)
    say(f"benchmark: {status} after {time.monotonic() - began:.0f} s")


def start_tests(options: argparse.Namespace) -> subprocess.Popen:
    """Start the tests that are marked for GPUs, which go on beside the cells."""
    files = sorted(str(path) for path in (ROOT / "tests").rglob("test_*.py") if "pytest.mark.gpu" in path.read_text())
    command = [sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-m", "gpu", "--durations=0", *files]
    return start(["timeout", f"{TESTS_SECONDS:.0f}", *command], options.work / TESTS)


def finish_tests(children: list[subprocess.Popen], end: float, say: campaign.Say) -> None:
    """Wait for the tests as long as there is time, then stop them."""
    for child in children:
        with suppress(subprocess.TimeoutExpired, KeyboardInterrupt):
            child.wait(max(0.0, end - time.monotonic()))
        status = "stopped, the time was up" if child.poll() is None else f"exit status {child.returncode}"
        stop_group(child)
        say(f"GPU tests: {status}")


def start(command: list[str], output: Path) -> subprocess.Popen:
    """Start a process that dies with this one; what it prints goes to a file."""

    def die_with_parent() -> None:
        if sys.platform == "linux":
            ctypes.CDLL(None).prctl(DEATH_SIGNAL, signal.SIGKILL)

    with output.open("wb") as file:
        return subprocess.Popen(
            command, stdout=file, stderr=subprocess.STDOUT, cwd=ROOT, start_new_session=True, preexec_fn=die_with_parent
        )


def stop_group(child: subprocess.Popen) -> None:
    """Stop a process and those that it has started."""
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(child.pid, number)
        with suppress(subprocess.TimeoutExpired):
            child.wait(5.0)


def interrupt(number: int, frame: FrameType | None) -> None:
    """Stop as on Ctrl-C."""
    raise KeyboardInterrupt(number)


if __name__ == "__main__":
    sys.exit(main())
