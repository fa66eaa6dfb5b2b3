"""Parameters of which the quick tier takes some, of products a pairwise cover, and `make test-all` everything."""

from itertools import combinations, product

import pytest


def tiered(*values, quick, name=None):
    """One parameter, or a row of them, of the quick tier or of `make test-all` alone."""
    return pytest.param(*values, id=name, marks=() if quick else pytest.mark.slow)


def pairs_of(row):
    return {(i, row[i], j, row[j]) for i, j in combinations(range(len(row)), 2)}


def cover(rows):
    """A few of the rows, chosen greedily, in which every pair of values occurs that occurs in any row."""
    missing, chosen = set().union(*map(pairs_of, rows)), []
    while missing:
        best = max(rows, key=lambda row: len(pairs_of(row) & missing))
        chosen.append(best)
        missing -= pairs_of(best)
    return chosen


def pairwise(*factors, slow=()):
    """Parameters for the product of the factors; those outside of the cover or with a ``slow`` value are slow."""
    rows = list(product(*factors))
    quick = cover([row for row in rows if not set(row) & set(slow)])
    return [tiered(*row, quick=row in quick) for row in rows]


def partly(values, quick):
    """Parameters for the values, by the names of a mapping if it is one; those but the ``quick`` ones are slow."""
    if isinstance(values, dict):
        return [tiered(value, quick=name in quick, name=name) for name, value in values.items()]
    return [tiered(value, quick=value in quick) for value in values]
