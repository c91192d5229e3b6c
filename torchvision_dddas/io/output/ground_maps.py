"""Maps of located targets, written at the end of a run: GeoJSON, KML, Cursor-on-Target, a picture, and the report."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.io.atomic_files import remove, temporary, write_whole
from torchvision_dddas.io.maps import (
    CameraPath,
    Gathered,
    GroundTracks,
    cot,
    encode_geojson,
    geojson,
    iso_utc,
    kml,
    map_picture,
    semi_axes,
    view_of,
)
from torchvision_dddas.io.output.run_record import AerialRecord, Spans
from torchvision_dddas.io.output.run_report import REPORT, RunSummary, Table, format_span, run_report
from torchvision_dddas.io.output.run_story import RunStory
from torchvision_dddas.io.output.timelines import LocationTimeline
from torchvision_dddas.types import AerialLocations, Camera, Fix, GroundLocations, Ortho, Positions

GEOJSON, KML, COT, MAP = "tracks.geojson", "tracks.kml", "tracks.cot.xml", "map.png"
_LARGE_BYTES = 400_000
_LANDMARK_COLUMNS = ("name", "frames seen", "used", "reassigned in frames", "excluded in frames")


@dataclass(frozen=True)
class Site:
    """The ground that maps show, and what is known of the run.

    names: of the landmarks. origin_deg: longitude and latitude of the local metres, None where there are none.
    start_utc_s: as in Telemetry. rate_hz: of the frames, for run.json. background: an ortho-photo under the map.
    camera: if given, the map shows its view. to_degrees: (N, 2) local metres to longitudes and latitudes.
    """

    names: Sequence[str]
    origin_deg: tuple[float, float] | None = None
    start_utc_s: float = math.nan
    rate_hz: float | None = None
    background: Ortho | None = None
    camera: Camera | None = None
    to_degrees: Callable[[np.ndarray], np.ndarray] | None = None

    @property
    def facts(self) -> dict[str, Any]:
        """What run.json says of it."""
        begun = iso_utc(np.array([self.start_utc_s]))[0] if math.isfinite(self.start_utc_s) else None
        return {"origin_deg": self.origin_deg, "start_utc": begun, "rate_hz": self.rate_hz}


class _MapFiles:
    """Files that are written at the end of a run. files: all that a run may write."""

    files: tuple[str, ...] = ()

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._written: set[str] = set()

    def _put(self, name: str, content: bytes) -> None:
        write_whole(self._folder / name, content)
        self._written.add(name)

    def _remove_old(self) -> None:
        """Remove files of an earlier run that this one did not write."""
        for name in set(self.files) - self._written:
            remove(self._folder / name)

    def discard(self) -> None:
        """Remove what was begun."""
        for name in self.files:
            remove(temporary(self._folder / name))


class AerialMaps(_MapFiles):
    """tracks.geojson, tracks.kml, tracks.cot.xml, map.png and report.html of targets located from the air.

    Memory: 104 bytes per place of a target or landmark, three times that while the array grows, and about 800 while
    the files are written; 200 bytes per frame.
    """

    files = (GEOJSON, KML, COT, MAP, REPORT)

    def __init__(
        self, folder: Path, record: AerialRecord, save: Sequence[str], site: Site, story: RunStory | None = None
    ) -> None:
        """story: adds events, key frames and timelines to the report."""
        super().__init__(folder)
        self._record, self._save, self._site, self._story = record, save, site, story
        self._name = Path(str(record.facts.get("input", ""))).name
        self._targets, self._landmarks, self._timeline = Gathered(), Gathered(), LocationTimeline()
        self._camera_path: list[tuple[float, float]] = []
        self._last: Fix | None = None

    def write(self, grounded: AerialLocations) -> None:
        """Keep a frame's places for the maps."""
        self._targets.add(grounded.positions, grounded.time_s, grounded.velocity_m_s)
        self._timeline.add(grounded)
        marks, fix = grounded.marks, grounded.fix
        at = np.flatnonzero(np.isfinite(marks.east_north_m).all(axis=1))
        own = np.eye(2) * marks.sigma_m[at, None, None] ** 2
        number = np.full(len(at), grounded.frame)
        places = Positions(number, marks.landmark[at], marks.east_north_m[at], own, np.ones(len(at)))
        self._landmarks.add(places, grounded.time_s)
        if fix.pose is not None:
            self._camera_path.append((float(fix.pose.place_m[0]), float(fix.pose.place_m[1])))
        if fix.pose is not None or fix.image_from_ground is not None:
            self._last = fix

    def close(self, complete: bool) -> None:
        """Write all files, and remove those of an earlier run that this one does not make."""
        site, save, names = self._site, self._save, self._record.names
        has_degrees = site.origin_deg is not None
        targets = self._targets.tracks(has_degrees, site.start_utc_s)
        landmarks = self._landmarks.tracks(has_degrees and site.to_degrees is not None, site.start_utc_s)
        if landmarks.lonlat_deg is not None and site.to_degrees is not None and len(landmarks):
            landmarks.lonlat_deg[:] = site.to_degrees(landmarks.east_north_m)
        if has_degrees:
            self._put(GEOJSON, encode_geojson(geojson(targets, True, landmarks, names)))
            self._put(KML, kml(targets, self._name or "tracks", landmarks, names).encode())
            if "cot" in save and targets.times_utc is not None:
                self._put(COT, cot(targets).encode())
        if "map" in save or "report" in save:
            picture = self._draw(targets, landmarks)
            if "map" in save:
                self._put(MAP, picture)
            if "report" in save:
                summary = replace(_summary(self._record, targets, complete), map_picture=_compressed(picture))
                if self._story is not None:
                    summary = self._story.extend(summary)
                self._put(REPORT, run_report(summary, self._timeline).encode())
        self._remove_old()

    def _draw(self, targets: GroundTracks, landmarks: GroundTracks) -> bytes:
        last, camera = self._last, self._site.camera
        view = view_of(last, camera) if last is not None and camera is not None else np.zeros((0, 2))
        path = CameraPath(np.array(self._camera_path).reshape(-1, 2), view)
        signs = None if self._story is None else self._story.signs
        photo = self._site.background
        picture = map_picture(targets, landmarks, self._record.names, path, photo, self._name, signs)
        return cv2.imencode(".png", picture)[1].tobytes()


class GroundMaps(_MapFiles):
    """tracks.geojson and tracks.kml of people located from the ground, if their longitudes and latitudes are known."""

    files = (GEOJSON, KML)

    def __init__(self, folder: Path, has_degrees: bool) -> None:
        super().__init__(folder)
        self._has_degrees = has_degrees
        self._gathered = Gathered()

    def write(self, located: GroundLocations) -> None:
        """Keep the people of a frame."""
        if self._has_degrees:
            self._gathered.add(located.positions)

    def close(self, complete: bool) -> None:
        """Write the maps. Raises OSError if they cannot be written."""
        if self._has_degrees:
            tracks = self._gathered.tracks(geographic=True)
            self._put(GEOJSON, encode_geojson(geojson(tracks)))
            self._put(KML, kml(tracks).encode())
        self._remove_old()


def _compressed(map_png: bytes) -> bytes:
    """The map as JPEG if it is large, as over a photo, to keep the report light."""
    if len(map_png) < _LARGE_BYTES:
        return map_png
    picture = cv2.imdecode(np.frombuffer(map_png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()


def _summary(record: AerialRecord, targets: GroundTracks, complete: bool) -> RunSummary:
    """What the report says of where targets were located."""
    figures = [
        ("frames", f"{record.frames}"),
        ("located", f"{record.frames - record.by['nothing']}"),
        ("targets", f"{len(targets.of)}"),
        ("positions", f"{record.positions}"),
    ]
    figures += [(f"frames by {name}", f"{count}") for name, count in record.by.items() if count and name != "nothing"]
    axes, _ = semi_axes(targets.covariance_m2)
    axes = axes[np.isfinite(axes).all(axis=1)]
    if len(axes):
        longer, shorter = np.median(axes, axis=0)
        figures.append(("95 % ellipse, median semi-axes", f"{longer:.2f} × {shorter:.2f} m"))
    landmarks = [
        (name, k["seen"], k["used"], *([format_span(*s) for s in k[state]] for state in ("reassigned", "excluded")))
        for name, k in record.landmarks.items()
    ]
    adjustments = [tuple(m[key] for key in ("frame", "knob", "old", "new", "cause")) for m in record.adjustments]
    tables: list[Table] = [
        ("Frames that could not be located", ("frames", "cause"), _rows(record.unreliable, "cause"), "none"),
        ("Frames located with something amiss", ("frames", "by", "cause"), _rows(record.weak, "by", "cause"), "none"),
        ("Repairs and exclusions", ("frames", "what and why"), _rows(record.repairs, "cause"), "none"),
        ("Adjustments of the feedback loop", ("frame", "parameter", "from", "to", "cause"), adjustments, "none"),
        ("Landmarks", _LANDMARK_COLUMNS, landmarks, "none"),
    ]
    name = Path(str(record.facts.get("input", ""))).name
    title = f"Located from the air: {name}" if name else "Located from the air"
    return RunSummary.of(record, title, complete, figures, tables)


def _rows(spans: Spans, *keys: str) -> list[tuple[Any, ...]]:
    return [(format_span(span["first"], span["last"]), *(span[key] for key in keys)) for span in spans.rows]
