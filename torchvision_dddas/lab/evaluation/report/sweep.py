"""report.html of a sweep: its trials, and the measure over each parameter. Tables and figures are also files."""

import math
from typing import TYPE_CHECKING

import numpy as np
from markupsafe import Markup

from torchvision_dddas.io.atomic_files import save_file
from torchvision_dddas.io.report import Cell, ReportColumn, ReportTable, number_cell, render_page, text_cell
from torchvision_dddas.io.report.charts import Axis, Dots, Line, chart
from torchvision_dddas.io.report.figure_files import save_figures
from torchvision_dddas.io.report.table_files import save_tables
from torchvision_dddas.lab.evaluation.metrics.registry import describe

if TYPE_CHECKING:
    from torchvision_dddas.lab.evaluation.studies.sweep import SweepRecord


def save_sweep(record: "SweepRecord") -> None:
    """Write report.html, tables/ and figures/ into the sweep's folder. Raise InputError if the disk refuses."""
    goal, first, best = record.goal, record.trials[0], record.best
    assert best is not None
    known, parameters = describe(goal.measure), list(record.defaults)
    columns = [ReportColumn(name, f"default {record.defaults[name]}", text=True) for name in parameters]
    columns = [
        ReportColumn("trial"),
        *columns,
        ReportColumn(known.title, known.meaning),
        ReportColumn("note", text=True),
    ]
    rows = []
    for trial in record.trials:
        values = [record.value_of(trial, name) for name in parameters]
        value = number_cell(trial.value, 4)
        cells = [Cell(str(v), float(v) if isinstance(v, int | float) else str(v)) for v in values]
        note = trial.cause or ("the original settings" if trial is first else "")
        value = Cell(value.text, value.value, best=trial is best)
        rows.append([number_cell(trial.number), *cells, value, text_cell(note)])
    trials = ReportTable("trials", columns, rows)
    lines = [f"best: trial {best.number}, {best.value:.4f}; the original settings: {number_cell(first.value, 4).text}"]
    if record.on_held is not None:
        before, after = (number_cell(value, 4).text for value, _ in record.on_held)
        lines.append(f"on the clips held out: {after} with the best, {before} with the original settings")
    charts = [_chart(record, name) for name in parameters]
    task = {"id": "trials", "title": f"{len(rows)} trials", "lines": lines, "tables": [trials.markup], "sections": []}
    title, meaning = "Sweep", f"{record.heading}; {'less' if goal.minimize else 'more'} is better"
    tasks = [task | {"charts": [one for one in charts if one]}]
    page = render_page("several.html", title=title, meaning=meaning, tasks=tasks, notes=record.notes)
    save_file(record.folder / "report.html", page.encode())
    save_tables(record.folder / "tables", {"trials": trials})
    save_figures(record.folder / "figures", page)


def _chart(record: "SweepRecord", parameter: str) -> Markup:
    """Return the measure over a parameter, as a line if only it was varied; empty if its values are not numbers."""
    tried = [trial for trial in record.trials if math.isfinite(trial.value)]
    points = [(record.value_of(trial, parameter), trial.value, trial is record.best) for trial in tried]
    numbers = [(float(v), y, best) for v, y, best in points if isinstance(v, int | float) and not isinstance(v, bool)]
    if len(numbers) < 2:
        return Markup("")
    numbers.sort()
    x, y, is_best = (np.array(column) for column in zip(*numbers, strict=True))
    first = record.trials[0].value
    lines = [Line("as it was", x[[0, -1]], np.full(2, first), 6, dashed=True)]
    if len(record.defaults) == 1:
        lines.append(Line("", x, y, 1))
    dots = [Dots("trials", x, y, 1), Dots("best", x[is_best], y[is_best], 2, is_ring=True)]
    return chart(parameter, Axis(parameter), Axis(describe(record.goal.measure).title), lines, dots)
