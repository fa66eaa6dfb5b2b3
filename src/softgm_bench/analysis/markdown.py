"""A report as Markdown, for GitHub; figures are files beside it."""

from softgm_bench.analysis.document import Block, Cell, Document, Figure, Table


def render(document: Document) -> str:
    """The whole page."""
    parts = [f"# {document.title}"]
    for section in document.sections:
        parts += [f"## {section.title}", *(_block(block) for block in section.blocks)]
    return "\n\n".join(parts) + "\n"


def _block(block: Block) -> str:
    match block:
        case Table():
            return _table(block)
        case Figure():
            return f"![{_escape(block.caption)}](figures/{block.key}.svg)\n\n*{_escape(block.caption)}*"
        case _:
            return _escape(block)


def _table(table: Table) -> str:
    names = [f"{column.group}: {column.name}" if column.group else column.name for column in table.columns]
    rows = [
        names,
        ["---:" if column.numeric else "---" for column in table.columns],
        *([_cell(cell) for cell in row] for row in table.rows),
    ]
    lines = ["| " + " | ".join(row) + " |" for row in rows]
    return "\n\n".join([f"**{_escape(table.caption)}**", "\n".join(lines), *map(_escape, table.notes)])


def _cell(cell: Cell) -> str:
    text = _escape(cell.text)
    return f"**{text}**" if cell.strong else f"*{text}*" if cell.muted else text


def _escape(text: str) -> str:
    for character in "\\|*_<":
        text = text.replace(character, "\\" + character)
    return text
