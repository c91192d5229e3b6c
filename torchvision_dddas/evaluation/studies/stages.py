"""The work on one clip: what moves, who is who, people, places on the ground; each stage as its own command does it."""

import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from torchvision_dddas.config import Settings
from torchvision_dddas.errors import InputError
from torchvision_dddas.evaluation.datasets.record import Clip
from torchvision_dddas.evaluation.studies.memory import Peak
from torchvision_dddas.evaluation.studies.record import Found, Task
from torchvision_dddas.evaluation.studies.rows import Rows, Tick, followed_kept, scenes_kept, written
from torchvision_dddas.types import Detections, Frame, Registration, Scene

if TYPE_CHECKING:
    from torchvision_dddas.types import DetectionTable, Source

_SEES = ("registration", "interval", "difference", "morphology", "refine", "persistence", "small", "history", "gates")
_FOLLOWS = ("track", "paper")

KNOBS: Mapping[Task, tuple[str, ...]] = {
    "motion": _SEES,
    "tracking": ("registration", *_FOLLOWS),
    "association": ("registration", *_FOLLOWS),
    "people": ("people",),
    "location": (*_SEES, *_FOLLOWS, "people", "ground", "landmarks", "aerial", "crowds"),
}
"""The groups of settings that each stage depends on by itself; it is given the defaults of all others."""

INPUTS: Mapping[Task, tuple[str, ...]] = {
    "motion": ("pictures",),
    "tracking": ("pictures", "given"),
    "association": ("pictures",),
    "people": ("pictures",),
    "location": ("pictures", "given", "telemetry", "landmarks", "colours", "camera", "elevation"),
}
"""The files of a clip that each stage reads."""

_SHUFFLE = 7  # seed of the order of true boxes within their frames: it must not tell who is who


def allowed(clip: Clip) -> tuple[Task, ...]:
    """The tasks that a clip's pictures and truth allow, each after those that it is done upon."""
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


def upstream(clip: Clip, task: Task) -> Task | None:
    """The task whose result another is done upon; None where it needs none."""
    return "motion" if task == "tracking" and bool(clip.pictures) and "movers" in clip.shows else None


def narrowed(settings: Settings, task: Task) -> Settings:
    """The settings as a stage sees them: no group that its key does not hold can have a say."""
    return Settings().model_copy(update={group: getattr(settings, group) for group in KNOBS[task]})


def find(
    clip: Clip,
    task: Task,
    settings: Settings,
    backend: str = "auto",
    interval: int = 1,
    before: Found | None = None,
    tick: Tick = lambda: None,
) -> Found:
    """What a stage finds in a clip. before: the result of `upstream`. tick: called once a frame.

    Raises InputError where the clip's files will not do.
    """
    settings, peak, start = narrowed(settings, task), Peak(), time.perf_counter()
    if task == "motion":
        rows = motion(clip, settings, backend, tick)
    elif task == "tracking":
        rows = _tracking(clip, settings, backend, interval, before, tick)
    elif task == "association":
        rows = _association(clip, settings, backend, interval, tick)
    elif task == "people":
        rows = _people(clip, settings, backend, tick)
    else:
        from torchvision_dddas.evaluation.studies.placing import location

        rows = location(clip, settings, backend, interval, tick)
    rows.seconds["other"] = time.perf_counter() - start - sum(rows.seconds.values())
    return rows.found(peak.mb())


def opened(clip: Clip) -> "Source":
    """The pictures of a clip. Raises InputError where they cannot be read."""
    from torchvision_dddas.io.images import IMAGE_SUFFIXES, ImageSource
    from torchvision_dddas.io.sources import open_source

    if not clip.pictures:
        raise InputError(f"{clip.name} has no pictures: {clip.place}")
    if len(clip.pictures) == 1 and clip.pictures[0].suffix.lower() not in IMAGE_SUFFIXES:
        return open_source(clip.pictures[0], rate_hz=clip.rate_hz)
    return ImageSource(clip.pictures, clip.name, clip.rate_hz or 10.0)


def labelled(clip: Clip) -> set[int]:
    """The frames whose masks are kept: those for which the truth tells pixels."""
    truth = clip.truth
    return set() if truth is None or truth.kind == "boxes" else set(truth.frames)


def motion(clip: Clip, settings: Settings, backend: str, tick: Tick) -> Rows:
    """What moves: `dddas detect`."""
    from torchvision_dddas.detection import detect_motion

    source, wanted = opened(clip), labelled(clip)
    rows = scenes_kept(detect_motion(source, settings, backend), wanted, tick)
    rows.notes += [str(problem) for problem in source.problems]
    return rows


def scenes_again(clip: Clip, found: Found) -> Iterator[Scene]:
    """The scenes of a clip as `run.run` gave them, but for their masks: pictures are read again."""
    source, numbers = opened(clip), found.looked.tolist()
    shape: tuple[int, ...] = (source.size[1], source.size[0])
    pictures = iter(source)
    picture = next(pictures, None)
    for number in numbers:
        while picture is not None and picture.number < number:
            picture = next(pictures, None)
        frame = Frame(number, (number - 1) / source.rate_hz, np.zeros(shape, np.uint8))
        if picture is not None and picture.number == number:
            frame, shape = picture, picture.image.shape
        here = slice(*np.searchsorted(found.frame, [number, number + 1]))
        area_px, heading_rad, speed_px, middle_px = (
            found.more[name][here] for name in ("area_px", "heading_rad", "speed_px", "middle_px")
        )
        detections = Detections(
            found.box_px[here], found.score[here], area_px, heading_rad, speed_px, middle_px=middle_px
        )
        step = None
        if number in found.steps:
            step = Registration(found.steps[number], 0, 0, float("nan"), float("nan"))
        yield Scene(frame, np.zeros((0, 0), np.uint16), detections, 0, step=step)


def _tracking(clip: Clip, settings: Settings, backend: str, interval: int, before: Found | None, tick: Tick) -> Rows:
    """Identities: `dddas track CLIP`, or of the data set's own detections."""
    from torchvision_dddas.io.detection_tables import read_detections
    from torchvision_dddas.tracking import track_scenes

    if upstream(clip, "tracking") is not None:
        assert before is not None, "tracks are of what was seen to move"
        size = opened(clip).size
        return followed_kept(track_scenes(scenes_again(clip, before), settings, interval, size, False), tick)
    assert clip.given is not None, "allowed() asks for tracks where there is something to follow"
    return _followed(clip, read_detections(clip.given), settings, backend, interval, tick)


def _association(clip: Clip, settings: Settings, backend: str, interval: int, tick: Tick) -> Rows:
    """Identities of the true boxes, in an order that does not tell them."""
    return _followed(clip, true_boxes(clip, interval), settings, backend, interval, tick)


def true_boxes(clip: Clip, interval: int) -> "DetectionTable":
    """The true boxes of each interval-th frame as certain detections. Raises InputError where there are none."""
    from torchvision_dddas.types import DetectionTable

    assert clip.truth is not None and clip.truth.tracks is not None, "allowed() asks for it where there is truth"
    table = clip.truth.tracks.every(interval)
    if not len(table.frame):
        raise InputError(f"{clip.truth.place} has no box on frames 1, {1 + interval}, {1 + 2 * interval}, ...")
    order = np.random.default_rng(_SHUFFLE).permutation(len(table.frame))
    order = order[np.argsort(table.frame[order], kind="stable")]
    frame, box_px = table.frame[order], np.asarray(table.box_px, float)[order]
    return DetectionTable(clip.name, frame, box_px, np.ones(len(frame)), np.arange(1, len(frame) + 1))


def _followed(clip: Clip, table: "DetectionTable", settings: Settings, backend: str, interval: int, tick: Tick) -> Rows:
    """A table along the clip's pictures, or alone where it has none."""
    from torchvision_dddas.detection import load_engine
    from torchvision_dddas.io.detection_tables import check_table
    from torchvision_dddas.tracking import track_clip, track_table

    if not clip.pictures:
        notes = check_table(table, interval)
        rows = followed_kept(track_table(table, settings, interval), tick)
        rows.notes += notes
        return rows
    source = opened(clip)
    notes = check_table(table, interval, source)
    rows = followed_kept(track_clip(source, table, load_engine(backend, settings), settings, interval), tick)
    rows.notes += [*notes, *map(str, source.problems)]
    return rows


def _people(clip: Clip, settings: Settings, backend: str, tick: Tick) -> Rows:
    """People by their shape: `dddas people`."""
    from torchvision_dddas.people.detector import recognize, recognizer_of

    source, rows = opened(clip), Rows()
    for here in recognize(source, recognizer_of(settings.people, backend), settings):
        people = here.people
        rows.add(here.frame.number, here.seconds, box_px=written(people.box_px), score=people.score)
        tick()
    rows.notes += map(str, source.problems)
    return rows


def files_of(clip: Clip, task: Task) -> list[Path]:
    """The files that a stage reads."""
    found: list[Path] = []
    for name in INPUTS[task]:
        value: Any = getattr(clip, name)
        found += value if isinstance(value, tuple) else [] if value is None else [value]
    return found
