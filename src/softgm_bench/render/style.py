"""Colours and sizes of everything that is drawn."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

# sRGB, as in a stylesheet
ARM = ("#6b2447", "#a53a4c", "#dd6a4b", "#f0a06b")  # from the base to the tip
RING = "#fff1dd"  # control points
TIP = "#fff6e8"
TOUCH = "#fff3b0"  # nodes in contact
COLUMN = "#8fa3b7"
DISCOVERED = "#1f9a93"
NEW = "#7fe0cf"  # discovered a moment ago
TARGET = "#f2a900"
REACHED = "#38a169"
ATTENTION = "#6a4fd0"
PATH = ("#d9cbc4", "#b79aa0", "#7d4560")  # of the tip, from the beginning to now
PEDESTAL = "#57606b"

RING_WIDTH = 0.008  # m
GAP = 0.002  # m, between bins
TEXELS = 512


def linear(colour: str) -> Array:
    """``#rrggbb`` as linear red, green and blue from 0 to 1, ``(3,)``."""
    value = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def gradient(colours: tuple[str, ...], place: Array) -> Array:
    """Linear colours ``(n, 3)`` at places from 0 to 1, between equally spaced ones."""
    stops = np.stack([linear(colour) for colour in colours])
    at = np.linspace(0.0, 1.0, len(colours))
    return np.stack([np.interp(place, at, stops[:, i]) for i in range(3)], axis=-1)


def mix(base: Array, colour: Array, part: Array | float) -> Array:
    """``base`` (n, 3) with a part (n,) of another colour."""
    part = np.asarray(part, dtype=np.float64)[..., None]
    return base + part * (colour - base)
