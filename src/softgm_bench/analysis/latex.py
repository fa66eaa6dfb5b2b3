"""A report as a LaTeX document of its own; tables use booktabs, figures are PDF files beside it."""

import re
from collections.abc import Iterable

from softgm_bench.analysis.document import Cell, Document, Figure, Table, written

PREAMBLE = r"""\documentclass[a4paper,10pt]{article}
\usepackage[landscape,margin=16mm]{geometry}
\usepackage{booktabs}
\usepackage{float}
\usepackage{graphicx}
\usepackage{xcolor}
\newcommand{\muted}[1]{\textcolor{black!55}{#1}}
"""
ROWS_ON_A_PAGE = 24
# Tables for a paper of one's own: which of the report's, and the columns of the narrow form, group and name.
FOR_PAPERS = {"table1": "one-", "table2": "two"}
NARROW = (
    ("", "Task"),
    ("", "Algorithm"),
    ("", "Condition"),
    ("Success, %", "ours"),
    ("Success, %", "95 % interval"),
    ("Success, %", "paper"),
    ("Episode length", "ours"),
)
WIDE_SIZE, NARROW_SIZE = r"\scriptsize", r"\footnotesize"
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
    "¶": r"$^{\mathparagraph}$",
    "‖": r"$^{\|}$",
    "√": r"$\surd$",
    "τ": r"$\tau$",
    "→": r"$\rightarrow$",
    "…": r"\ldots{}",
}


def render(document: Document) -> str:
    """Write the whole document."""
    title = rf"\title{{{escape(document.title)}}}"
    parts = [PREAMBLE, title, r"\author{}", r"\date{}", r"\begin{document}", r"\maketitle"]
    for heading, blocks in document.sections:
        parts += [rf"\section{{{escape(heading)}}}", *written(blocks, escape, _table, _figure)]
    return "\n\n".join([*parts, r"\end{document}"]) + "\n"


def for_papers(document: Document) -> dict[str, str]:
    """Tables I and II by file name, each to be included in a paper: two columns wide, and ``_compact`` for one column.

    They need booktabs and xcolor and are set in a small size, not scaled. What was not run at all is left out, and so
    are the columns that only ``report.tex`` has room for.
    """
    files = {}
    for name, prefix in FOR_PAPERS.items():
        tables = [table for table in document.tables if table.key.startswith(prefix)]
        for narrow in (False, True):
            parts = [part for table in tables if (part := _for_paper(table, narrow)) is not None]
            files[f"{name}{'_compact' if narrow else ''}.tex"] = "\n\n".join(parts or ["% nothing was run"]) + "\n"
    return files


def _for_paper(table: Table, narrow: bool) -> str | None:
    rows = [row for row in table.rows if not any(cell.text == "not run" for cell in row)]
    if not rows:
        return None
    wide = [place for place, column in enumerate(table.columns) if column.name not in ("recipe", "minutes", "rank")]
    kept = [place for place in wide if not narrow or table.columns[place][:2][::-1] in NARROW]
    columns = [table.columns[place] for place in kept]
    chosen = table._replace(columns=columns, rows=[[row[place] for place in kept] for row in rows])
    kind, label = ("table", f"tab:{table.key}-compact") if narrow else ("table*", f"tab:{table.key}")
    lines = [
        rf"\begin{{{kind}}}",
        r"\centering",
        NARROW_SIZE if narrow else WIDE_SIZE,
        r"\setlength{\tabcolsep}{3pt}",
        rf"\caption{{{escape(table.caption)}}}",
        rf"\label{{{label}}}",
        *_tabular(chosen, chosen.rows),
        *(rf"\par\smallskip\parbox{{\linewidth}}{{{escape(note)}}}" for note in table.notes),
        rf"\end{{{kind}}}",
    ]
    return "\n".join([r"\providecommand{\muted}[1]{\textcolor{black!55}{#1}}", *lines])


def escape(text: str) -> str:
    """Write LaTeX's own and other special characters as commands, and ``?`` for one that is not known."""
    return "".join(SYMBOLS.get(character, character) for character in text).encode("ascii", "replace").decode()


def _figure(figure: Figure) -> str:
    width = re.search(r'width="([0-9.]+)pt"', figure.svg)[1]  # type: ignore[index]
    width = rf"\ifdim {width}bp>\linewidth\linewidth\else {width}bp\fi"
    picture = rf"\includegraphics[width={width},height=0.8\textheight,keepaspectratio]{{figures/{figure.key}.pdf}}"
    return _float("figure", figure.caption, f"fig:{figure.key}", before=[picture])


def _float(kind: str, caption: str, label: str, before: Iterable[str] = (), after: Iterable[str] = ()) -> str:
    """A figure or a table: what stands before and after its caption and label."""
    named = [rf"\caption{{{escape(caption)}}}", rf"\label{{{label}}}"]
    return "\n".join([rf"\begin{{{kind}}}[H]", r"\centering", *before, *named, *after, rf"\end{{{kind}}}"])


def _table(table: Table) -> str:
    """The table in parts that fit on a page; notes below the last, the label at the first."""
    starts = range(0, max(1, len(table.rows)), ROWS_ON_A_PAGE)
    return "\n\n".join(_part(table, start) for start in starts)


def _part(table: Table, start: int) -> str:
    end = start + ROWS_ON_A_PAGE
    notes = table.notes if end >= len(table.rows) else []
    lines = [
        r"\resizebox{\ifdim\width>\linewidth\linewidth\else\width\fi}{!}{%",
        *_tabular(table, table.rows[start:end]),
        "}",
        *(rf"\par\smallskip\parbox{{\linewidth}}{{\footnotesize {escape(note)}}}" for note in notes),
    ]
    caption, label = table.caption, f"tab:{table.key}"
    if start:
        caption, label = f"{caption} (continued)", f"{label}-{start}"
    return _float("table", caption, label, after=lines)


def _tabular(table: Table, rows: Iterable[Iterable[Cell]]) -> list[str]:
    return [
        rf"\begin{{tabular}}{{{''.join('r' if column.numeric else 'l' for column in table.columns)}}}",
        r"\toprule",
        *_headings(table),
        r"\midrule",
        *(_row(map(_cell, row)) for row in rows),
        r"\bottomrule",
        r"\end{tabular}",
    ]


def _headings(table: Table) -> list[str]:
    names = _row(escape(column.name) for column in table.columns)
    groups, rules, position = [], [], 1
    for group, width in table.groups():
        groups.append(rf"\multicolumn{{{width}}}{{c}}{{{escape(group)}}}")
        if group:
            rules.append(rf"\cmidrule(lr){{{position}-{position + width - 1}}}")
        position += width
    return [_row(groups), " ".join(rules), names] if groups else [names]


def _row(cells: Iterable[str]) -> str:
    return " & ".join(cells) + r" \\"


def _cell(cell: Cell) -> str:
    text = escape(cell.text)
    if cell.strong:
        return rf"\textbf{{{text}}}"
    return rf"\muted{{{text}}}" if cell.muted else text
