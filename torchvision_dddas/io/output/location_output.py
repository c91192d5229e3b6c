"""The folder of a run that locates targets from the air: tables, maps, a report, and the record."""

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np

from torchvision_dddas.io.atomic_files import remove, temporary, write_whole
from torchvision_dddas.io.maps.cot import cot
from torchvision_dddas.io.maps.ellipses import semi_axes
from torchvision_dddas.io.maps.geojson import encoded, geojson
from torchvision_dddas.io.maps.ground_tracks import Gathered, GroundTracks, iso_utc
from torchvision_dddas.io.maps.kml import kml
from torchvision_dddas.io.maps.map_picture import CameraPath, map_picture, view_of
from torchvision_dddas.io.maps.map_signs import Signs
from torchvision_dddas.io.output.detection_output import RunFolder
from torchvision_dddas.io.output.location_tables import GroundedTables
from torchvision_dddas.io.output.run_record import NAME, Record
from torchvision_dddas.io.report.run_report import RunSummary, Table, format_span, run_report
from torchvision_dddas.io.report.timelines import USED, LocationTimeline
from torchvision_dddas.types import AerialLocations, Camera, Fix, Ortho, Positions

SAVED = ("cot", "map", "report")
"""What --save may name. The tables, tracks.geojson, tracks.kml and run.json are always written."""

GEOJSON, KML, COT, MAP, REPORT = "tracks.geojson", "tracks.kml", "tracks.cot.xml", "map.png", "report.html"
_LARGE = 400_000  # bytes
_NUMBER = re.compile(r"\d+(\.\d+)?")

Degrees = Callable[[np.ndarray], np.ndarray]
"""(N, 2) local metres to longitudes and latitudes."""


class Spans:
    """What was said of frames; the same of successive ones is said once, also where its numbers differ: the first's."""

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []
        self._open: dict[str, dict[str, Any]] = {}

    def add(self, frame: int, before: int, words: str, **more: Any) -> None:
        """Say words of a frame; before: the number of the frame that came before it."""
        kind = _NUMBER.sub("0", f"{words} {more}")
        row = self._open.get(kind)
        if row is not None and row["last"] in (before, frame):
            row["last"] = frame
        else:
            self._open[kind] = row = {"first": frame, "last": frame, **more, "cause": words}
            self.rows.append(row)


class GroundedJournal(Record):
    """The record of a run that locates targets from the air.

    positions: rows of positions.csv. by: frames by what told where the camera was, `nothing` for those that could not
    be located. weak: spans of frames that were located, but with something amiss. repairs: what was changed and why.
    landmarks: of each, in how many frames it was seen, used, and left out of those located; and the spans where it was
    reassigned or excluded.
    """

    made = ("positions.csv", "fixes.csv", GEOJSON, KML, COT, MAP, REPORT)
    """Files that a run may leave beside run.json."""

    def __init__(self, folder: Path, facts: dict[str, Any], names: Sequence[str]) -> None:
        super().__init__(folder, facts)
        self.facts = facts
        self.names = tuple(names)
        self.positions = 0
        self.by = dict.fromkeys(("pose", "homography", "paper", "telemetry", "nothing"), 0)
        self.weak, self.repairs = Spans(), Spans()
        self.landmarks: dict[str, dict[str, Any]] = {
            name: {"seen": 0, "used": 0, "left_out": 0, "reassigned": [], "excluded": []} for name in names
        }
        self._before = 0

    @property
    def gaps(self) -> list[dict[str, Any]]:
        """Spans of frames that could not be located: first, last, cause."""
        return self._unreliable

    @property
    def moves(self) -> list[dict[str, Any]]:
        """The adjustments of the feedback loop."""
        return self._adjustments

    def write(self, grounded: AerialLocations) -> None:
        """Take note of a frame."""
        frame, fix = grounded.frame, grounded.fix
        self.positions += len(grounded.positions)
        self.by[fix.by or "nothing"] += 1
        for which, state in zip(fix.landmark.tolist(), fix.state, strict=True):
            kept = self.landmarks[self.names[which]]
            kept["seen"] += 1
            kept["used"] += state in USED
            kept["left_out"] += bool(fix.by) and state not in USED
            if state in ("reassigned", "excluded"):
                spans = kept[state]
                if spans and spans[-1][1] == self._before:
                    spans[-1][1] = frame
                else:
                    spans.append([frame, frame])
        if fix.by and fix.cause:
            self.weak.add(frame, self._before, fix.cause, by=fix.by)
        for change in fix.changes:
            self.repairs.add(frame, self._before, change)
        self.counts = {
            "positions": self.positions,
            "by": self.by,
            "landmarks": self.landmarks,
            "weak": self.weak.rows,
            "repairs": self.repairs.rows,
        }
        gap = None if fix.by else fix.cause or "nothing told where the camera was"
        self.note(frame, len(grounded.box_px), grounded.seconds, grounded.adjustments, gap)
        self._before = frame


class More(Protocol):
    """What is known of a run beside what was located."""

    signs: Signs

    def told(self, story: RunSummary) -> RunSummary:
        """The story of a report, with that."""


class Maps:
    """The files that need all frames, written at the end. Memory grows with the places that they show.

    A place of a target or a landmark takes 104 bytes, three times that while more space is made, and about 800 while
    the files are written; a frame takes 200.
    """

    def __init__(
        self,
        folder: Path,
        kept: GroundedJournal,
        save: Sequence[str],
        geographic: bool,
        start_utc_s: float,
        photo: Ortho | None,
        camera: Camera | None,
        degrees: Degrees | None,
    ) -> None:
        self._folder, self._kept, self._save = folder, kept, save
        self._geographic, self._start_utc_s, self._photo = geographic, start_utc_s, photo
        self._camera, self._degrees = camera, degrees
        self._name = Path(str(kept.facts.get("input", ""))).name
        self._targets, self._marks, self._timeline = Gathered(), Gathered(), LocationTimeline()
        self._way: list[tuple[float, float]] = []
        self._last: Fix | None = None
        self.written: set[str] = set()
        self.more: More | None = None

    def write(self, grounded: AerialLocations) -> None:
        """Keep what the maps will show of a frame."""
        self._targets.add(grounded.positions, grounded.time_s, grounded.velocity_m_s)
        self._timeline.add(grounded)
        marks, fix = grounded.marks, grounded.fix
        at = np.flatnonzero(np.isfinite(marks.east_north_m).all(axis=1))
        own = np.eye(2) * marks.sigma_m[at, None, None] ** 2
        number = np.full(len(at), grounded.frame)
        self._marks.add(
            Positions(number, marks.landmark[at], marks.east_north_m[at], own, np.ones(len(at))), grounded.time_s
        )
        if fix.pose is not None:
            self._way.append((float(fix.pose.place_m[0]), float(fix.pose.place_m[1])))
        if fix.pose is not None or fix.image_from_ground is not None:
            self._last = fix

    def close(self, complete: bool) -> None:
        """Write them all. Raises OSError if one cannot be written."""
        targets = self._targets.tracks(self._geographic, self._start_utc_s)
        marks = self._marks.tracks(self._geographic and self._degrees is not None, self._start_utc_s)
        if marks.lonlat_deg is not None and self._degrees is not None and len(marks):
            marks.lonlat_deg[:] = self._degrees(marks.east_north_m)
        names = self._kept.names
        if self._geographic:
            self._put(GEOJSON, encoded(geojson(targets, True, marks, names)))
            self._put(KML, kml(targets, self._name or "tracks", marks, names).encode())
            if "cot" in self._save and targets.times_utc is not None:
                self._put(COT, cot(targets).encode())
        if "map" in self._save or "report" in self._save:
            picture = self._map(targets, marks)
            if "map" in self._save:
                self._put(MAP, picture)
            if "report" in self._save:
                story = _story(self._kept, targets, complete, _smaller(picture))
                if self.more is not None:
                    story = self.more.told(story)
                self._put(REPORT, run_report(story, self._timeline).encode())

    def discard(self) -> None:
        """Remove what was begun."""
        for name in (GEOJSON, KML, COT, MAP, REPORT):
            remove(temporary(self._folder / name))

    def _put(self, name: str, content: bytes) -> None:
        write_whole(self._folder / name, content)
        self.written.add(name)

    def _map(self, targets: GroundTracks, marks: GroundTracks) -> bytes:
        seen = view_of(self._last, self._camera) if self._last is not None and self._camera is not None else None
        way = np.array(self._way).reshape(-1, 2)
        camera = CameraPath(way, np.zeros((0, 2)) if seen is None else seen)
        signs = None if self.more is None else self.more.signs
        picture = map_picture(targets, marks, self._kept.names, camera, self._photo, self._name, signs)
        return cv2.imencode(".png", picture)[1].tobytes()


class GroundedOutput(RunFolder[AerialLocations]):
    """Everything that `dddas locate aerial` writes. Raises InputError as RunFolder does."""

    files = (*GroundedJournal.made, NAME)

    def __init__(self, folder: Path, save: Sequence[str] = SAVED) -> None:
        """Claim a folder, as in RunFolder."""
        super().__init__(folder, save)

    def begin(
        self,
        facts: dict[str, Any],
        names: Sequence[str],
        origin_deg: tuple[float, float] | None,
        start_utc_s: float = math.nan,
        rate_hz: float | None = None,
        background: Ortho | None = None,
        camera: Camera | None = None,
        degrees: Degrees | None = None,
    ) -> GroundedJournal:
        """Say what the run is, for run.json, and the landmarks' names.

        origin_deg: longitude and latitude of the local metres, None where there are none. start_utc_s: as in Telemetry.
        background: under the map. camera: so that the map shows what it saw. degrees: so that maps for other tools show
        the landmarks.
        """
        known = math.isfinite(start_utc_s)
        began = iso_utc(np.array([start_utc_s]))[0] if known else None
        about = {"origin_deg": origin_deg, "start_utc": began, "rate_hz": rate_hz}
        self.journal = kept = GroundedJournal(self.folder, {**about, **facts}, names)
        if origin_deg is None:
            kept.notes.append("no longitude and latitude are known: no maps for other tools, but local metres")
        elif not known and "cot" in self._save:
            kept.notes.append(f"no clock is known: no {COT}, and times are seconds since the first frame")
        geographic = origin_deg is not None
        self._maps = Maps(self.folder, kept, self._save, geographic, start_utc_s, background, camera, degrees)
        self._sinks = [kept, self._maps, GroundedTables(self.folder, geographic)]
        return kept

    def close(self, complete: bool) -> None:
        """Put everything in its place, as in RunFolder; maps of an earlier run here go if this one makes none."""
        super().close(complete)
        for name in {GEOJSON, KML, COT, MAP, REPORT} - self._maps.written:
            remove(self.folder / name)


def _smaller(map_png: bytes) -> bytes:
    """A map as JPEG where it is large, as over a photo: a report must stay light."""
    if len(map_png) < _LARGE:
        return map_png
    picture = cv2.imdecode(np.frombuffer(map_png, np.uint8), cv2.IMREAD_COLOR)
    assert picture is not None
    return cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()


def _story(kept: GroundedJournal, targets: GroundTracks, complete: bool, map_png: bytes) -> RunSummary:
    """What the report tells of a run."""
    located = kept.frames - kept.by["nothing"]
    axes, _ = semi_axes(targets.covariance_m2)
    axes = axes[np.isfinite(axes).all(axis=1)]
    figures = [
        ("frames", f"{kept.frames}"),
        ("located", f"{located}"),
        ("targets", f"{len(targets.of)}"),
        ("positions", f"{kept.positions}"),
    ]
    figures += [(f"frames by {name}", f"{count}") for name, count in kept.by.items() if count and name != "nothing"]
    if len(axes):
        longer, shorter = np.median(axes, axis=0)
        figures.append(("95 % ellipse, median semi-axes", f"{longer:.2f} × {shorter:.2f} m"))
    tables: list[Table] = [
        (
            "Frames that could not be located",
            ("frames", "cause"),
            [(format_span(g["first"], g["last"]), g["cause"]) for g in kept.gaps],
            "none",
        ),
        (
            "Frames located with something amiss",
            ("frames", "by", "cause"),
            [(format_span(w["first"], w["last"]), w["by"], w["cause"]) for w in kept.weak.rows],
            "none",
        ),
        (
            "Repairs and exclusions",
            ("frames", "what and why"),
            [(format_span(r["first"], r["last"]), r["cause"]) for r in kept.repairs.rows],
            "none",
        ),
        (
            "Adjustments of the feedback loop",
            ("frame", "knob", "from", "to", "cause"),
            [(m["frame"], m["knob"], m["old"], m["new"], m["cause"]) for m in kept.moves],
            "none",
        ),
        (
            "Landmarks",
            ("name", "frames seen", "used", "reassigned in frames", "excluded in frames"),
            [
                (
                    name,
                    k["seen"],
                    k["used"],
                    [format_span(*s) for s in k["reassigned"]],
                    [format_span(*s) for s in k["excluded"]],
                )
                for name, k in kept.landmarks.items()
            ],
            "none",
        ),
    ]
    state = "complete" if complete else "interrupted: up to the last whole frame"
    name = Path(str(kept.facts.get("input", ""))).name
    title = f"GroundLocations from the air: {name}" if name else "GroundLocations from the air"
    return RunSummary(title, state, figures, kept.facts, tables, [*kept.notes, *kept.problems], map_png)
