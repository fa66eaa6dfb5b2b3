"""The command line: ``softgm-bench COMMAND ...``; without a command's name, or as ``train``, a training or a sweep."""

import os
import runpy
import signal
import sys
from types import FrameType
from typing import Any

import hydra
from hydra._internal.utils import get_args_parser
from omegaconf import DictConfig

from softgm_bench import output, process
from softgm_bench.config import composing, config_directory, typed
from softgm_bench.config.explain import USER_ERRORS, explain
from softgm_bench.console import COMMANDS, HELP, VERSION, completions
from softgm_bench.errors import UserError
from softgm_bench.runs import interruption as signals
from softgm_bench.sweeps import cell as sweep_cell
from softgm_bench.sweeps import launch as sweep


def console() -> int:
    """Run ``softgm-bench ...``; without anything, say what it can do."""
    if len(sys.argv) == 1:
        print(HELP, end="")
        return 0
    return main()


def main() -> int:
    """Run what the command line says.

    Returns:
        0 when all went well, 2 after a user's error, 128 + signal when interrupted.
    """
    first, *others = sys.argv[1:] or [""]
    if first in ("-h", "--help", "help") and not others:
        print(HELP, end="")
        return 0
    if first == "--version":
        print(VERSION)
        return 0
    if first in ("-sc", "--shell-completion") and not _complete():
        return 0
    if first in COMMANDS:
        del sys.argv[1]
        if first != "train":
            runpy.run_module(f"softgm_bench.{first}", run_name="__main__", alter_sys=True)
            return 0
    return _train()


def _train() -> int:
    process.prepare()
    process.quieten()
    with output.unbreakable():
        return _main()


def _main() -> int:
    debugging = os.environ.get("HYDRA_FULL_ERROR") == "1"
    os.environ["HYDRA_FULL_ERROR"] = "1"  # let errors through instead of printing and leaving
    try:
        arguments = _arguments()
        if arguments.multirun:
            return _sweep(arguments)
        _run()
    except USER_ERRORS as error:
        if debugging:
            raise
        print(f"softgm_bench: {explain(error, sys.argv[1:])}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interruption:
        print(f"softgm_bench: {str(interruption) or 'interrupted; nothing was saved'}", file=sys.stderr)
        return getattr(interruption, "exit_code", 130)
    return 0


def _complete() -> bool:
    """Answer a shell that completes a command line; tell whether Hydra, which knows the settings, is to go on."""
    line = os.environ.get("COMP_LINE")
    if line is None or not sys.argv[-1].startswith("query="):
        return True  # the shell asks for its script
    words, rest = completions(line)
    print(" ".join(words))
    if rest is not None:
        os.environ["COMP_LINE"] = rest
    return rest is not None


def _hydra(job: Any) -> None:
    hydra.main(version_base="1.3", config_path=str(config_directory()), config_name="config")(job)()


def _run() -> None:
    errors: list[Exception] = []
    began = False

    def job(composed: DictConfig) -> None:
        nonlocal began
        began = True
        try:
            config = typed(composed)
            from softgm_bench.assembly import check  # late: what Hydra refuses or prints need not wait for torch

            check(config)
            from softgm_bench.runs.loop import train

            train(config)
        except USER_ERRORS as error:  # Hydra would print a line of its own
            errors.append(error)

    try:
        _hydra(job)
    except Exception as error:
        if began:
            raise
        with composing():  # what is wrong is the settings
            raise error
    if errors:
        raise errors[0]


def _sweep(arguments: Any) -> int:
    """Launch every cell; 2 if any failed, each of which is then listed."""
    plan = sweep.plan(arguments.overrides, arguments.config_dir)
    options = [argument for argument in sys.argv[1:] if argument not in arguments.overrides]
    sys.argv[1:] = [*options, *plan.overrides]
    received = 0

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal received
        received = number
        raise KeyboardInterrupt

    for number in signals.heeded(signals.STOPPING):
        signal.signal(number, interrupt)
    try:
        with sweep.reported(plan) as outcomes:
            _hydra(sweep_cell.run)
    except USER_ERRORS:
        raise
    except Exception as error:  # a launcher's, such as a worker of its own that was killed
        line = str(error).strip().partition("\n")[0]
        print(f"softgm_bench: the launcher stopped, {type(error).__name__}: {line}", file=sys.stderr)
        print("softgm_bench: the same command resumes what is not done", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interruption:
        interruption.args = ("interrupted; the same command resumes what is not done",)
        interruption.exit_code = 128 + (received or signal.SIGINT)  # type: ignore[attr-defined]
        raise
    return 0 if outcomes.all_well else 2


def _arguments() -> Any:
    arguments, unknown = get_args_parser().parse_known_args()
    if unknown:
        name = unknown[0].lstrip("-").partition("=")[0]
        raise UserError(f"{unknown[0]}: no such option; settings are written without dashes: {name}=value")
    return arguments


if __name__ == "__main__":
    sys.exit(main())
