"""A report as Markdown, for GitHub; figures are files beside it."""

import re

from softgm_bench.analysis.document import Cell, Document, Figure, Table, written


def render(document: Document) -> str:
    """Write the whole page."""
    parts = [f"# {document.title}"]
    for title, blocks in document.sections:
        parts += [f"## {title}", *written(blocks, _escape, _table, _figure)]
    return "\n\n".join(parts) + "\n"


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
