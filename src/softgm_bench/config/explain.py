"""One line for every error that a user can put right: what is wrong, where, and what would be right."""

import difflib
import re
from collections.abc import Iterator

from hydra.errors import HydraException, MissingConfigException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

from softgm_bench.config.composition import compose_untyped
from softgm_bench.errors import UserError

USER_ERRORS = (UserError, HydraException, OmegaConfBaseException, OSError)


def explain(error: Exception, overrides: list[str]) -> str:
    """One line for an error of a type in ``USER_ERRORS``; ``overrides`` is the command line that led to it."""
    if isinstance(error, UserError):
        return _first_line(error)  # whatever is behind it
    if isinstance(error, MissingConfigException) and error.options is not None:
        group, _, name = str(error.missing_cfg_file).rpartition("/")
        return f"{group}={name}: no such {group}; choose one of {', '.join(sorted(error.options))}"
    cause = _omegaconf_error(error)
    if isinstance(cause, ConfigKeyError | ConfigAttributeError):
        return f"{cause.full_key}: no such key; {_nearest(str(cause.full_key), overrides)}"
    if cause is not None:
        return f"{cause.full_key}: {_first_line(cause)}" if cause.full_key else _first_line(cause)
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename}: {error.strerror}" if error.filename else error.strerror
    if ambiguous := re.match(r"Ambiguous value for argument '(([^'=]*)=([^']*))'", _first_line(error)):
        setting, key, values = ambiguous.groups()
        return f"{setting}: several values; add -m for a sweep, a run for each, or write a list as {key}=[{values}]"
    if type(error).__name__ == "OverrideParseException":
        return f"{_first_line(error)}: settings are written key=value"
    return _first_line(error)


def _omegaconf_error(error: BaseException) -> OmegaConfBaseException | None:
    """The OmegaConf error at or behind ``error``; it knows the key."""
    current: BaseException | None = error
    while current is not None and not isinstance(current, OmegaConfBaseException):
        current = current.__cause__
    return current


def _first_line(error: Exception) -> str:
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def _nearest(key: str, overrides: list[str]) -> str:
    """Advice that names the valid key most like a misspelt one."""
    keys = [known for known in _valid_keys(overrides) if known != key]
    close = difflib.get_close_matches(key, keys, n=1)
    if not close:
        names = {known.rpartition(".")[2]: known for known in keys}
        close = [names[name] for name in difflib.get_close_matches(key.rpartition(".")[2], names, n=1)]
    return f"did you mean {close[0]}?" if close else "--cfg job lists every key"


def _valid_keys(overrides: list[str]) -> Iterator[str]:
    """Every key of the configuration that the chosen groups make up, dotted."""
    groups = r"(task|algo|model|recipe|experiment|rod|perturbation|randomise|logger)=\w+"
    choices = [override for override in overrides if re.fullmatch(groups, override)]
    try:
        config = compose_untyped(choices)
    except (HydraException, OmegaConfBaseException):
        config = compose_untyped([])
    yield from _dotted(config, "")


def _dotted(node: DictConfig, prefix: str) -> Iterator[str]:
    for name in map(str, node):
        yield prefix + name
        child = OmegaConf.select(node, name)
        if isinstance(child, DictConfig):
            yield from _dotted(child, f"{prefix}{name}.")
