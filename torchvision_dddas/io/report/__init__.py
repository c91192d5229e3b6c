"""The report kit: pages from Jinja2 templates with one stylesheet and one script, SVG charts, tables that sort.

    svg = chart("Loss", Axis("step"), Axis("loss"), [Line("batch", steps, losses)])
    rows = [[text_cell("a"), number_cell(0.5)]]
    html = render_page("tuning.html", title="Tuning", plots=[svg], parameters=table("parameters", columns, rows))

Templates lie in `templates/`, the macros that they share in `templates/parts.html`.
"""

from torchvision_dddas.io.report.charts import (
    MOST_ROWS,
    Axis,
    Dots,
    Events,
    Interval,
    Line,
    Panel,
    chart,
    interval_chart,
    time_chart,
)
from torchvision_dddas.io.report.page import (
    Cell,
    Column,
    format_count,
    format_number,
    number_cell,
    render_page,
    table,
    text_cell,
)

__all__ = [
    "MOST_ROWS",
    "Axis",
    "Cell",
    "Column",
    "Dots",
    "Events",
    "Interval",
    "Line",
    "Panel",
    "chart",
    "format_count",
    "format_number",
    "interval_chart",
    "number_cell",
    "render_page",
    "table",
    "text_cell",
    "time_chart",
]
