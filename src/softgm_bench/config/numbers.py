"""Checks of settings that need no key by key: numbers are finite, ranges go upwards."""

import math
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

from omegaconf import DictConfig, OmegaConf

from softgm_bench.errors import UserError

MOST_LAYERS = 1000  # of a network; with many more, building one never ends
INFINITE = "infinite"  # metadata of a field that may be an infinity: what has no limit


def check_finite(values: Any, schema: DictConfig | None = None) -> None:
    """Refuse numbers that are not finite, wherever they stand.

    Args:
        values: nested mappings and lists of plain values.
        schema: structured configuration of the same keys, whose dataclasses may allow infinities (``INFINITE``).

    Raises:
        UserError: naming the first such key and its value.
    """
    for key, value in _numbers(values, ""):
        if not math.isfinite(value) and not (math.isinf(value) and _may_be_infinite(schema, key)):
            raise UserError(f"{key}={value}: it must be a finite number")


def check_ranges(instance: Any, prefix: str = "") -> None:
    """Refuse what is declared as ``tuple[float, float]`` and is no range of a lower and an upper end.

    Raises:
        UserError: naming the first such key, its value and what would be right.
    """
    hints = get_type_hints(type(instance))
    for item in fields(instance):
        key, value = f"{prefix}{item.name}", getattr(instance, item.name)
        if is_dataclass(value):
            check_ranges(value, f"{key}.")
        elif get_origin(hints[item.name]) is tuple and get_args(hints[item.name]) == (float, float):
            if len(value) != 2:
                raise UserError(f"{key}={list(value)}: it must be a range, [low, high]")
            if value[0] > value[1]:
                right = [value[1], value[0]]
                raise UserError(f"{key}={list(value)}: the lower end of a range comes first, as in {key}={right}")


def check_depths(values: Any, prefix: str = "") -> None:
    """Refuse networks of more than ``MOST_LAYERS`` layers, wherever settings count some (``layers``, ``..._layers``).

    Raises:
        UserError: naming the first such key, its value and what would be right.
    """
    for name, value in values.items() if isinstance(values, Mapping) else ():
        key = f"{prefix}{name}"
        if name.endswith("layers") and isinstance(value, int) and value > MOST_LAYERS:
            raise UserError(f"{key}={value}: it must be at most {MOST_LAYERS}")
        check_depths(value, f"{key}.")


def _numbers(values: Any, key: str) -> Iterator[tuple[str, float]]:
    """Every float with its dotted key, a list's under the key of the list."""
    if isinstance(values, Mapping):
        for name, value in values.items():
            yield from _numbers(value, f"{key}.{name}" if key else str(name))
    elif isinstance(values, list | tuple):
        for value in values:
            yield from _numbers(value, key)
    elif isinstance(values, float):
        yield key, values


def _may_be_infinite(schema: DictConfig | None, key: str) -> bool:
    group, _, name = key.rpartition(".")
    node = None if schema is None else OmegaConf.select(schema, group) if group else schema
    cls = None if node is None else OmegaConf.get_type(node)
    if cls is None or not is_dataclass(cls):
        return False
    return any(item.name == name and item.metadata.get(INFINITE, False) for item in fields(cls))
