"""Maps of located targets, written at the end of a run: GeoJSON, KML, Cursor-on-Target, a picture, and the report."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.errors import readable
from torchvision_dddas.geometry import edges_of, is_inside, lonlat
from torchvision_dddas.io.atomic_files import OutputPart, write_whole
from torchvision_dddas.io.maps.formats import cot, ellipses_geojson, encode_geojson, geojson, kml
from torchvision_dddas.io.maps.ground_tracks import Gathered, GroundTracks, iso_utc, semi_axes
from torchvision_dddas.io.maps.map_page import map_data
from torchvision_dddas.io.maps.map_picture import CameraPath, Signs, map_picture, view_of
from torchvision_dddas.io.output.run_log import RunStory
from torchvision_dddas.io.output.run_record import RunRecord
from torchvision_dddas.io.output.run_report import REPORT, RunReport, location_tables
from torchvision_dddas.io.output.timelines import Timeline
from torchvision_dddas.io.zone_files import zone_rings
from torchvision_dddas.types import AerialLocations, Camera, Fix, FusedTargets, GroundLocations, Ortho, Positions, Zone

GEOJSON, ELLIPSES, KML, COT, MAP = "tracks.geojson", "ellipses.geojson", "tracks.kml", "tracks.cot.xml", "map.png"
FUSED = "fused.geojson"
_MOST_VIEWS = 400  # largest number of camera views in the report


@dataclass(frozen=True)
class MapSite:
    """The ground that maps show, and facts of the run that maps need.

    names: names of the landmarks. origin_deg: longitude and latitude of the origin of the local metres, None if
    unknown. start_utc_s: as in Telemetry. rate_hz: frame rate, for run.json. background: an ortho-photo under the map.
    camera: if given, the map shows its view. to_degrees: converts (N, 2) local metres to longitudes and latitudes.
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
        """The entries for run.json."""
        begun = iso_utc(np.array([self.start_utc_s]))[0] if math.isfinite(self.start_utc_s) else None
        return {"origin_deg": self.origin_deg, "start_utc": begun, "rate_hz": self.rate_hz}


class AerialMaps(OutputPart[AerialLocations]):
    """Writes maps of targets located from the air: GeoJSON, KML, Cursor-on-Target, map.png and report.html.

    Memory: 120 bytes per place of a target or landmark, three times as much while the array grows, and about 800 bytes
    while the files are written. In addition, 200 bytes per frame.
    record: the record of the run. It must be set before `close`.
    """

    files = (GEOJSON, ELLIPSES, FUSED, KML, COT, MAP, REPORT)
    record: RunRecord

    def __init__(
        self,
        folder: Path,
        save: Sequence[str],
        site: MapSite,
        story: RunStory | None = None,
        zones: Sequence[Zone] = (),
    ) -> None:
        """story: timeline, events and key frames of the run for the report, if there are any."""
        self._folder, self._save, self._site, self._story = folder, save, site, story
        self._timeline = Timeline() if story is None else story.timeline
        self._targets, self._landmarks, self._way, self._fused = Gathered(), Gathered(), Gathered(), Gathered()
        self._views: list[tuple[int, float, np.ndarray]] = []
        self._due, self._stride = 0, 1  # number of candidate views; every `stride`-th view is kept
        self._last: Fix | None = None
        self._zones = {zone.name: zone_rings(zone, site.origin_deg) for zone in zones if zone.unit != "px"}
        self._unseen = dict(self._zones) if site.camera is not None else {}
        if story is not None:
            story.signs.zones += [(z.name, self._zones[z.name], z.is_line) for z in zones if z.unit != "px"]

    def write(self, located: AerialLocations) -> None:
        """Keep a frame's places for the maps."""
        self._targets.add(located.positions, located.time_s, located.velocity_m_s)
        if self._story is None:
            self._timeline.add_locations(located)
        marks, fix = located.marks, located.fix
        at = np.flatnonzero(np.isfinite(marks.east_north_m).all(axis=1))
        own = np.eye(2) * marks.sigma_m[at, None, None] ** 2
        number = np.full(len(at), located.frame)
        places = Positions(number, marks.landmark[at], marks.east_north_m[at], own, np.ones(len(at)))
        self._landmarks.add(places, located.time_s)
        if fix.pose is not None:
            place, unknown = np.reshape(fix.pose.place_m[:2], (1, 2)), np.full((1, 2, 2), np.nan)
            here = Positions(np.array([located.frame]), np.zeros(1, int), place, unknown, np.ones(1))
            self._way.add(here, located.time_s)
        if fix.pose is not None or fix.image_from_ground is not None:
            self._last = fix
            self._add_view(located, self._site.camera)

    def add_fused(self, fused: FusedTargets) -> None:
        """Keep the fused places of the targets that a platform saw within the last second."""
        seen = np.array([len(by) > 0 for by in fused.seen_by], bool)
        place, frame = fused.state[seen, :2], np.full(seen.sum(), fused.frame)
        degrees = None if fused.origin_deg is None else lonlat(place, fused.origin_deg)
        unsure, ones = fused.covariance[seen, :2, :2], np.ones(len(place))
        places = Positions(frame, fused.target[seen], place, unsure, ones, lonlat_deg=degrees)
        self._fused.add(places, fused.time_s, fused.state[seen, 2:])

    def _add_view(self, located: AerialLocations, camera: Camera | None) -> None:
        """Keep the view for the report, and note which zones it shows."""
        is_due = "report" in self._save and self._due % self._stride == 0
        self._due += 1
        if camera is None or not (is_due or self._unseen):
            return
        view = view_of(located.fix, camera)
        self._unseen = {name: rings for name, rings in self._unseen.items() if not _shows(view, rings)}
        if is_due and len(view):
            size_m = float(np.ptp(view, axis=0).max())
            outline = cv2.approxPolyDP(view.astype(np.float32)[:, None], 0.01 * size_m, True)[:, 0]
            self._views.append((located.frame, located.time_s, outline))
            if len(self._views) > _MOST_VIEWS:
                self._views, self._stride = self._views[::2], 2 * self._stride

    def close(self, complete: bool) -> None:
        """Write all files."""
        site, save, names, way = self._site, self._save, tuple(self._site.names), self._way.tracks(geographic=False)
        for name, rings in self._unseen.items():
            away = np.concatenate(rings).mean(axis=0) - (way.east_north_m[-1] if len(way) else 0.0)
            where = f"its middle lies {np.hypot(*away):.0f} m from the last place of the camera"
            self.record.notes.append(f"{name} is in no located picture, so no event is seen there: {where}")
        has_degrees = site.origin_deg is not None
        targets = self._targets.tracks(has_degrees, site.start_utc_s)
        fused = self._fused.tracks(has_degrees, site.start_utc_s)
        landmarks = self._landmarks.tracks(has_degrees and site.to_degrees is not None, site.start_utc_s)
        if landmarks.lonlat_deg is not None and site.to_degrees is not None and len(landmarks):
            landmarks.lonlat_deg[:] = site.to_degrees(landmarks.east_north_m)
        view = view_of(self._last, site.camera) if self._last and site.camera is not None else np.zeros((0, 2))
        camera = CameraPath(way.east_north_m, view, self._views)
        signs = Signs() if self._story is None else self._story.signs
        makers: dict[str, Callable[[], bytes]] = {}
        if has_degrees:
            makers[GEOJSON] = lambda: encode_geojson(geojson(targets, landmarks, names))
            makers[ELLIPSES] = lambda: encode_geojson(ellipses_geojson(targets))
            if len(fused):
                makers[FUSED] = lambda: encode_geojson(geojson(fused, name="fused"))
            makers[KML] = lambda: kml(targets, self.record.input_name or "tracks", landmarks, names).encode()
            if "cot" in save and targets.times_utc is not None:
                makers[COT] = lambda: cot(targets).encode()
        photo, title = site.background, self.record.input_name
        if "map" in save:
            picture = map_picture(targets, landmarks, names, camera, photo, title, signs)
            makers[MAP] = lambda: cv2.imencode(".png", picture)[1].tobytes()
        if "report" in save:
            data = map_data(targets, landmarks, names, camera, way, photo, signs, site.to_degrees, fused)
            makers[REPORT] = lambda: readable(self._report(targets, data, complete)).encode()
        _write(self._folder, makers)

    def _report(self, targets: GroundTracks, data: dict[str, Any] | None, complete: bool) -> str:
        record = self.record
        by = {name: count for name, count in record.counts["by"].items() if name != "nothing"}
        counts = {"frames": record.frames, "located": sum(by.values()), "identities located": len(targets.of)}
        counts["positions"] = record.counts["positions"]
        counts["frames without a position"] = record.counts["frames_without_position"]
        counts |= {f"frames by {name}": count for name, count in by.items() if count}
        figures = [(name, f"{count}") for name, count in counts.items()]
        axes, _ = semi_axes(targets.covariance_m2)
        axes = axes[np.isfinite(axes).all(axis=1)]
        if len(axes):
            longer, shorter = np.median(axes, axis=0)
            figures.append(("95 % ellipse, median semi-axes", f"{longer:.2f} × {shorter:.2f} m"))
        title = "Located from the air" + (f": {record.input_name}" if record.input_name else "")
        report = RunReport(title, record, complete, self._timeline, figures, location_tables(record))
        report.map, report.map_file = data, MAP if "map" in self._save else ""
        if self._story is not None:
            self._story.extend(report)
        return report.html()


class GroundMaps(OutputPart[GroundLocations]):
    """Writes tracks.geojson and tracks.kml of people located from the ground, if longitudes and latitudes are known."""

    files = (GEOJSON, KML)

    def __init__(self, folder: Path, has_degrees: bool) -> None:
        self._folder, self._has_degrees = folder, has_degrees
        self._gathered = Gathered()

    def write(self, located: GroundLocations) -> None:
        """Keep the people of a frame."""
        if self._has_degrees:
            self._gathered.add(located.positions)

    def close(self, complete: bool) -> None:
        """Write the maps. Raise OSError if they cannot be written."""
        tracks = self._gathered.tracks(geographic=True)
        makers = {GEOJSON: lambda: encode_geojson(geojson(tracks)), KML: lambda: kml(tracks).encode()}
        _write(self._folder, makers if self._has_degrees else {})


def _shows(view_m: np.ndarray, rings: Sequence[np.ndarray]) -> bool:
    """Return whether a (K, 2) view of the ground overlaps a zone, tested by their corners and the zone's middle."""
    if len(view_m) < 3:
        return False
    view, places = edges_of([view_m], closed=True), np.concatenate([*rings, [np.concatenate(rings).mean(axis=0)]])
    return bool(is_inside(places, view).any() or is_inside(view_m, edges_of(rings, closed=True)).any())


def _write(folder: Path, makers: Mapping[str, Callable[[], bytes]]) -> None:
    """Make and write each file in turn."""
    for name, make in makers.items():
        write_whole(folder / name, make())
