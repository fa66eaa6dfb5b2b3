"""Products of factors of which the quick tier takes a pairwise cover and `make test-all` everything."""

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
