"""Write the tables of a report as files: CSV, LaTeX (for the package booktabs) and Markdown."""

import csv
import io
from collections.abc import Mapping, Sequence
from pathlib import Path

from torchvision_dddas.io.atomic_files import save_file
from torchvision_dddas.io.report import Cell, ReportTable

_LATEX = {letter: f"\\{letter}" for letter in "&%$#_{}"} | {
    "\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}", "<": "$<$", ">": "$>$",
    "−": "$-$", "–": "--", "\u202f": r"\,", "≥": r"$\ge$", "₂": "$_2$", "₃": "$_3$", "→": r"$\to$",
}  # fmt: skip


def save_tables(folder: Path, tables: Mapping[str, ReportTable]) -> None:
    """Write each table as NAME.csv, NAME.tex and NAME.md. Raise InputError if a file cannot be written."""
    for name, table in tables.items():
        for ending, write in {"csv": to_csv, "tex": to_latex, "md": to_markdown}.items():
            save_file(folder / f"{name}.{ending}", write(table).encode())


def to_csv(table: ReportTable) -> str:
    """Return a table as CSV with all digits. Intervals become columns of text, and unknown values stay empty."""
    rows = [*table.rows, *table.foot]
    spans = [any(row[k].small for row in rows) for k in range(len(table.columns))]
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = [[column.name, f"{column.name}, 95 %"] for column in table.columns]

    def flat(pairs: Sequence[Sequence[object]]) -> list[object]:
        return [value for pair, span in zip(pairs, spans, strict=True) for value in pair[: 1 + span]]

    writer.writerow(flat(heads))
    writer.writerows(flat([("" if cell.value is None else cell.value, cell.small) for cell in row]) for row in rows)
    return text.getvalue()


def to_latex(table: ReportTable) -> str:
    r"""Return a tabular with the rules of booktabs. Intervals are set small, and the best values bold."""

    def escape(text: str) -> str:
        return "".join(_LATEX.get(letter, letter) for letter in text)

    def fill(cell: Cell) -> str:
        text = escape(cell.text)
        text = rf"\textbf{{{text}}}" if cell.best else text
        return text + (rf" {{\scriptsize [{escape(cell.small)}]}}" if cell.small else "")

    def lines(rows: Sequence[Sequence[Cell]]) -> str:
        return "".join(" & ".join(map(fill, row)) + " \\\\\n" for row in rows)

    kinds = "".join("l" if column.text else "r" for column in table.columns)
    head = " & ".join(escape(column.name) for column in table.columns)
    foot = f"\\midrule\n{lines(table.foot)}" if table.foot else ""
    return (
        f"% {table.caption}\n\\begin{{tabular}}{{{kinds}}}\n\\toprule\n{head} \\\\\n\\midrule\n"
        f"{lines(table.rows)}{foot}\\bottomrule\n\\end{{tabular}}\n"
    )


def to_markdown(table: ReportTable) -> str:
    """Return a table in GitHub's Markdown. Intervals follow in brackets, and the best values are bold."""

    def fill(cell: Cell) -> str:
        text = f"**{cell.text}**" if cell.best else cell.text
        return text + (f" [{cell.small}]" if cell.small else "")

    def line(cells: Sequence[str]) -> str:
        return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |\n"

    rule = line(["---" if column.text else "---:" for column in table.columns])
    rows = [line([fill(cell) for cell in row]) for row in (*table.rows, *table.foot)]
    return line([column.name for column in table.columns]) + rule + "".join(rows)
