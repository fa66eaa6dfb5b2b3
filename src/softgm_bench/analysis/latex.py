"""A report as a LaTeX document of its own; tables use booktabs, figures are PDF files beside it."""

import re
from dataclasses import replace
from itertools import groupby

from softgm_bench.analysis.document import Block, Cell, Document, Figure, Table

PREAMBLE = r"""\documentclass[a4paper,10pt]{article}
\usepackage[landscape,margin=16mm]{geometry}
\usepackage{booktabs}
\usepackage{float}
\usepackage{graphicx}
\usepackage{xcolor}
\newcommand{\muted}[1]{\textcolor{black!55}{#1}}
"""
ROWS_ON_A_PAGE = 24
SYMBOLS = {
    "\\": r"\textbackslash{}",
    "{": r"\{",
    "}": r"\}",
    "%": r"\%",
    "&": r"\&",
    "#": r"\#",
    "$": r"\$",
    "_": r"\_",
    "~": r"\textasciitilde{}",
    "^": r"\textasciicircum{}",
    "<": r"\textless{}",
    ">": r"\textgreater{}",
    "±": r"$\pm$",
    "×": r"$\times$",
    "−": r"$-$",
    "–": "--",
    "—": "---",
    "≥": r"$\geq$",
    "†": r"$^{\dagger}$",
    "‡": r"$^{\ddagger}$",
    "§": r"$^{\mathsection}$",
    "√": r"$\surd$",
    "τ": r"$\tau$",
    "→": r"$\rightarrow$",
    "…": r"\ldots{}",
}


def render(document: Document) -> str:
    """The whole document."""
    parts = [
        PREAMBLE,
        rf"\title{{{escape(document.title)}}}",
        r"\author{}",
        r"\date{}",
        r"\begin{document}",
        r"\maketitle",
    ]
    for section in document.sections:
        parts += [rf"\section{{{escape(section.title)}}}", *(_block(block) for block in section.blocks)]
    return "\n\n".join([*parts, r"\end{document}"]) + "\n"


def escape(text: str) -> str:
    """Text with LaTeX's own and other special characters written as commands, and ``?`` for one that is not known."""
    written = "".join(SYMBOLS.get(character, character) for character in text)
    return "".join(character if character.isascii() else "?" for character in written)


def _block(block: Block) -> str:
    match block:
        case Table():
            return "\n\n".join(_table(part) for part in _pages(block))
        case Figure():
            return _figure(block)
        case _:
            return escape(block)


def _figure(figure: Figure) -> str:
    width = re.search(r'width="([0-9.]+)pt"', figure.svg)[1]  # type: ignore[index]
    width = rf"\ifdim {width}bp>\linewidth\linewidth\else {width}bp\fi"
    lines = [
        r"\begin{figure}[H]",
        r"\centering",
        rf"\includegraphics[width={width},height=0.8\textheight,keepaspectratio]{{figures/{figure.key}.pdf}}",
        rf"\caption{{{escape(figure.caption)}}}",
        rf"\label{{fig:{figure.key}}}",
        r"\end{figure}",
    ]
    return "\n".join(lines)


def _pages(table: Table) -> list[Table]:
    """The table in parts that fit on a page; notes below the last, the label at the first."""
    starts = range(0, max(1, len(table.rows)), ROWS_ON_A_PAGE)
    parts = [
        replace(
            table,
            key=f"{table.key}-{start}" if start else table.key,
            caption=f"{table.caption} (continued)" if start else table.caption,
            rows=table.rows[start : start + ROWS_ON_A_PAGE],
            notes=[],
        )
        for start in starts
    ]
    return [*parts[:-1], replace(parts[-1], notes=table.notes)]


def _table(table: Table) -> str:
    alignment = "".join("r" if column.numeric else "l" for column in table.columns)
    lines = [
        r"\begin{table}[H]",
        r"\centering",
        rf"\caption{{{escape(table.caption)}}}",
        rf"\label{{tab:{table.key}}}",
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        rf"\begin{{tabular}}{{{alignment}}}",
        r"\toprule",
        *_headings(table),
        r"\midrule",
        *(" & ".join(map(_cell, row)) + r" \\" for row in table.rows),
        r"\bottomrule",
        r"\end{tabular}}",
        *(rf"\par\smallskip\parbox{{\linewidth}}{{\footnotesize {escape(note)}}}" for note in table.notes),
        r"\end{table}",
    ]
    return "\n".join(lines)


def _headings(table: Table) -> list[str]:
    names = " & ".join(escape(column.name) for column in table.columns) + r" \\"
    if not any(column.group for column in table.columns):
        return [names]
    groups, rules, position = [], [], 1
    for group, members in groupby(table.columns, key=lambda column: column.group):
        width = len(list(members))
        groups.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(group)}}}")
        if group:
            rules.append(rf"\cmidrule(lr){{{position}-{position + width - 1}}}")
        position += width
    return [" & ".join(groups) + r" \\", " ".join(rules), names]


def _cell(cell: Cell) -> str:
    text = escape(cell.text)
    if cell.strong:
        return rf"\textbf{{{text}}}"
    return rf"\muted{{{text}}}" if cell.muted else text
