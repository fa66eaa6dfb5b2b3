"""Certification: the search for a sequence of actions that succeeds, in each of a task's held-out scenes."""

from softgm_bench.certification.bench import Bench
from softgm_bench.certification.search import Search

__all__ = ["Bench", "Search"]
