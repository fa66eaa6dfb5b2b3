"""A report before it is Markdown, LaTeX or HTML: sections of paragraphs, tables and figures."""

from collections.abc import Callable, Sequence
from itertools import groupby
from typing import NamedTuple


class Cell(NamedTuple):
    """Text of a table's cell in Unicode; each format escapes it.

    Attributes:
        text: what it says.
        strong: the best of its kind.
        muted: not a result of ours: the paper's, or the word that there is none.
    """

    text: str
    strong: bool = False
    muted: bool = False


class Column(NamedTuple):
    """A heading; columns next to each other with the same ``group`` share a heading above their own."""

    name: str
    group: str = ""
    numeric: bool = True


class Table(NamedTuple):
    """``rows`` have one cell for each column; ``key`` names it in links and labels; ``notes`` stand below."""

    key: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    notes: Sequence[str] = ()

    def groups(self) -> list[tuple[str, int]]:
        """Headings above the columns' own and how many columns each spans; empty if no column has one."""
        spans = [(group, len(list(members))) for group, members in groupby(column.group for column in self.columns)]
        return spans if any(group for group, _ in spans) else []


class Figure(NamedTuple):
    """``key`` is also the name of its files; ``svg`` is the picture for a page, ``pdf`` for print."""

    key: str
    caption: str
    svg: str
    pdf: bytes


Block = str | Table | Figure


class Section(NamedTuple):
    """A heading and what stands under it; a string is a paragraph."""

    title: str
    blocks: Sequence[Block]


class Document(NamedTuple):
    """A report's title and its sections."""

    title: str
    sections: Sequence[Section]

    @property
    def figures(self) -> list[Figure]:
        """All figures in order."""
        return [block for section in self.sections for block in section.blocks if isinstance(block, Figure)]

    @property
    def tables(self) -> list[Table]:
        """All tables in order."""
        return [block for section in self.sections for block in section.blocks if isinstance(block, Table)]


def written(blocks: Sequence[Block], *writers: Callable[..., str]) -> list[str]:
    """Each block as one format's writers of a paragraph, a table and a figure, in this order, write its kind."""
    kinds = dict(zip((str, Table, Figure), writers, strict=True))
    return [kinds[type(block)](block) for block in blocks]
