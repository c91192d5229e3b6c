"""Tables of a report as CSV, LaTeX and Markdown, and its charts as SVG and PDF."""

import csv
import io
import xml.etree.ElementTree as ET

import pytest

from torchvision_dddas.io.report import Cell, ReportColumn, ReportTable, number_cell, render_page, text_cell
from torchvision_dddas.io.report.charts import Interval, interval_chart
from torchvision_dddas.io.report.figure_files import save_figures
from torchvision_dddas.io.report.table_files import save_tables, to_csv, to_latex, to_markdown

TABLE = ReportTable(
    "scores",
    [ReportColumn("method", text=True), ReportColumn("AR₃"), ReportColumn("loss")],
    [
        [text_cell("a|b_c & 5 %"), Cell("0.333", 1 / 3, "0.1 to 0.5", best=True), number_cell(-1.5)],
        [text_cell("x"), number_cell(None), number_cell(0.25)],
    ],
    [[text_cell("mean"), number_cell(1 / 3), number_cell(-0.625)]],
)


def test_csv_has_all_digits_intervals_of_their_own_and_empty_cells_for_unknown_values():
    head, first, second, foot = csv.reader(io.StringIO(to_csv(TABLE)))
    assert head == ["method", "AR₃", "AR₃, 95 %", "loss"]
    assert float(first[1]) == 1 / 3 and first[2:] == ["0.1 to 0.5", "-1.5"]
    assert second[1:3] == ["", ""] and foot[0] == "mean"


def test_latex_escapes_names_and_sets_the_best_in_bold():
    text = to_latex(TABLE)
    assert r"a|b\_c \& 5 \% & \textbf{0.333} {\scriptsize [0.1 to 0.5]} & $-$1.500 \\" in text
    assert r"\begin{tabular}{lrr}" in text and "AR$_3$" in text and text.count(r"\midrule") == 2
    assert text.isascii()


def test_each_row_of_markdown_has_as_many_cells_as_the_head():
    lines = to_markdown(TABLE).splitlines()
    assert lines[2] == r"| a\|b_c & 5 % | **0.333** [0.1 to 0.5] | −1.500 |"
    assert {line.replace(r"\|", "").count("|") for line in lines} == {4}


def test_tables_are_written_in_three_formats(tmp_path):
    save_tables(tmp_path / "tables", {"scores": TABLE})
    assert {path.name for path in (tmp_path / "tables").iterdir()} == {"scores.csv", "scores.tex", "scores.md"}


@pytest.fixture
def page():
    chart = interval_chart("HOTA <b> & more", [Interval("sört", 0.5, 0.4, 0.6)], Interval("all", 0.5, 0.45, 0.55))
    return render_page(
        "comparison_section.html", id="a", title="", charts=[chart, chart], pooled="", by_clip="", same=[]
    )


def test_each_chart_of_a_page_becomes_an_svg_that_needs_no_style_sheet(page, tmp_path):
    assert save_figures(tmp_path, page) == ["hota-b-more", "hota-b-more-2"]
    drawn = list(ET.parse(tmp_path / "hota-b-more.svg").iter())
    assert not any("class" in part.attrib or part.tag.endswith("style") for part in drawn)
    (dot,) = (part for part in drawn if part.tag.endswith("circle"))
    assert dot.attrib["fill"] == "#0072b2" and "var(" not in str(drawn)


def test_figures_are_pdf_too_where_fpdf2_is_installed(page, tmp_path):
    pytest.importorskip("fpdf")
    save_figures(tmp_path, page)
    assert (tmp_path / "hota-b-more.pdf").read_bytes().startswith(b"%PDF-")
