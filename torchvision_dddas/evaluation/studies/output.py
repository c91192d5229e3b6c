"""The files of a study: its measures (JSON, CSV, Parquet), its counts for comparisons, its report, and run.json."""

import csv
import io
import json
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

from torchvision_dddas.evaluation.metrics.registry import GROUPS
from torchvision_dddas.evaluation.report import study_report
from torchvision_dddas.evaluation.studies.jobs import OnEvent
from torchvision_dddas.evaluation.studies.results import Results, ScoredCase
from torchvision_dddas.evaluation.studies.runner import Plan, cache_folder, run_study
from torchvision_dddas.evaluation.studies.spec import Spec
from torchvision_dddas.evaluation.studies.storage import SCORES, write_scores
from torchvision_dddas.evaluation.studies.summary import summarize, summarize_costs
from torchvision_dddas.evaluation.studies.workers import Workers
from torchvision_dddas.io.atomic_files import cannot_write, temporary, write_whole
from torchvision_dddas.io.output.run_record import finite, versions

FILES = ("metrics.json", "metrics.csv", "metrics.parquet", "frames.parquet", SCORES, "report.html", "run.json")


class Row(NamedTuple):
    """One figure. scope: clip, pooled or mean. clip: its name if it is of one. low, high: its interval, NaN if none."""

    study: str
    task: str
    scope: str
    clip: str
    group: str
    measure: str
    value: float
    low: float
    high: float


class FrameRow(NamedTuple):
    """One count of one frame, by its name."""

    study: str
    task: str
    clip: str
    frame: int
    group: str
    name: str
    value: float


def write_study(
    folder: Path,
    spec: Spec,
    base: Path,
    workers: Workers | None = None,
    cache: Path | None = None,
    clips: Sequence[str] = (),
    on_event: OnEvent = lambda event: None,
    on_start: Callable[[Plan], object] = lambda planned: None,
) -> tuple[Results, dict[str, Any]]:
    """Run a study as `run_study` does and write FILES into a folder; its results and its measures.

    run.json says whether the study is running, complete or interrupted. Raises InputError as `run_study` does, and if
    the disk refuses; bad input leaves the files of an earlier study in the folder as they were.
    """
    start_s, place = time.perf_counter(), cache or cache_folder()
    has_begun = False

    def begin(planned: Plan) -> None:
        nonlocal has_begun
        _write_json(folder / "run.json", {"state": "running", "study": spec.name})
        has_begun = True
        on_start(planned)

    try:
        folder.mkdir(parents=True, exist_ok=True)
        try:
            results = run_study(spec, base, workers, place, clips, on_event, begin)
            measures = summarize(results)
            _write_json(folder / "metrics.json", measures)
            write_csv(folder / "metrics.csv", measures)
            write_parquet(folder, measures, results)
            scored = [ScoredCase(c.task, c.clip.name, c.scored) for c in results.cases if c.scored is not None]
            write_scores(folder, spec.name, scored)
            write_whole(folder / "report.html", study_report(finite(measures), results).encode())
            _write_json(folder / "run.json", _record(results, time.perf_counter() - start_s, place))
        except BaseException:
            if has_begun:
                with suppress(OSError):
                    record = {"state": "interrupted", "study": spec.name, "cache": place}
                    _write_json(folder / "run.json", record)
            raise
    except OSError as error:
        raise cannot_write(folder / "run.json", error) from error
    return results, measures


def metric_rows(metrics: Mapping[str, Any]) -> list[Row]:
    """Every figure of metrics.json."""
    found = []
    for task, mine in metrics["tasks"].items():
        places = [("clip", name, clip) for name, clip in mine["clips"].items()]
        for scope, name, groups in (*places, ("pooled", "", mine["pooled"]), ("mean", "", mine["mean"])):
            spans = groups.get("intervals", {})
            for group in GROUPS:
                for measure, value in groups.get(group, {}).items():
                    low, high = spans.get(group, {}).get(measure) or (math.nan, math.nan)
                    known = math.nan if value is None else float(value)
                    found.append(Row(metrics["name"], task, scope, name, group, measure, known, low, high))
    return found


def frame_rows(results: Results) -> Iterator[FrameRow]:
    """Every count of every frame, ordered by task and clip; frames that a group does not use are left out."""
    for case in sorted(results.cases, key=lambda case: (case.task, case.clip.name)):
        if case.scored is None:
            continue
        for group, counts in case.scored.per_frame.items():
            for name, values in counts.items():
                for frame, value in zip(case.scored.frames.tolist(), values.tolist(), strict=True):
                    if not math.isnan(value):
                        yield FrameRow(results.spec.name, case.task, case.clip.name, frame, group, name, value)


def write_csv(path: Path, metrics: Mapping[str, Any]) -> None:
    """Write metrics.csv. A cell is empty if its figure is undefined. Raises OSError."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(Row._fields)
    for row in metric_rows(metrics):
        table.writerow(["" if value != value else value for value in row])  # NaN alone differs from itself
    write_whole(path, text.getvalue().encode())


def write_parquet(folder: Path, metrics: Mapping[str, Any], results: Results) -> tuple[str, ...]:
    """Write metrics.parquet and frames.parquet; the names of what was written, none without pyarrow. Raises OSError."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        return ()
    kinds = {str: pyarrow.string(), int: pyarrow.int64(), float: pyarrow.float64()}
    tables: dict[str, tuple[type[Any], list[Any]]] = {
        "metrics.parquet": (Row, metric_rows(metrics)),
        "frames.parquet": (FrameRow, list(frame_rows(results))),
    }
    for name, (record, rows) in tables.items():
        schema = pyarrow.schema([(column, kinds[kind]) for column, kind in record.__annotations__.items()])
        part = temporary(folder / name)
        try:
            pyarrow.parquet.write_table(pyarrow.Table.from_pylist([row._asdict() for row in rows], schema), part)
            part.replace(folder / name)
        finally:
            part.unlink(missing_ok=True)
    return tuple(tables)


def _write_json(path: Path, content: Any) -> None:
    write_whole(path, (json.dumps(finite(content), indent=2) + "\n").encode())


def _record(results: Results, wall_s: float, cache: Path) -> dict[str, Any]:
    """The content of run.json of a complete study."""
    spec = results.spec
    return {
        "state": "complete",
        "versions": versions(),
        "study": {
            "name": spec.name,
            "tasks": spec.tasks,
            "config": spec.config,
            "set": spec.overrides,
            "backend": spec.backend,
            "interval": spec.interval,
        },
        **results.facts,
        "left_out": results.left_out,
        "cache": cache,
        "settings": results.settings.model_dump(),
        "seconds": {"wall": round(wall_s, 3)},
        "costs": summarize_costs(results),
    }
