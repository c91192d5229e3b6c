"""report.html of several methods on the same clips, with its tables and figures as files."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from torchvision_dddas.io.atomic_files import save_file
from torchvision_dddas.io.report import Cell, ReportColumn, ReportTable, number_cell, render_page, text_cell
from torchvision_dddas.io.report.charts import interval_chart
from torchvision_dddas.io.report.figure_files import save_figures
from torchvision_dddas.io.report.table_files import save_tables
from torchvision_dddas.lab.evaluation.metrics.registry import GROUPS, describe, title_of_group
from torchvision_dddas.lab.evaluation.report.study import figure_of
from torchvision_dddas.lab.evaluation.studies.comparison import (
    MEANING,
    comparison_section,
    entries_of,
    measure_title,
    pooled_changes,
    signed_change,
)

Methods = Mapping[str, Mapping[str, Any]]
"""The pooled measures of a task, by method."""


def save_methods(folder: Path, content: Mapping[str, Any]) -> None:
    """Write report.html, tables/ and figures/. content: content of comparison.json, with None for NaN."""
    methods = content["methods"]
    tables: dict[str, ReportTable] = {}
    tasks: list[dict[str, Any]] = []
    first = next(iter(methods))
    for task, whole in methods[first]["tasks"].items():
        pooled: Methods = {name: mine["tasks"][task]["pooled"] for name, mine in methods.items()}
        groups = [group for group in GROUPS if group in pooled[first]]
        named = {f"{task}-{group}": _method_table(pooled, group) for group in groups}
        of_task = {one["second"]: one["tasks"][task] for one in content["comparisons"]}
        tables |= named | {
            f"{task}-{name}-against-{first}": pooled_changes(changes, first, name) for name, changes in of_task.items()
        }
        n_clips = len(whole["clips"])
        tasks.append(
            {
                "id": task,
                "title": f"{task.capitalize()}, {n_clips} clip{'s' * (n_clips != 1)}",
                "lines": [line for name, changes in of_task.items() if (line := _verdict_line(name, first, changes))],
                "tables": [table.markup for table in named.values()],
                "charts": [_method_chart(pooled, group, name) for group in groups for name in GROUPS[group].compared],
                "sections": [
                    comparison_section(
                        f"{task}-{name}", f"{task.capitalize()}: {name} against {first}", mine, first, name
                    )
                    for name, mine in of_task.items()
                ],
            }
        )
    title = f"{', '.join(methods)}: comparison"
    page = render_page("several.html", title=title, meaning=MEANING, tasks=tasks, notes=content["notes"])
    save_file(folder / "report.html", page.encode())
    save_tables(folder / "tables", tables)
    save_figures(folder / "figures", page)


def _method_table(methods: Methods, group: str) -> ReportTable:
    """Return a row for each method: figures over all clips with their intervals, the best of each measure in bold."""
    names = [name for name in GROUPS[group].shown if any(name in mine.get(group, {}) for mine in methods.values())]
    columns: list[list[Cell]] = []
    for name in names:
        known, found = describe(name), [figure_of(mine, group, name) for mine in methods.values()]
        digits = [number_cell(one.value, known.digits, (one.low, one.high)) for one in found]
        values = [known.better * one.value for one in found if one.value == one.value]  # NaN is not equal to itself
        best = max(values) if known.better and values else None
        columns.append([replace(c, best=known.better * f.value == best) for c, f in zip(digits, found, strict=True)])
    heads = [
        ReportColumn("method", text=True),
        *(ReportColumn(describe(name).title, describe(name).meaning) for name in names),
    ]
    rows = [[text_cell(method), *cells] for method, *cells in zip(methods, *columns, strict=True)]
    return ReportTable(f"{title_of_group(group)}, all clips together", heads, rows)


def _method_chart(methods: Methods, group: str, name: str) -> Any:
    rows = [figure_of(mine, group, name, method) for method, mine in methods.items()]
    return interval_chart(measure_title(group, name), rows, limits=(0.0, 1.0 if describe(name).is_share else 0.0))


def _verdict_line(name: str, first: str, changes: Mapping[str, Any]) -> str:
    """Return the change of the first measure in words."""
    if not (entries := entries_of(changes["pooled"])):
        return ""
    _, measure, entry = entries[0]
    return f"{name} against {first}: {describe(measure).title} {signed_change(entry, measure)}, {entry['says']}"
