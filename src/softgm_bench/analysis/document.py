"""What a report is made of, before it is Markdown, LaTeX or HTML: sections of paragraphs, tables and figures."""

from collections.abc import Sequence
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Cell:
    """Text of a table's cell in Unicode; each format escapes it.

    Attributes:
        text: what it says.
        strong: the best of its kind.
        muted: not a result of ours: the paper's, or the word that there is none.
    """

    text: str
    strong: bool = False
    muted: bool = False


MISSING = Cell("not run", muted=True)


@dataclass(frozen=True)
class Column:
    """A table's column; columns next to each other with the same ``group`` share a heading above their own."""

    name: str
    group: str = ""
    numeric: bool = True


@dataclass(frozen=True)
class Table:
    """``rows`` have one cell for each column; ``key`` names it in links and labels; ``notes`` stand below."""

    key: str
    caption: str
    columns: Sequence[Column]
    rows: Sequence[Sequence[Cell]]
    notes: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Refuse rows that do not fit the columns."""
        assert all(len(row) == len(self.columns) for row in self.rows), self.key


@dataclass(frozen=True)
class Figure:
    """``key`` is also the name of its files; ``svg`` is the picture for a page, ``pdf`` for print."""

    key: str
    caption: str
    svg: str
    pdf: bytes


Block = str | Table | Figure


@dataclass(frozen=True)
class Section:
    """A heading and what stands under it; a string is a paragraph."""

    title: str
    blocks: Sequence[Block] = field(default_factory=list)


@dataclass(frozen=True)
class Document:
    """A report."""

    title: str
    sections: Sequence[Section]

    @property
    def figures(self) -> list[Figure]:
        """All figures in order."""
        return [block for section in self.sections for block in section.blocks if isinstance(block, Figure)]
