"""Run a study, from its TOML file to the files of its results: read data sets, do jobs, write measures.

The files are the measures (JSON, CSV, Parquet), counts for comparisons, a report, and run.json.
"""

import csv
import io
import json
import math
import re
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

from torchvision_dddas.config import Settings, load_config, read_toml
from torchvision_dddas.detection import load_engine
from torchvision_dddas.errors import InputError, readable
from torchvision_dddas.io.atomic_files import cannot_write, claimed, write_whole
from torchvision_dddas.io.interrupts import is_stop
from torchvision_dddas.io.output import finite, versions
from torchvision_dddas.io.report.figure_files import save_figures
from torchvision_dddas.io.report.table_files import save_tables
from torchvision_dddas.lab.evaluation.datasets import kinds
from torchvision_dddas.lab.evaluation.datasets.record import Clip, DatasetSource
from torchvision_dddas.lab.evaluation.metrics.registry import GROUPS
from torchvision_dddas.lab.evaluation.report import study_report, study_tables
from torchvision_dddas.lab.evaluation.studies.cache import SCORES, Cache, cache_folder, code_digest, write_scores
from torchvision_dddas.lab.evaluation.studies.jobs import (
    Done,
    Job,
    JobEvent,
    Keys,
    OnEvent,
    Workers,
    find_cached,
    make_keys,
)
from torchvision_dddas.lab.evaluation.studies.records import TASKS, Case, Results, ScoredCase, Spec, Task
from torchvision_dddas.lab.evaluation.studies.stages import allowed_tasks
from torchvision_dddas.lab.evaluation.studies.summary import summarize, summarize_costs

FILES = ("metrics.json", "metrics.csv", "metrics.parquet", "frames.parquet", SCORES, "report.html", "run.json")
BACKENDS = ("auto", "torch", "onboard")

METRIC_COLUMNS = ("study", "task", "scope", "clip", "group", "measure", "value", "low", "high")
FRAME_COLUMNS = ("study", "task", "clip", "frame", "group", "name", "value")

_KEYS = ("name", "tasks", "config", "set", "backend", "interval", "dataset")
_NAME = re.compile(r"[\w][\w .+-]{0,99}")


def read_spec(path: Path) -> Spec:
    """Read a study's TOML file. Folders of data sets stay relative to the file's own folder.

    Raise InputError with one line for an unreadable file, an unknown or missing key, or a bad value.
    """
    content = read_toml(path, "study")
    where = f"study {path}"
    if unknown := [key for key in content if key not in _KEYS]:
        raise InputError(f"{where} has no key '{unknown[0]}'; wanted {', '.join(_KEYS)}")
    name = _text(content, "name", where, path.stem)
    if not is_name(name):
        raise InputError(f"{where}: name must consist of letters, digits, blanks, and . + - _, got {name!r}")
    tasks = _text(content, "tasks", where, [])
    if unknown := [task for task in tasks if task not in TASKS]:
        raise InputError(f"{where}: tasks must be some of {', '.join(TASKS)}, got '{unknown[0]}'")
    backend = _text(content, "backend", where, "auto")
    if backend not in BACKENDS:
        raise InputError(f"{where}: backend must be one of {', '.join(BACKENDS)}, got '{backend}'")
    interval = content.get("interval", 1)
    if type(interval) is not int or not 1 <= interval <= 1000:
        raise InputError(f"{where}: interval must be a whole number of frames from 1 to 1000, got {interval!r}")
    tables = content.get("dataset", [])
    if not isinstance(tables, list) or not tables or not all(isinstance(table, dict) for table in tables):
        raise InputError(f"{where} names no data set; wanted [[dataset]] with kind and folder, once or more")
    return Spec(
        name,
        tuple(_source(table, f"{where}, data set {k}") for k, table in enumerate(tables, 1)),
        tuple(task for task in TASKS if task in tasks),
        _text(content, "config", where, "") or None,
        tuple(_text(content, "set", where, [])),
        backend,
        interval,
    )


def is_name(text: str) -> bool:
    """Return whether a text can name a study and its folder."""
    return _NAME.fullmatch(text) is not None


def _source(table: Mapping[str, Any], where: str) -> DatasetSource:
    for key in ("kind", "folder"):
        if not _text(table, key, where, ""):
            raise InputError(f"{where} has no {key}; wanted kind = one of {', '.join(kinds.KINDS)}, and folder")
    try:
        kinds.check_kind(table["kind"])
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    patterns = tuple(_text(table, "clips", where, ["*"]))
    if not patterns:
        raise InputError(f'{where}: clips is empty; wanted patterns of names, as clips = ["cars*"], or leave it out')
    options = {key: value for key, value in table.items() if key not in ("kind", "folder", "clips")}
    return DatasetSource(table["kind"], Path(table["folder"]), patterns, options)


def _text(table: Mapping[str, Any], key: str, where: str, default: Any) -> Any:
    """Return a text, or a list of texts if the default is a list."""
    value, is_list = table.get(key, default), isinstance(default, list)
    if isinstance(value, list) != is_list or not all(isinstance(text, str) for text in (value if is_list else [value])):
        raise InputError(f"{where}: {key} must be {'a list of texts' if is_list else 'a text'}, got {value!r}")
    return value


@dataclass(frozen=True)
class StudyPlan:
    """The plan of a study. left_out: clips and tasks left out. notes: other missing data. facts: on the data sets."""

    settings: Settings
    jobs: tuple[Job, ...]
    left_out: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    facts: dict[str, Any] = field(default_factory=dict)

    @property
    def frames(self) -> int:
        """The number of frames of all tasks, as far as it is known."""
        return sum(map(_length, self.jobs))


def _length(job: Job) -> int:
    """Return the number of frames of a job over all its tasks; 0 if unknown."""
    clip = job.clip
    labelled = clip.truth.frames if clip.truth is not None else []
    pictures = len(clip.pictures) if len(clip.pictures) > 1 else 0
    return (clip.frames or pictures or (labelled[-1] if labelled else 0)) * len(job.tasks)


def plan_study(spec: Spec, base: Path, clips: Sequence[str] = ()) -> StudyPlan:
    """Read the data sets of a study. base: the folder to which their folders are relative. clips: patterns of names.

    Raise InputError for wrong settings, an unknown kind of data set or engine, and if no clip is left.
    """
    settings = load_config(spec.config, spec.overrides)
    backend = "onboard" if spec.backend == "auto" else spec.backend
    load_engine(backend, settings)
    if spec.interval < 1:
        raise InputError(f"the interval must be 1 or more frames, got {spec.interval}")
    jobs: dict[str, Job] = {}
    left_out: list[str] = []
    notes: list[str] = []
    names: list[str] = []
    sets: list[dict[str, Any]] = []
    for source in spec.sources:
        found = kinds.read(source, base)
        left_out += found.missing
        notes += found.notes
        names += [clip.name for clip in found.clips]
        sets.append({"kind": found.kind, "folder": found.folder, "terms": found.terms, "clips": len(found.clips)})
        for clip in found.clips:
            if clips and not any(fnmatchcase(clip.name, pattern) for pattern in clips):
                continue
            allowed = allowed_tasks(clip)
            tasks = tuple(task for task in TASKS if task in allowed and (not spec.tasks or task in spec.tasks))
            if clip.name in jobs:
                left_out.append(f"{clip.name} of {found.folder}: the study already has a clip of this name")
            elif tasks:
                jobs[clip.name] = Job(len(jobs), clip, tasks, settings, backend, spec.interval)
            else:
                left_out.append(f"{clip.name}: {_why_no_task(spec, clip, allowed)}")
    if not jobs:
        raise InputError(f"no clip is left to evaluate by {spec.name}{_why_no_clip(clips, names, left_out)}")
    facts = {"datasets": sets, "backend": backend, "code": code_digest(backend)}
    return StudyPlan(settings, tuple(jobs.values()), tuple(left_out), tuple(notes), facts)


def _why_no_task(spec: Spec, clip: Clip, allowed: Sequence[Task]) -> str:
    if clip.truth is None and not clip.still:
        return f"it has no truth ({clip.place})"
    return f"it allows {', '.join(allowed) or 'no task'}, and the study asks for {', '.join(spec.tasks)}"


def _why_no_clip(patterns: Sequence[str], names: Sequence[str], left_out: Sequence[str]) -> str:
    if patterns and names and not any(fnmatchcase(name, pattern) for name in names for pattern in patterns):
        more = f" and {len(names) - 9} more" if len(names) > 10 else ""
        listed = ", ".join(names[:9] if more else names)
        return f": {' and '.join(patterns)} {'fits' if len(patterns) == 1 else 'fit'} none; there are {listed}{more}"
    more = f" (and {len(left_out) - 1} more)" if len(left_out) > 1 else ""
    return f": {left_out[0]}{more}" if left_out else ""


def run_jobs(
    jobs: Sequence[Job], workers: Workers, cache: Cache, on_event: OnEvent = lambda event: None
) -> dict[int, tuple[Done, ...]]:
    """Do jobs, the longest first; return their outcomes by number. Results from the cache need no worker."""
    outcomes: dict[int, tuple[Done, ...]] = {}

    def collect_outcome(event: JobEvent) -> None:
        if event.done is not None:
            outcomes[event.job.number] = event.done
        on_event(event)

    def list_missing() -> Iterator[tuple[Job, Keys]]:
        for job in sorted(jobs, key=lambda job: (-_length(job), job.number)):
            keys = make_keys(job, cache.folder / "files")
            if (done := find_cached(job, keys, cache)) is not None:
                collect_outcome(JobEvent(job, done))
            else:
                yield job, keys

    workers.run(list_missing(), cache, collect_outcome)
    return outcomes


def run_study(
    spec: Spec,
    base: Path,
    workers: Workers | None = None,
    cache: Path | None = None,
    clips: Sequence[str] = (),
    on_event: OnEvent = lambda event: None,
    on_start: Callable[[StudyPlan], object] = lambda planned: None,
) -> Results:
    """Run a study.

    base: folder to which its folders are relative. workers: by default only this process. cache: the folder of results.
    clips: patterns of names; empty for all. on_start: called with the plan before the first job. Of these only the
    clips affect the results. Raise InputError as `plan_study` does, and if the workers cannot do the jobs.
    """
    planned = plan_study(spec, base, clips)
    store = Cache(cache or cache_folder())
    store.tidy()
    notes = list(planned.notes)

    def collect_note(event: JobEvent) -> None:
        if event.note:
            notes.append(event.note)
        on_event(event)

    on_start(planned)
    outcomes = run_jobs(planned.jobs, workers or Workers(1), store, collect_note)
    cases: list[Case] = []
    left_out = list(planned.left_out)
    faults, computed, kept = [], 0, 0
    for clip, done in ((job.clip, done) for job in planned.jobs for done in outcomes[job.number]):
        name, cause = clip.name, done.cause
        computed += len(done.computed)
        found, scored = (store.get(key) if key else None for key in (done.found, done.scored))
        if found is not None:
            notes += [str(InputError(f"{name}, {done.task}: {note}")) for note in found.notes]
        if not cause and (found is None or scored is None):
            cause = "its entry in the cache is gone or damaged; run the study again"
        cases.append(Case(clip, done.task, found, scored, cause))
        kept += not cause and not done.computed
        if cause:
            left_out.append(f"{name}, {done.task}: {cause}")
        if done.trace:
            faults.append({"clip": name, "task": done.task, "trace": done.trace})
    notes = list(dict.fromkeys([*notes, *store.notes]))
    facts = {**planned.facts, "computed": computed, "kept": kept, "notes": notes, "faults": faults}
    return Results(spec, planned.settings, tuple(cases), tuple(left_out), facts)


def write_study(
    folder: Path,
    spec: Spec,
    base: Path,
    workers: Workers | None = None,
    cache: Path | None = None,
    clips: Sequence[str] = (),
    on_event: OnEvent = lambda event: None,
    on_start: Callable[[StudyPlan], object] = lambda planned: None,
) -> tuple[Results, dict[str, Any]]:
    """Run a study as `run_study` does and write FILES into a folder; return its results and its measures.

    run.json states whether the study is running, complete or interrupted. Raise InputError as `run_study` does, and if
    the disk refuses. After bad input, the files of an earlier study in the folder are unchanged.
    """
    start_s, begun_s, place = time.perf_counter(), time.time(), cache or cache_folder()
    has_begun, finished = False, 0

    def count(event: JobEvent) -> None:
        nonlocal finished
        finished += event.done is not None
        on_event(event)

    def begin(planned: StudyPlan) -> None:
        nonlocal has_begun
        _write_json(folder / "run.json", {"state": "running", "study": spec.name})
        has_begun = True
        on_start(planned)

    with claimed(folder):
        try:
            results = run_study(spec, base, workers, place, clips, count, begin)
            measures = write_measures(folder, results)
            page = readable(study_report(finite(measures), results))
            write_whole(folder / "report.html", page.encode())
            save_figures(folder / "figures", page)
            save_tables(folder / "tables", study_tables(finite(measures)))
            study = {name: value for name, value in vars(spec).items() if name not in ("sources", "overrides")}
            record = {
                "state": "complete",
                "versions": versions(),
                "study": {**study, "set": spec.overrides},
                **results.facts,
                "left_out": results.left_out,
                "cache": place,
                "settings": results.settings.model_dump(),
                "seconds": {"wall": round(time.perf_counter() - start_s, 3)},
                "costs": summarize_costs(results),
            }
            _write_json(folder / "run.json", record)
        except BaseException as error:
            if has_begun:
                with suppress(OSError):
                    _write_json(folder / "run.json", {"state": "interrupted", "study": spec.name, "cache": place})
            if is_stop(error) and (finished or Cache(place).has_newer(begun_s)):
                clips = "1 finished clip is" if finished == 1 else f"{finished} finished clips are"
                kept = clips if finished else "finished stages are"
                error.add_note(f"{kept} kept in {place}; the same command goes on from there")
            if isinstance(error, OSError):
                raise cannot_write(folder / "run.json", error) from error
            raise
    return results, measures


def write_measures(folder: Path, results: Results) -> dict[str, Any]:
    """Write the measures of a study and its counts for comparisons, and return the measures. Raise OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    measures = summarize(results)
    _write_json(folder / "metrics.json", measures)
    write_csv(folder / "metrics.csv", measures)
    write_parquet(folder, measures, results)
    scored = [ScoredCase(c.task, c.clip.name, c.scored) for c in results.cases if c.scored is not None]
    write_scores(folder, results.spec.name, scored)
    return measures


def metric_rows(metrics: Mapping[str, Any]) -> list[tuple[Any, ...]]:
    """Return every figure of metrics.json in METRIC_COLUMNS.

    scope: clip, pooled or mean. clip: its name if the figure belongs to a clip. low, high: the interval, NaN if none.
    """
    rows = []
    for task, mine in metrics["tasks"].items():
        places = [("clip", name, clip) for name, clip in mine["clips"].items()]
        for scope, name, groups in (*places, ("pooled", "", mine["pooled"]), ("mean", "", mine["mean"])):
            spans = groups.get("intervals", {})
            for group in GROUPS:
                for measure, value in groups.get(group, {}).items():
                    low, high = spans.get(group, {}).get(measure) or (math.nan, math.nan)
                    known = math.nan if value is None else float(value)
                    rows.append((metrics["name"], task, scope, name, group, measure, known, low, high))
    return rows


def frame_rows(results: Results) -> Iterator[tuple[Any, ...]]:
    """Yield every count of every frame in FRAME_COLUMNS, by task and clip, without frames that a group does not use."""
    for case in sorted(results.cases, key=lambda case: (case.task, case.clip.name)):
        if case.scored is None:
            continue
        frames = case.scored.frames.tolist()
        for group, counts in case.scored.per_frame.items():
            for name, values in counts.items():
                for frame, value in zip(frames, values.tolist(), strict=True):
                    if not math.isnan(value):
                        yield results.spec.name, case.task, case.clip.name, frame, group, name, value


def write_csv(path: Path, metrics: Mapping[str, Any]) -> None:
    """Write metrics.csv. A cell is empty if its figure is undefined. Raise OSError."""
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(METRIC_COLUMNS)
    for row in metric_rows(metrics):
        table.writerow(["" if value != value else value for value in row])  # only NaN differs from itself
    write_whole(path, text.getvalue().encode())


def write_parquet(folder: Path, metrics: Mapping[str, Any], results: Results) -> None:
    """Write metrics.parquet and frames.parquet; nothing without pyarrow. Raise OSError."""
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        return
    types = {"frame": pyarrow.int64(), **dict.fromkeys(("value", "low", "high"), pyarrow.float64())}
    for name, columns, rows in (
        ("metrics.parquet", METRIC_COLUMNS, metric_rows(metrics)),
        ("frames.parquet", FRAME_COLUMNS, frame_rows(results)),
    ):
        schema = pyarrow.schema([(column, types.get(column, pyarrow.string())) for column in columns])
        table = pyarrow.Table.from_pylist([dict(zip(columns, row, strict=True)) for row in rows], schema)
        held = io.BytesIO()
        pyarrow.parquet.write_table(table, held)
        write_whole(folder / name, held.getvalue())


def _write_json(path: Path, content: Any) -> None:
    write_whole(path, (json.dumps(finite(content), indent=2) + "\n").encode())
