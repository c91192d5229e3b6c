"""The stages that process one clip as their own commands do: motion, tracking, association, people, location."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas import geo
from torchvision_dddas.config import Settings
from torchvision_dddas.detection import detect_motion, load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo import GroundLocator
from torchvision_dddas.io.camera_files import read_camera
from torchvision_dddas.io.detection_tables import check_table, read_detections
from torchvision_dddas.io.images import IMAGE_SUFFIXES
from torchvision_dddas.io.sources import ImageSource, open_source
from torchvision_dddas.lab.evaluation.datasets.record import Clip
from torchvision_dddas.lab.evaluation.studies.records import Findings, Task, round_as_written
from torchvision_dddas.memory import peak_memory_mb, reset_peak_memory
from torchvision_dddas.people import detect_in_clip, load_scorer
from torchvision_dddas.pipeline import AerialInput, Pipeline, assemble_files, read_locator
from torchvision_dddas.tracking import track_clip, track_scenes, track_table
from torchvision_dddas.types import (
    Detections,
    DetectionTable,
    Frame,
    Positions,
    Registration,
    Scene,
    Source,
    TrackedFrame,
)

OnFrame = Callable[[], object]

_MOTION = (
    "registration",
    "interval",
    "difference",
    "morphology",
    "refine",
    "tracklets",
    "small",
    "history",
    "gates",
)
_TRACKING = ("track", "paper")

PARAMETER_GROUPS: Mapping[Task, tuple[str, ...]] = {
    "motion": _MOTION,
    "tracking": ("registration", *_TRACKING),
    "association": ("registration", *_TRACKING),
    "people": ("people",),
    "location": (*_MOTION, *_TRACKING, "people", "ground", "landmarks", "aerial", "crowds"),
}
"""The groups of settings that each stage itself depends on. All other groups have their defaults."""

_FILES: Mapping[Task, tuple[str, ...]] = {
    "motion": ("pictures",),
    "tracking": ("pictures", "given"),
    "association": ("pictures",),
    "people": ("pictures",),
    "location": ("pictures", "given", "telemetry", "landmarks", "colours", "camera", "elevation"),
}

_COLUMNS = {
    "frame": np.zeros(0, np.int64),
    "box_px": np.zeros((0, 4)),
    "score": np.zeros(0),
    "identity": np.zeros(0, np.int64),
    "east_north_m": np.zeros((0, 2)),
    "covariance_m2": np.zeros((0, 2, 2)),
}
"""The columns of every `Findings`, and their types. Other columns go to `more`."""

_SHUFFLE_SEED = 7  # the order of true boxes within a frame must not reveal their identities


def find(
    clip: Clip,
    task: Task,
    settings: Settings,
    backend: str = "auto",
    interval: int = 1,
    before: Findings | None = None,
    on_frame: OnFrame = lambda: None,
) -> Findings:
    """Run a stage on a clip. before: the result of `upstream_task`. on_frame: called once per frame.

    Raise InputError if the clip's files are unusable.
    """
    reset_peak_memory()
    start, run = (
        time.perf_counter(),
        _StageRun(clip, narrow_settings(settings, task), backend, interval, before, on_frame),
    )
    STAGES[task](run)
    run.seconds["other"] = time.perf_counter() - start - sum(run.seconds.values())
    more = {name: np.concatenate(parts) for name, parts in run.columns.items()}
    return Findings(
        **{name: more.pop(name, empty).astype(empty.dtype) for name, empty in _COLUMNS.items()},
        looked=np.array(run.looked, np.int64),
        masks=run.masks,
        steps=run.steps,
        more=more,
        seconds=dict(run.seconds),
        peak_mb=peak_memory_mb(),
        notes=tuple(run.notes),
    )


def allowed_tasks(clip: Clip) -> tuple[Task, ...]:
    """Return the tasks that a clip's pictures and truth allow, each after the tasks that it depends on."""
    truth, has_pictures = clip.truth, bool(clip.pictures)
    shows_movers = has_pictures and "movers" in clip.shows
    tasks: list[Task] = []
    if shows_movers and (clip.still or truth is not None):
        tasks.append("motion")
    if truth is None:
        return tuple(tasks)
    if truth.tracks is not None and (shows_movers or clip.given is not None):
        tasks.append("tracking")
    if truth.tracks is not None and truth.kind != "one target":
        tasks.append("association")
    if has_pictures and "people" in clip.shows and truth.kind == "boxes":
        tasks.append("people")
    placed = clip.landmarks is not None or clip.camera is not None
    if truth.positions is not None and placed and ((has_pictures and clip.landmarks) or clip.given is not None):
        tasks.append("location")
    return tuple(tasks)


def upstream_task(clip: Clip, task: Task) -> Task | None:
    """Return the task whose result a task depends on; None if there is none."""
    return "motion" if task == "tracking" and bool(clip.pictures) and "movers" in clip.shows else None


def narrow_settings(settings: Settings, task: Task) -> Settings:
    """Return the settings of a stage. Groups that are not part of the stage's cache key get their defaults."""
    return Settings().model_copy(update={group: getattr(settings, group) for group in PARAMETER_GROUPS[task]})


def files_of(clip: Clip, task: Task) -> list[Path]:
    """Return the files that a stage reads."""
    values = [getattr(clip, name) for name in _FILES[task]]
    return [path for value in values for path in (value if isinstance(value, tuple) else (value,)) if path is not None]


def open_clip(clip: Clip) -> Source:
    """Open the pictures of a clip. Raise InputError if they cannot be read."""
    if not clip.pictures:
        raise InputError(f"{clip.name} has no pictures: {clip.place}")
    if len(clip.pictures) == 1 and clip.pictures[0].suffix.lower() not in IMAGE_SUFFIXES:
        return open_source(clip.pictures[0], rate_hz=clip.rate_hz)
    return ImageSource(clip.pictures, clip.name, clip.rate_hz or 10.0)


def labelled_frames(clip: Clip) -> set[int]:
    """Return the frames whose masks are kept, because the truth labels their pixels."""
    truth = clip.truth
    return set() if truth is None or truth.kind == "boxes" else set(truth.frames)


def true_boxes(clip: Clip, interval: int) -> DetectionTable:
    """Return the true boxes of each interval-th frame as certain detections. Raise InputError if there are none."""
    assert clip.truth is not None and clip.truth.tracks is not None, "allowed_tasks() asks for tracks"
    table = clip.truth.tracks.every(interval)
    if not len(table.frame):
        raise InputError(f"{clip.truth.place} has no box on frames 1, {1 + interval}, {1 + 2 * interval}, ...")
    order = np.random.default_rng(_SHUFFLE_SEED).permutation(len(table.frame))
    order = order[np.argsort(table.frame[order], kind="stable")]
    frame, box_px = table.frame[order], np.asarray(table.box_px, float)[order]
    return DetectionTable(clip.name, frame, box_px, np.ones(len(frame)), np.arange(1, len(frame) + 1))


def replay_scenes(clip: Clip, found: Findings) -> Iterator[Scene]:
    """Yield the scenes of a clip as the detector gave them, without their masks. The pictures are read again."""
    source = open_clip(clip)
    shape: tuple[int, ...] = (source.size[1], source.size[0])
    pictures = iter(source)
    picture = next(pictures, None)
    for number in found.looked.tolist():
        while picture is not None and picture.number < number:
            picture = next(pictures, None)
        frame = Frame(number, (number - 1) / source.rate_hz, np.zeros(shape, np.uint8))
        if picture is not None and picture.number == number:
            frame, shape = picture, picture.image.shape
        rows = slice(*np.searchsorted(found.frame, [number, number + 1]))
        names = ("area_px", "heading_rad", "speed_px", "middle_px")
        columns: dict[str, Any] = {name: found.more[name][rows] for name in names}
        step = None
        if number in found.steps:
            step = Registration(found.steps[number], 0, 0, float("nan"), float("nan"))
        detections = Detections(found.box_px[rows], found.score[rows], **columns)
        yield Scene(frame, np.zeros((0, 0), np.uint16), detections, 0, step=step)


@dataclass
class _StageRun:
    """The input of a stage, see `find`, and its results so far, frame by frame."""

    clip: Clip
    settings: Settings
    backend: str
    interval: int
    before: Findings | None
    on_frame: OnFrame
    looked: list[int] = field(default_factory=list)
    columns: dict[str, list[np.ndarray]] = field(default_factory=lambda: defaultdict(list))
    masks: dict[int, bytes] = field(default_factory=dict)
    steps: dict[int, np.ndarray] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=lambda: defaultdict(float))
    notes: list[str] = field(default_factory=list)

    def add(self, number: int, seconds: Mapping[str, float], **columns: np.ndarray) -> None:
        """Add the boxes of a frame, one row each, in columns of one length."""
        self.looked.append(number)
        for stage, spent in seconds.items():
            self.seconds[stage] += spent
        count = len(columns["box_px"])
        default = {
            "frame": np.full(count, number),
            "identity": np.full(count, -1),
            "east_north_m": np.full((count, 2), np.nan),
            "covariance_m2": np.full((count, 2, 2), np.nan),
        }
        for name, column in (default | columns).items():
            self.columns[name].append(column)
        self.on_frame()


def _find_motion(run: _StageRun) -> None:
    """Find moving targets, as `dddas detect` does."""
    source, labelled, causes = open_clip(run.clip), labelled_frames(run.clip), dict[int, str]()
    for scene in detect_motion(source, run.settings, run.backend):
        number = scene.frame.number
        names = ("box_px", "score", "middle_px", "area_px", "heading_rad", "speed_px")
        run.add(number, scene.seconds, **{name: getattr(scene.detections, name) for name in names})
        if number in labelled:
            # One bit would suffice, but the numbers of the targets cost little more, and reports show them.
            mask = np.minimum(scene.mask, 255).astype(np.uint8)
            run.masks[number] = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        if scene.step is not None and scene.step.reliable:
            run.steps[number] = scene.step.later_from_earlier
        if not scene.reliable:
            causes[number] = scene.cause
    if causes:
        first = min(causes)
        run.notes.append(f"{len(causes)} frames with unreliable registration, first {first}: {causes[first]}")
    run.notes += map(str, source.problems)


def _find_tracks(run: _StageRun) -> None:
    """Find identities as `dddas track CLIP` does, or identities of the data set's own detections."""
    if upstream_task(run.clip, "tracking") is not None:
        assert run.before is not None, "tracking needs the result of motion"
        scenes, size = replay_scenes(run.clip, run.before), open_clip(run.clip).size
        _add_tracks(run, track_scenes(scenes, run.settings, run.interval, size, False, run.backend))
    else:
        assert run.clip.given is not None, "allowed_tasks() asks for detections"
        _track_table(run, read_detections(run.clip.given))


def _find_associations(run: _StageRun) -> None:
    """Find identities of the true boxes."""
    _track_table(run, true_boxes(run.clip, run.interval))


def _track_table(run: _StageRun, table: DetectionTable) -> None:
    """Track the boxes of a table, with the clip's pictures if it has any."""
    if not run.clip.pictures:
        run.notes += check_table(table, run.interval)
        _add_tracks(run, track_table(table, run.settings, run.interval))
        return
    source = open_clip(run.clip)
    run.notes += check_table(table, run.interval, source)
    engine = load_engine(run.backend, run.settings)
    _add_tracks(run, track_clip(source, table, engine, run.settings, run.interval, run.backend))
    run.notes += map(str, source.problems)


def _add_tracks(run: _StageRun, frames: Iterable[TrackedFrame]) -> None:
    for result in frames:
        tracks = result.tracks
        box_px = round_as_written(tracks.box_px)
        run.add(result.number, result.seconds, box_px=box_px, score=tracks.score, identity=tracks.identity)


def _find_people(run: _StageRun) -> None:
    """Find people by their shape, as `dddas people` does."""
    source = open_clip(run.clip)
    for result in detect_in_clip(source, load_scorer(run.settings.people, run.backend), run.settings):
        box_px = round_as_written(result.people.box_px)
        run.add(result.frame.number, result.seconds, box_px=box_px, score=result.people.score)
    run.notes += map(str, source.problems)


def _find_locations(run: _StageRun) -> None:
    """Find places on the ground as `dddas run` does, or as `dddas locate` does for the data set's own detections."""
    clip = run.clip
    if clip.landmarks is None:
        _locate_from_ground(run)
        return
    if clip.pictures:
        _locate_clip(run)
    else:
        _locate_table(run)


def _aerial_input(clip: Clip) -> AerialInput:
    """Return the files that are needed to locate from the air."""
    assert clip.landmarks is not None
    return AerialInput(clip.landmarks, clip.telemetry, clip.camera, clip.elevation, None, clip.colours)


def _locate_clip(run: _StageRun) -> None:
    clip, source = run.clip, open_clip(run.clip)
    aerial = _aerial_input(clip)
    ready = assemble_files(aerial, clip.telemetry, run.settings, source, run.backend, str(clip.pictures[0]))
    for result in Pipeline.from_assembly(ready, interval=run.interval, pictures=False)(source):
        tracks, located = result.tracked.tracks, result.locations
        seen = tracks.row >= 0
        columns = {"box_px": round_as_written(tracks.box_px[seen]), "identity": tracks.identity[seen]}
        found = () if located is None else (located.row, located.positions, located.relative_m2)
        seconds = result.tracked.seconds if located is None else located.seconds
        columns |= {"score": tracks.score[seen], **_place_columns(int(seen.sum()), *found)}
        run.add(result.tracked.number, seconds, **columns)
    run.notes += [*ready.notes, *map(str, source.problems)]


def _locate_table(run: _StageRun) -> None:
    clip = run.clip
    if clip.given is None:
        raise InputError(f"{clip.place} has no pictures and no detections: there is nothing to locate")
    table = read_detections(clip.given)
    aerial, span = _aerial_input(clip), (table.first, table.last)
    locator, notes = read_locator(
        aerial, run.settings, None, clip.rate_hz, run.backend, span, "table", None, extent=table.extent
    )
    geo.check_table(table, locator)
    for located in locator.locate_table(table):
        places = _place_columns(len(located.box_px), located.row, located.positions, located.relative_m2)
        score = table.score[table.rows(located.frame)]
        run.add(located.frame, located.seconds, **_given_columns(table, located.frame, located.box_px, score), **places)
    run.notes += notes


def _locate_from_ground(run: _StageRun) -> None:
    clip = run.clip
    if clip.given is None or clip.camera is None:
        raise InputError(f"{clip.place} has no detections and camera: locating from the ground needs both")
    table = read_detections(clip.given)
    locator = GroundLocator(read_camera(clip.camera), settings=run.settings, rate_hz=clip.rate_hz)
    for located in locator.locate_tables([table]):
        rows = np.flatnonzero(located.sightings.by != "bearing")
        places = _place_columns(len(located.box_px), rows, located.positions)
        run.add(located.frame, {}, **_given_columns(table, located.frame, located.box_px, located.score), **places)


def _given_columns(table: DetectionTable, frame: int, box_px: np.ndarray, score: np.ndarray) -> dict[str, np.ndarray]:
    """Return the columns of a frame's given detections."""
    identity = np.full(len(box_px), -1) if table.identity is None else table.identity[table.rows(frame)]
    return {"box_px": round_as_written(box_px), "score": score.clip(0, 1), "identity": identity}


def _place_columns(
    count: int, row: np.ndarray | None = None, found: Positions | None = None, relative_m2: np.ndarray | None = None
) -> dict[str, np.ndarray]:
    """Return the columns of places of a frame's boxes, NaN if not located. row: the box of each position."""
    shapes = {"east_north_m": (2,), "covariance_m2": (2, 2), "lonlat_deg": (2,), "relative_m2": (2, 2)}
    places = {name: np.full((count, *shape), np.nan) for name, shape in shapes.items()}
    for name, column in places.items() if found is not None else ():
        if (values := getattr(found, name, relative_m2)) is not None:
            column[row] = values
    return places


STAGES: Mapping[Task, Callable[[_StageRun], None]] = {
    "motion": _find_motion,
    "tracking": _find_tracks,
    "association": _find_associations,
    "people": _find_people,
    "location": _find_locations,
}
