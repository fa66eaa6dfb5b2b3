"""Parameters of which the quick tier takes some, of products a pairwise cover, and `make test-all` everything."""

from itertools import combinations, product

import pytest


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
    return [pytest.param(*row, marks=() if row in quick else pytest.mark.slow) for row in rows]


def partly(values, quick):
    """Parameters for the values, by the names of a mapping if it is one; those but the ``quick`` ones are slow."""
    named = values.items() if isinstance(values, dict) else [(None, value) for value in values]
    marks = [() if (value if name is None else name) in quick else pytest.mark.slow for name, value in named]
    return [pytest.param(value, id=name, marks=mark) for (name, value), mark in zip(named, marks, strict=True)]
