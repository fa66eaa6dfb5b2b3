"""Shared by the commands beside training: ``SOURCE key=value ...``, and one line for what a user can put right."""

import difflib
import os
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import TypeVar, cast

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from softgm_bench import output, process
from softgm_bench.config import CHANGEABLE, config_directory
from softgm_bench.config.explain import USER_ERRORS, explain
from softgm_bench.config.numbers import check_finite
from softgm_bench.errors import UserError

Options = TypeVar("Options")


def run(name: str, text: str | None, body: Callable[[list[str]], None]) -> int:
    """Call ``body`` with the command line's arguments.

    Args:
        name: of the module under ``softgm_bench``.
        text: of ``--help``.
        body: does the work; raises what ``USER_ERRORS`` lists for what the user can put right.

    Returns:
        The exit status: 0; 2 after one line about what is wrong; 130 when interrupted.
    """
    process.prepare()
    process.quieten()
    with output.unbreakable():
        return _run(name, text, body, sys.argv[1:])


def _run(name: str, text: str | None, body: Callable[[list[str]], None], arguments: list[str]) -> int:
    if {"-h", "--help"} & set(arguments):
        print((text or "").strip().replace("``", ""))
        return 0
    try:
        config_directory()  # refuses a package that was not unpacked
        body(arguments)
    except USER_ERRORS as error:
        if os.environ.get("HYDRA_FULL_ERROR") == "1":
            raise
        print(f"softgm_bench.{name}: {explain(error, arguments)}", file=sys.stderr)
        return 2
    except KeyboardInterrupt as interruption:
        print(f"softgm_bench.{name}: {str(interruption) or 'interrupted'}", file=sys.stderr)
        return 130
    return 0


def parse(
    arguments: list[str], options: type[Options], source: str, *, others: bool = False
) -> tuple[Path, Options, list[str]]:
    """Split a command line.

    Args:
        arguments: one path and settings.
        options: dataclass of the command's own settings, each with a default.
        source: what the path is, for the message when it is missing.
        others: whether settings of a trained policy (``CHANGEABLE``) may be among them.

    Returns:
        The path, the options, and the policy's settings as they were written.

    Raises:
        UserError: no path or several, an unknown setting, a value of the wrong type, or a number that is not finite.
    """
    paths = [argument for argument in arguments if "=" not in argument or Path(argument).exists()]
    if len(paths) != 1 or paths[0].startswith("-"):
        found = f"found {', '.join(paths)}" if paths else "found none"
        raise UserError(f"give one {source}, {found}; settings are written key=value, --help lists them")
    own, rest = split([argument for argument in arguments if argument not in paths], options, others=others)
    return Path(paths[0]), own, rest


def split(arguments: list[str], options: type[Options], *, others: bool = False) -> tuple[Options, list[str]]:
    """Split settings into the command's own and, as they were written, others.

    Args:
        arguments: ``key=value`` each.
        options: dataclass of the command's own settings, each with a default.
        others: whether settings of a trained policy (``CHANGEABLE``) may be among them.

    Raises:
        UserError: an unknown setting, or a value of the wrong type.
    """
    names = [field.name for field in fields(options)]  # type: ignore[arg-type]
    own: list[str] = []
    rest: list[str] = []
    for argument in arguments:
        (own if argument.partition("=")[0] in names else rest).append(argument)
    for key in (setting.partition("=")[0] for setting in rest):
        if not others or key.partition(".")[0] not in CHANGEABLE:
            known = [*names, *(CHANGEABLE if others else ())]
            close = difflib.get_close_matches(key.partition(".")[0], known, n=1)
            advice = f"did you mean {close[0]}?" if close else f"choose from {', '.join(known)}"
            raise UserError(f"{key}: no such setting; {advice}")
    try:
        merged = OmegaConf.merge(OmegaConf.structured(options), OmegaConf.from_dotlist(own))
    except YAMLError as error:
        raise UserError(f"{', '.join(own)}: a value that cannot be read") from error
    except OmegaConfBaseException as error:
        raise UserError(f"{error.full_key}: {str(error).splitlines()[0]}") from error
    check_finite(OmegaConf.to_container(merged))
    return cast(Options, OmegaConf.to_object(merged)), rest
