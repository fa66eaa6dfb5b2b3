"""Compiled functions reach the compiled functions that call them through this module."""

from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any


def with_callees(function: Callable[..., Any], callees: Mapping[str, Callable[..., Any]]) -> Callable[..., Any]:
    """Return a copy of a Python function that finds ``callees`` by name among its globals.

    Numba finds machine code on disk by a function's source and its closure, in which another compiled function has no
    stable identity; among the globals it does no harm.
    """
    if not callees:
        return function
    namespace = {**function.__globals__, **callees}
    bound = FunctionType(function.__code__, namespace, function.__name__, None, function.__closure__)
    bound.__qualname__ = function.__qualname__
    bound.__module__ = function.__module__
    bound.__doc__ = function.__doc__
    return bound
