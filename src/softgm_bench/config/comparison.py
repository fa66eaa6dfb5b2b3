"""Comparison of two configurations: would they give the same numbers?"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

# What no number depends on (on threads and recording, only the last bits), or only through other keys that are
# compared.
FREE = (
    "run_dir",
    "overwrite",
    "resume",
    "threads",
    "compile",
    "logger",
    "experiment.checkpoint",
    "recipe",
    "experiment.name",
    "experiment.minutes",
    "task.train_horizon",
    "task.hidden_scene",
)
ABSENT = object()  # the value of a key that one of two configurations does not have


def differences(
    wanted: Mapping[str, Any], held: Mapping[str, Any], also_free: Sequence[str] = ()
) -> dict[str, tuple[Any, Any]]:
    """Both values of every setting that has two, by dotted key, names first, then in alphabetical order.

    Args:
        wanted: plain values, nested.
        held: the same of the configuration to compare with; its values stand second.
        also_free: dotted keys that may differ, beside those in ``FREE``; a group's stands for all in it.
    """
    found = dict(_compare(wanted, held, {*FREE, *also_free}, ""))
    return {key: found[key] for key in sorted(found, key=lambda key: (not key.endswith(".name"), key))}


def as_written(value: Any) -> str:
    """A setting's value as the command line has it; ``null`` where there is none."""
    return "null" if value is None or value is ABSENT else str(value).lower() if isinstance(value, bool) else str(value)


def _compare(
    wanted: Mapping[str, Any], held: Mapping[str, Any], free: set[str], prefix: str
) -> Iterator[tuple[str, tuple[Any, Any]]]:
    for name in wanted.keys() | held.keys():
        key = f"{prefix}{name}"
        ours, theirs = (_comparable(values.get(name, ABSENT)) for values in (wanted, held))
        if key in free:
            continue
        if isinstance(ours, Mapping) or isinstance(theirs, Mapping):
            yield from _compare(_spread(ours, theirs), _spread(theirs, ours), free, f"{key}.")
        elif ours != theirs:
            yield key, (ours, theirs)


def _comparable(value: Any) -> Any:
    """A tuple as the list that it is in YAML."""
    return list(value) if isinstance(value, tuple) else value


def _spread(value: Any, other: Any) -> Mapping[str, Any]:
    """A group; where there is none in its place, such as null for a part that is left out, that for each key."""
    return value if isinstance(value, Mapping) else dict.fromkeys(other, value)
