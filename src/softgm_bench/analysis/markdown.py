"""A report as Markdown, for GitHub; figures are files beside it."""

import re
from collections.abc import Mapping
from pathlib import Path

from softgm_bench.analysis.document import Cell, Document, Figure, Table, written
from softgm_bench.analysis.statistics import Array, mcnemar
from softgm_bench.errors import UserError


def render(document: Document) -> str:
    """Write the whole page."""
    parts = [f"# {document.title}"]
    for title, blocks in document.sections:
        parts += [f"## {title}", *written(blocks, _escape, _table, _figure)]
    return "\n\n".join(parts) + "\n"


def refilled(page: Path, text: str, tables: Mapping[str, str]) -> str:
    """Put tables anew into a page's text, each between ``<!-- name -->`` and ``<!-- end -->``.

    Raises:
        UserError: naming the page, if a name does not stand there exactly once.
    """
    for name, lines in tables.items():
        made = f"<!-- {name} -->\n\n{lines}\n\n<!-- end -->"
        literal = made.replace("\\", "\\\\")  # no group of the pattern is meant
        text, count = re.subn(rf"<!-- {name} -->.*?<!-- end -->", literal, text, flags=re.DOTALL)
        if count != 1:
            raise UserError(f"{page}: one place for the table of {name} expected, found {count}")
    return text


def compared(success: Array, usual: Array | None) -> list[str]:
    """Write success, its Wilson interval, scenes lost and won against the usual condition, and McNemar's exact p.

    Args:
        success: of a condition's episodes, 0 or 1, ``(episodes,)``.
        usual: of the same scenes under the usual condition; None, for dashes, where ``success`` is that one.
    """
    from softgm_bench.episodes.summary import wilson_interval  # brings torch along

    low, high = wilson_interval(int(success.sum()), len(success))
    cells = [f"{success.mean():.3f}", f"[{low:.3f}, {high:.3f}]"]
    if usual is None:
        return [*cells, "-", "-"]
    split = mcnemar(usual, success)
    return [*cells, f"{split.lost}, {split.won}", f"{split.p:.1g}"]


def _figure(figure: Figure) -> str:
    return f"![{_escape(figure.caption)}](figures/{figure.key}.svg)\n\n*{_escape(figure.caption)}*"


def _table(table: Table) -> str:
    rows = [
        [f"{column.group}: {column.name}" if column.group else column.name for column in table.columns],
        ["---:" if column.numeric else "---" for column in table.columns],
        *(map(_cell, row) for row in table.rows),
    ]
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n\n".join([f"**{_escape(table.caption)}**", "\n".join(lines), *map(_escape, table.notes)])


def _cell(cell: Cell) -> str:
    mark = "**" if cell.strong else "*" if cell.muted else ""
    return f"{mark}{_escape(cell.text)}{mark}"


def _escape(text: str) -> str:
    return re.sub(r"([\\|*_<])", r"\\\1", text)
