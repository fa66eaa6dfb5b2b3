"""A report as one HTML page that needs no other file: styles and pictures are inside, light or dark as it is read."""

import re
from html import escape
from pathlib import Path

from softgm_bench.analysis.document import Cell, Document, Figure, Section, Table, written
from softgm_bench.analysis.style import GRID, INK, PAPER, SOFT


def render(document: Document) -> str:
    """Write the whole page."""
    css = Path(__file__).with_name("page.css").read_text()
    links = "".join(f'<a href="#{_anchor(section)}">{escape(section.title)}</a>' for section in document.sections)
    body = "\n".join(_section(section) for section in document.sections)
    return f"""<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<link rel="icon" href="data:,">
<title>{escape(document.title)}</title>
<style>
{css}</style>
</head>
<body>
<main>
<h1>{escape(document.title)}</h1>
<nav>{links}</nav>
{body}
</main>
</body>
</html>
"""


def _section(section: Section) -> str:
    blocks = "\n".join(written(section.blocks, _paragraph, _table, _figure))
    return f'<section>\n<h2 id="{_anchor(section)}">{escape(section.title)}</h2>\n{blocks}\n</section>'


def _anchor(section: Section) -> str:
    return re.sub(r"\W+", "-", section.title.lower()).strip("-")


def _paragraph(text: str) -> str:
    return f"<p>{escape(text)}</p>"


def _figure(figure: Figure) -> str:
    caption = f"<figcaption>{escape(figure.caption)}</figcaption>"
    return f'<figure class="picture" id="figure-{figure.key}">\n{themed(figure)}\n{caption}\n</figure>'


def themed(figure: Figure) -> str:
    """Prepare a figure's SVG for a page: text, lines and ground in the page's colours, names of the figure's own."""
    svg = figure.svg[figure.svg.index("<svg") :].strip()
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg, flags=re.DOTALL)
    width = float(re.search(r'width="([0-9.]+)pt"', svg)[1])  # type: ignore[index]
    svg = re.sub(r' (width|height)="[0-9.]+pt"', "", svg, count=2)
    for name, colour in ((INK, "currentColor"), (SOFT, "var(--soft)"), (GRID, "var(--grid)"), (PAPER, "var(--card)")):
        svg = svg.replace(name, colour)
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{figure.key}-", svg)
    attributes = f'role="img" aria-label="{escape(figure.caption)}" style="max-width: {1.6 * width:.0f}px"'
    return svg.replace("<svg ", f"<svg {attributes} ", 1)


def _table(table: Table) -> str:
    numeric = [column.numeric for column in table.columns]
    rows = "\n".join(f"<tr>{''.join(map(_cell, row, numeric))}</tr>" for row in table.rows)
    notes = "".join(f'\n<p class="note">{escape(note)}</p>' for note in table.notes)
    return f"""<figure class="table" id="table-{table.key}">
<figcaption>{escape(table.caption)}</figcaption>
<div class="scroll">
<table>
<thead>
{_headings(table)}
</thead>
<tbody>
{rows}
</tbody>
</table>
</div>{notes}
</figure>"""


def _headings(table: Table) -> str:
    names = "".join(f"<th{_classes(numeric=column.numeric)}>{escape(column.name)}</th>" for column in table.columns)
    groups = ""
    for group, width in table.groups():
        inner = f"<span>{escape(group)}</span>" if group else ""
        groups += f'<th class="group" colspan="{width}">{inner}</th>'
    return f"<tr>{groups}</tr>\n<tr>{names}</tr>" if groups else f"<tr>{names}</tr>"


def _cell(cell: Cell, numeric: bool) -> str:
    mean, spread, deviation = escape(cell.text).partition(" ±")
    text = f"{mean}<small>{spread}{deviation}</small>" if spread else mean
    return f"<td{_classes(numeric=numeric, strong=cell.strong, muted=cell.muted)}>{text}</td>"


def _classes(**classes: bool) -> str:
    names = " ".join(name for name, there in classes.items() if there)
    return f' class="{names}"' if names else ""
