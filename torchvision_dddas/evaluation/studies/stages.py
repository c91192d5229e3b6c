"""The stages that process one clip, each as its own command does: motion, tracking, association, people, location."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np

from torchvision_dddas import geo
from torchvision_dddas.config import Settings
from torchvision_dddas.detection import detect_motion, load_engine
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.results import Found, round_as_written
from torchvision_dddas.evaluation.studies.spec import Task
from torchvision_dddas.geo.ground_locator import GroundLocator
from torchvision_dddas.io.camera_files import read_camera
from torchvision_dddas.io.detection_tables import check_table, read_detections
from torchvision_dddas.io.images import IMAGE_SUFFIXES, ImageSource
from torchvision_dddas.io.run_inputs import AerialInput, prepare_run, read_locator
from torchvision_dddas.io.sources import open_source
from torchvision_dddas.people.detector import detect_in_clip, load_scorer
from torchvision_dddas.pipeline import Pipeline
from torchvision_dddas.tracking import track_clip, track_scenes, track_table
from torchvision_dddas.types import (
    AerialLocations,
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

_MOTION = ("registration", "interval", "difference", "morphology", "refine", "persistence", "small", "history", "gates")
_TRACKING = ("track", "paper")

PARAMETER_GROUPS: Mapping[Task, tuple[str, ...]] = {
    "motion": _MOTION,
    "tracking": ("registration", *_TRACKING),
    "association": ("registration", *_TRACKING),
    "people": ("people",),
    "location": (*_MOTION, *_TRACKING, "people", "ground", "landmarks", "aerial", "crowds"),
}
"""The groups of settings that each stage depends on by itself. It gets the defaults of all others."""

_FILES: Mapping[Task, tuple[str, ...]] = {
    "motion": ("pictures",),
    "tracking": ("pictures", "given"),
    "association": ("pictures",),
    "people": ("pictures",),
    "location": ("pictures", "given", "telemetry", "landmarks", "colours", "camera", "elevation"),
}
"""The files of a clip that each stage reads."""

_SHUFFLE_SEED = 7  # the order of true boxes within their frames must not reveal their identities


def find(
    clip: Clip,
    task: Task,
    settings: Settings,
    backend: str = "auto",
    interval: int = 1,
    before: Found | None = None,
    on_frame: OnFrame = lambda: None,
) -> Found:
    """Run a stage on a clip. before: the result of `upstream_task`. on_frame: called once per frame.

    Raises InputError if the clip's files are unusable.
    """
    peak, start = _PeakMemory(), time.perf_counter()
    rows = STAGES[task](_Job(clip, narrow_settings(settings, task), backend, interval, before, on_frame))
    rows.seconds["other"] = time.perf_counter() - start - sum(rows.seconds.values())
    return rows.found(peak.read_mb())


def allowed_tasks(clip: Clip) -> tuple[Task, ...]:
    """The tasks that a clip's pictures and truth allow, each after those that it depends on."""
    truth, pictures, moves = clip.truth, bool(clip.pictures), "movers" in clip.shows
    tasks: list[Task] = []
    if pictures and moves and (clip.still or truth is not None):
        tasks.append("motion")
    if truth is None:
        return tuple(tasks)
    if truth.tracks is not None and ((pictures and moves) or clip.given is not None):
        tasks.append("tracking")
    if truth.tracks is not None and truth.kind != "one target":
        tasks.append("association")
    if pictures and "people" in clip.shows and truth.kind == "boxes":
        tasks.append("people")
    placed = clip.landmarks is not None or clip.camera is not None
    if truth.positions is not None and placed and ((pictures and clip.landmarks) or clip.given is not None):
        tasks.append("location")
    return tuple(tasks)


def upstream_task(clip: Clip, task: Task) -> Task | None:
    """The task whose result a task depends on; None if there is none."""
    return "motion" if task == "tracking" and bool(clip.pictures) and "movers" in clip.shows else None


def narrow_settings(settings: Settings, task: Task) -> Settings:
    """The settings that a stage gets: defaults for all groups that its key in the cache does not hold."""
    return Settings().model_copy(update={group: getattr(settings, group) for group in PARAMETER_GROUPS[task]})


def files_of(clip: Clip, task: Task) -> list[Path]:
    """The files that a stage reads."""
    values = [getattr(clip, name) for name in _FILES[task]]
    return [path for value in values for path in (value if isinstance(value, tuple) else (value,)) if path is not None]


def open_clip(clip: Clip) -> Source:
    """Open the pictures of a clip. Raises InputError if they cannot be read."""
    if not clip.pictures:
        raise InputError(f"{clip.name} has no pictures: {clip.place}")
    if len(clip.pictures) == 1 and clip.pictures[0].suffix.lower() not in IMAGE_SUFFIXES:
        return open_source(clip.pictures[0], rate_hz=clip.rate_hz)
    return ImageSource(clip.pictures, clip.name, clip.rate_hz or 10.0)


def labelled_frames(clip: Clip) -> set[int]:
    """The frames whose masks are kept: those for which the truth labels pixels."""
    truth = clip.truth
    return set() if truth is None or truth.kind == "boxes" else set(truth.frames)


def true_boxes(clip: Clip, interval: int) -> DetectionTable:
    """The true boxes of each interval-th frame as certain detections. Raises InputError if there are none."""
    assert clip.truth is not None and clip.truth.tracks is not None, "allowed_tasks() asks for tracks"
    table = clip.truth.tracks.every(interval)
    if not len(table.frame):
        raise InputError(f"{clip.truth.place} has no box on frames 1, {1 + interval}, {1 + 2 * interval}, ...")
    order = np.random.default_rng(_SHUFFLE_SEED).permutation(len(table.frame))
    order = order[np.argsort(table.frame[order], kind="stable")]
    frame, box_px = table.frame[order], np.asarray(table.box_px, float)[order]
    return DetectionTable(clip.name, frame, box_px, np.ones(len(frame)), np.arange(1, len(frame) + 1))


def replay_scenes(clip: Clip, found: Found) -> Iterator[Scene]:
    """The scenes of a clip as the detector gave them, without their masks. The pictures are read again."""
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
        here = slice(*np.searchsorted(found.frame, [number, number + 1]))
        area_px, heading_rad, speed_px, middle_px = (
            found.more[name][here] for name in ("area_px", "heading_rad", "speed_px", "middle_px")
        )
        step = None
        if number in found.steps:
            step = Registration(found.steps[number], 0, 0, float("nan"), float("nan"))
        detections = Detections(
            found.box_px[here], found.score[here], area_px, heading_rad, speed_px, middle_px=middle_px
        )
        yield Scene(frame, np.zeros((0, 0), np.uint16), detections, 0, step=step)


@dataclass
class Rows:
    """The results of a stage so far, frame by frame; the fields of `Found`."""

    looked: list[int] = field(default_factory=list)
    columns: dict[str, list[np.ndarray]] = field(default_factory=dict)
    masks: dict[int, bytes] = field(default_factory=dict)
    steps: dict[int, np.ndarray] = field(default_factory=dict)
    seconds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)

    def add(self, number: int, seconds: Mapping[str, float], **columns: np.ndarray) -> None:
        """Add the boxes of a frame, one row each, in columns of one length."""
        self.looked.append(number)
        for stage, spent in seconds.items():
            self.seconds[stage] = self.seconds.get(stage, 0.0) + spent
        count = len(columns["box_px"])
        default = {
            "frame": np.full(count, number),
            "identity": np.full(count, -1),
            "east_north_m": np.full((count, 2), np.nan),
            "covariance_m2": np.full((count, 2, 2), np.nan),
        }
        for name, column in (default | columns).items():
            self.columns.setdefault(name, []).append(column)

    def found(self, peak_mb: float) -> Found:
        """The result of all frames."""
        shapes = {"frame": (0,), "box_px": (0, 4), "score": (0,), "identity": (0,)}
        shapes |= {"east_north_m": (0, 2), "covariance_m2": (0, 2, 2)}
        columns = {name: np.zeros(shape) for name, shape in shapes.items()}
        columns |= {name: np.concatenate(parts) for name, parts in self.columns.items()}
        for name, kind in (("frame", np.int64), ("identity", np.int64), ("box_px", float), ("score", float)):
            columns[name] = columns[name].astype(kind)
        return Found(
            **{name: columns.pop(name) for name in shapes},
            looked=np.array(self.looked, np.int64),
            masks=self.masks,
            steps=self.steps,
            more=columns,
            seconds=self.seconds,
            peak_mb=peak_mb,
            notes=tuple(self.notes),
        )


@dataclass(frozen=True)
class _Job:
    """The input of a stage; see `find`."""

    clip: Clip
    settings: Settings
    backend: str
    interval: int
    before: Found | None
    on_frame: OnFrame


def _find_motion(job: _Job) -> Rows:
    """Moving targets: `dddas detect`."""
    source, rows, causes = open_clip(job.clip), Rows(), dict[int, str]()
    labelled = labelled_frames(job.clip)
    for scene in detect_motion(source, job.settings, job.backend):
        number, found = scene.frame.number, scene.detections
        more = {"area_px": found.area_px, "heading_rad": found.heading_rad, "speed_px": found.speed_px}
        rows.add(number, scene.seconds, box_px=found.box_px, score=found.score, middle_px=found.middle_px, **more)
        if number in labelled:
            # One bit would be enough; the numbers of the targets cost little more, and reports show them.
            mask = np.minimum(scene.mask, 255).astype(np.uint8)
            rows.masks[number] = cv2.imencode(".png", mask, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()
        if scene.step is not None and scene.step.reliable:
            rows.steps[number] = scene.step.later_from_earlier
        if not scene.reliable:
            causes[number] = scene.cause
        job.on_frame()
    if causes:
        first = min(causes)
        rows.notes.append(f"{len(causes)} frames with unreliable registration, first {first}: {causes[first]}")
    rows.notes += map(str, source.problems)
    return rows


def _find_tracks(job: _Job) -> Rows:
    """Identities: `dddas track CLIP`, or of the data set's own detections."""
    if upstream_task(job.clip, "tracking") is not None:
        assert job.before is not None, "tracking needs the result of motion"
        scenes, size = replay_scenes(job.clip, job.before), open_clip(job.clip).size
        return _rows_of_tracks(track_scenes(scenes, job.settings, job.interval, size, False), job.on_frame)
    assert job.clip.given is not None, "allowed_tasks() asks for detections"
    return _track_table(job, read_detections(job.clip.given))


def _find_associations(job: _Job) -> Rows:
    """Identities of the true boxes."""
    return _track_table(job, true_boxes(job.clip, job.interval))


def _find_people(job: _Job) -> Rows:
    """People by their shape: `dddas people`."""
    source, rows = open_clip(job.clip), Rows()
    for here in detect_in_clip(source, load_scorer(job.settings.people, job.backend), job.settings):
        people = here.people
        rows.add(here.frame.number, here.seconds, box_px=round_as_written(people.box_px), score=people.score)
        job.on_frame()
    rows.notes += map(str, source.problems)
    return rows


def _find_locations(job: _Job) -> Rows:
    """Places on the ground: `dddas run`, or `dddas locate` of the data set's own detections."""
    if job.clip.landmarks is None:
        return _locate_from_ground(job)
    files = AerialInput(
        job.clip.landmarks, job.clip.telemetry, job.clip.camera, job.clip.elevation, None, job.clip.colours
    )
    return _locate_along(job, files) if job.clip.pictures else _locate_table(job, files)


STAGES: Mapping[Task, Callable[[_Job], Rows]] = {
    "motion": _find_motion,
    "tracking": _find_tracks,
    "association": _find_associations,
    "people": _find_people,
    "location": _find_locations,
}


def _track_table(job: _Job, table: DetectionTable) -> Rows:
    """Track the boxes of a table, with the clip's pictures where it has any."""
    if not job.clip.pictures:
        notes = check_table(table, job.interval)
        rows = _rows_of_tracks(track_table(table, job.settings, job.interval), job.on_frame)
    else:
        source = open_clip(job.clip)
        notes = check_table(table, job.interval, source)
        engine = load_engine(job.backend, job.settings)
        rows = _rows_of_tracks(track_clip(source, table, engine, job.settings, job.interval), job.on_frame)
        notes += map(str, source.problems)
    rows.notes += notes
    return rows


def _rows_of_tracks(frames: Iterable[TrackedFrame], on_frame: OnFrame) -> Rows:
    rows = Rows()
    for here in frames:
        tracks, box_px = here.tracks, round_as_written(here.tracks.box_px)
        rows.add(here.number, here.seconds, box_px=box_px, score=tracks.score, identity=tracks.identity)
        on_frame()
    return rows


def _locate_along(job: _Job, files: AerialInput) -> Rows:
    source, rows = open_clip(job.clip), Rows()
    ready = prepare_run(files, job.clip.telemetry, job.settings, source, job.backend, str(job.clip.pictures[0]))
    pipeline = Pipeline.from_parts(
        ready.engine, ready.settings, ready.flight, ready.watch, job.interval, pictures=False
    )
    for result in pipeline(source):
        tracks, located = result.tracked.tracks, result.locations
        seen = tracks.row >= 0
        columns = {"box_px": tracks.box_px[seen], "identity": tracks.identity[seen], "score": tracks.score[seen]}
        seconds = result.tracked.seconds if located is None else located.seconds
        rows.add(result.tracked.number, seconds, **_with_places(columns, located))
        job.on_frame()
    rows.notes += [*ready.notes, *map(str, source.problems)]
    return rows


def _locate_table(job: _Job, files: AerialInput) -> Rows:
    if job.clip.given is None:
        raise InputError(f"{job.clip.place} has no pictures and no detections: there is nothing to locate")
    rows, table = Rows(), read_detections(job.clip.given)
    span = (table.first, table.last)
    locator, notes = read_locator(
        files, job.settings, None, job.clip.rate_hz, job.backend, span, "table", None, extent=table.extent
    )
    geo.check_table(table, locator)
    for located in locator.locate_table(table):
        here = table.rows(located.frame)
        identity = np.full(here.stop - here.start, -1) if table.identity is None else table.identity[here]
        columns = {"box_px": located.box_px, "identity": identity, "score": table.score[here].clip(0, 1)}
        rows.add(located.frame, located.seconds, **_with_places(columns, located))
        job.on_frame()
    rows.notes += notes
    return rows


def _locate_from_ground(job: _Job) -> Rows:
    clip = job.clip
    if clip.given is None or clip.camera is None:
        raise InputError(f"{clip.place} has no detections and camera: locating from the ground needs both")
    rows, table = Rows(), read_detections(clip.given)
    locator = GroundLocator(read_camera(clip.camera), job.settings, rate_hz=clip.rate_hz)
    for found in locator.locate_tables([table]):
        count, here = len(found.box_px), found.sightings.by != "bearing"
        identity = np.full(count, -1) if table.identity is None else table.identity[table.rows(found.frame)]
        columns = {"box_px": round_as_written(found.box_px), "score": found.score.clip(0, 1), "identity": identity}
        rows.add(found.frame, {}, **columns, **_place_columns(count, np.flatnonzero(here), found.positions))
        job.on_frame()
    return rows


def _with_places(columns: dict[str, np.ndarray], located: AerialLocations | None) -> dict[str, np.ndarray]:
    """The columns of a frame's targets, with the places of those that were located."""
    count = len(columns["box_px"])
    row = np.zeros(0, np.int64) if located is None else located.row
    places = _place_columns(count, row, Positions() if located is None else located.positions)
    places["relative_m2"] = np.full((count, 2, 2), np.nan)
    if located is not None:
        places["relative_m2"][row] = located.relative_m2
    return {**columns, "box_px": round_as_written(columns["box_px"]), **places}


def _place_columns(count: int, row: np.ndarray, found: Positions) -> dict[str, np.ndarray]:
    """The columns of places of a frame's boxes. row: the box of each position."""
    shapes = {"east_north_m": (2,), "covariance_m2": (2, 2), "lonlat_deg": (2,)}
    places = {name: np.full((count, *shape), np.nan) for name, shape in shapes.items()}
    places["east_north_m"][row], places["covariance_m2"][row] = found.east_north_m, found.covariance_m2
    if found.lonlat_deg is not None:
        places["lonlat_deg"][row] = found.lonlat_deg
    return places


class _PeakMemory:
    """The peak memory of this process since this object was made, or since its start on some systems."""

    def __init__(self) -> None:
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5", encoding="ascii")

    def read_mb(self) -> float:
        """The peak in units of 2**20 bytes; NaN where the system does not report it."""
        with suppress(OSError, ValueError, StopIteration):
            lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
            return int(next(line for line in lines if line.startswith("VmHWM")).split()[1]) / 1024
        try:
            import resource
        except ImportError:
            return float("nan")
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / 2**20 if sys.platform == "darwin" else peak / 1024
