import re
from html.parser import HTMLParser

import pytest

from softgm_bench.analysis import html, latex, markdown
from softgm_bench.analysis.document import Cell, Column, Document, Figure, Section, Table

SVG = """<?xml version="1.0"?>
<svg width="100pt" height="50pt" viewBox="0 0 100 50" xmlns="http://www.w3.org/2000/svg">
<metadata>matplotlib</metadata>
<defs><path id="a" d="M 0 0"/></defs><use href="#a" style="fill: #1d2126"/><g clip-path="url(#b)"/>
</svg>
"""


@pytest.fixture
def document():
    columns = [Column("Name", numeric=False), Column("ours", "Success, %"), Column("paper", "Success, %")]
    rows = [
        [Cell("soft_gm†"), Cell("97.5 ± 1.0", strong=True), Cell("41.33", muted=True)],
        [Cell("a & b < c | d"), Cell("not run", muted=True), Cell("—", muted=True)],
    ]
    table = Table("one", "Means ± deviations, 100 %", columns, rows, ["† told_more"])
    return Document(
        "A_report", [Section("First part", ["Text: 5 × 3 ≥ 2.", table, Figure("fig", "A figure", SVG, b"")])]
    )


def test_markdown_has_a_line_for_each_row_and_escapes_what_would_be_markup(document):
    text = markdown.render(document)
    assert "| Name | Success, %: ours | Success, %: paper |" in text
    assert "| --- | ---: | ---: |" in text
    assert r"| soft\_gm† | **97.5 ± 1.0** | *41.33* |" in text
    assert r"| a & b \< c \| d | *not run* | *—* |" in text
    assert "![A figure](figures/fig.svg)" in text


def test_latex_is_ascii_with_balanced_braces_and_environments(document):
    text = latex.render(document)
    assert text.isascii()
    bare = re.sub(r"\\[{}]", "", text)
    assert bare.count("{") == bare.count("}")
    assert sorted(re.findall(r"\\begin\{(\w+)\}", text)) == sorted(re.findall(r"\\end\{(\w+)\}", text))
    assert r"soft\_gm$^{\dagger}$ & \textbf{97.5 $\pm$ 1.0} & \muted{41.33} \\" in text
    assert r" & \multicolumn{2}{c}{Success, \%} \\" in text
    assert r"\cmidrule(lr){2-3}" in text
    width = r"\ifdim 100bp>\linewidth\linewidth\else 100bp\fi"
    assert rf"\includegraphics[width={width},height=0.8\textheight,keepaspectratio]{{figures/fig.pdf}}" in text


def test_latex_splits_a_table_that_is_longer_than_a_page():
    rows = [[Cell(f"row {index}")] for index in range(2 * latex.ROWS_ON_A_PAGE + 1)]
    table = Table("long", "Long", [Column("Name")], rows, ["below all"])
    text = latex.render(Document("Report", [Section("Part", [table])]))
    assert text.count(r"\begin{tabular}") == 3
    assert text.count("(continued)") == 2
    assert text.count("below all") == 1
    assert re.findall(r"row (\d+)", text) == [str(index) for index in range(len(rows))]


@pytest.mark.parametrize("character", latex.SYMBOLS)
def test_latex_escapes_every_special_character(character):
    assert latex.escape(f"x{character}y") == f"x{latex.SYMBOLS[character]}y"


class Balance(HTMLParser):
    VOID = ("meta", "link", "br", "path", "use")

    def __init__(self):
        super().__init__()
        self.open, self.ids = [], []

    def handle_starttag(self, tag, attributes):
        self.ids += [value for name, value in attributes if name == "id"]
        if tag not in self.VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        if tag not in self.VOID:
            assert self.open.pop() == tag


def test_html_is_balanced_and_needs_no_other_file(document):
    page = html.render(document)
    parser = Balance()
    parser.feed(page)
    assert parser.open == []
    assert len(parser.ids) == len(set(parser.ids))
    assert not re.search(r'(src|href)="(?!#|data:)', page)
    assert "@import" not in page
    assert "url(" not in page.replace("url(#", "")


def test_a_figure_in_a_page_has_the_pages_colours_and_names_of_its_own(document):
    (figure,) = document.figures
    svg = html.themed(figure)
    assert svg.startswith("<svg ")
    assert "#1d2126" not in svg
    assert "fill: currentColor" in svg
    assert 'id="fig-a"' in svg
    assert 'href="#fig-a"' in svg
    assert "url(#fig-b)" in svg
    assert "metadata" not in svg
    assert 'width="100pt"' not in svg


def test_html_escapes_text(document):
    assert "a &amp; b &lt; c | d" in html.render(document)
