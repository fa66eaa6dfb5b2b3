"""Lists of the round cones that can matter per cell of a regular grid; compiled functions.

They serve three questions: what a pixel's ray may hit (tiles of the image), what may shade a point (cells of the plane
across the light), and what is near a point (cells in space).
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from softgm_bench.render.geometry import jit


class Grid(NamedTuple):
    """Lists of round cones; cell (i, j, k) has the number ``(k * shape[1] + j) * shape[0] + i``."""

    origin: NDArray[np.float64]  # of cell (0, 0, 0), (3,)
    cell: float  # edge of a cell
    shape: NDArray[np.int64]  # cells along each axis, (3,)
    first: NDArray[np.int64]  # index in items at which each cell's list begins, (cells + 1,)
    items: NDArray[np.int64]  # numbers of round cones, ascending within a cell


def make_grid(low: NDArray[Any], high: NDArray[Any], cell: float, bounds: tuple[Any, Any] | None = None) -> Grid:
    """Sort boxes between corners ``low`` and ``high``, ``(n, 3)``, into the lists of all cells that they meet.

    The edge ``cell`` is enlarged where more than about a million cells would be needed. Boxes are cut at ``bounds``,
    the lower and upper corner of what the grid has to cover; by default it covers all of them.
    """
    lowest, highest = (low.min(axis=0), high.max(axis=0)) if bounds is None else bounds
    origin = np.asarray(lowest, dtype=np.float64)
    extent = np.maximum(np.asarray(highest, dtype=np.float64) - origin, 0.0)
    while np.prod(np.floor(extent / cell) + 1.0) > 1e6:
        cell *= 2.0
    shape = (np.floor(extent / cell) + 1.0).astype(np.int64)
    inside = np.all((high >= origin) & (low <= origin + extent), axis=1)
    first_cell = np.clip(np.floor((low - origin) / cell), 0, shape - 1).astype(np.int64)
    last_cell = np.clip(np.floor((high - origin) / cell), 0, shape - 1).astype(np.int64)
    last_cell[~inside] = first_cell[~inside] - 1
    first, items = _sort(first_cell, last_cell, shape)
    return Grid(origin, float(cell), shape, first, items)


@jit
def _sort(first_cell, last_cell, shape):
    """Counting sort of index boxes, both corners ``(n, 3)`` inclusive, into the grid's lists."""
    first = np.zeros(shape[0] * shape[1] * shape[2] + 1, np.int64)
    for write in range(2):
        if write:
            total = 0
            for cell in range(first.size):
                count = first[cell]
                first[cell] = total
                total += count
            items = np.empty(total, np.int64)
            free = first.copy()
        for n in range(len(first_cell)):
            for k in range(first_cell[n, 2], last_cell[n, 2] + 1):
                for j in range(first_cell[n, 1], last_cell[n, 1] + 1):
                    for i in range(first_cell[n, 0], last_cell[n, 0] + 1):
                        cell = (k * shape[1] + j) * shape[0] + i
                        if write:
                            items[free[cell]] = n
                            free[cell] += 1
                        else:
                            first[cell] += 1
    return first, items


@jit
def cell_of(grid, x, y, z):
    """Number of the cell that holds a point, -1 outside of the grid."""
    i = int(np.floor((x - grid.origin[0]) / grid.cell))
    j = int(np.floor((y - grid.origin[1]) / grid.cell))
    k = int(np.floor((z - grid.origin[2]) / grid.cell))
    shape = grid.shape
    if i < 0 or j < 0 or k < 0 or i >= shape[0] or j >= shape[1] or k >= shape[2]:
        return -1
    return (k * shape[1] + j) * shape[0] + i
