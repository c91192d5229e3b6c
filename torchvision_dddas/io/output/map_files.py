"""Maps of located targets, written at the end of a run: GeoJSON, KML, Cursor-on-Target, a picture, and the report."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.errors import readable
from torchvision_dddas.io.atomic_files import Part, write_whole
from torchvision_dddas.io.maps.formats import cot, encode_geojson, geojson, kml
from torchvision_dddas.io.maps.ground_tracks import Gathered, GroundTracks, iso_utc, semi_axes
from torchvision_dddas.io.maps.map_picture import CameraPath, map_picture, view_of
from torchvision_dddas.io.output.run_log import RunStory
from torchvision_dddas.io.output.run_record import RunRecord
from torchvision_dddas.io.output.run_report import REPORT, RunReport, location_tables
from torchvision_dddas.io.output.timelines import Timeline
from torchvision_dddas.types import AerialLocations, Camera, Fix, GroundLocations, Ortho, Positions

GEOJSON, KML, COT, MAP = "tracks.geojson", "tracks.kml", "tracks.cot.xml", "map.png"
_LARGE_BYTES = 400_000  # of a map.png; the report has a larger one as JPEG


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


class AerialMaps(Part[AerialLocations]):
    """tracks.geojson, tracks.kml, tracks.cot.xml, map.png and report.html of targets located from the air.

    Memory: 104 bytes per place of a target or landmark, three times that while the array grows, and about 800 while
    the files are written; 200 bytes per frame.
    record: of the run; set before the end.
    """

    files = (GEOJSON, KML, COT, MAP, REPORT)
    record: RunRecord

    def __init__(self, folder: Path, save: Sequence[str], site: Site, story: RunStory | None = None) -> None:
        """story: the timeline, events and key frames of the run, which the report shows; None without them."""
        self._folder, self._save, self._site, self._story = folder, save, site, story
        self._timeline = Timeline() if story is None else story.timeline
        self._targets, self._landmarks = Gathered(), Gathered()
        self._camera_path: list[np.ndarray] = []
        self._last: Fix | None = None

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
            self._camera_path.append(np.array(fix.pose.place_m[:2], float))
        if fix.pose is not None or fix.image_from_ground is not None:
            self._last = fix

    def close(self, complete: bool) -> None:
        """Write all files."""
        site, save, names = self._site, self._save, tuple(self._site.names)
        has_degrees = site.origin_deg is not None
        targets = self._targets.tracks(has_degrees, site.start_utc_s)
        landmarks = self._landmarks.tracks(has_degrees and site.to_degrees is not None, site.start_utc_s)
        if landmarks.lonlat_deg is not None and site.to_degrees is not None and len(landmarks):
            landmarks.lonlat_deg[:] = site.to_degrees(landmarks.east_north_m)
        picture = self._draw(targets, landmarks) if "map" in save or "report" in save else b""
        makers: dict[str, Callable[[], bytes]] = {}
        if has_degrees:
            makers[GEOJSON] = lambda: encode_geojson(geojson(targets, True, landmarks, names))
            makers[KML] = lambda: kml(targets, self.record.input_name or "tracks", landmarks, names).encode()
            if "cot" in save and targets.times_utc is not None:
                makers[COT] = lambda: cot(targets).encode()
        if "map" in save:
            makers[MAP] = lambda: picture
        if "report" in save:
            makers[REPORT] = lambda: readable(self._report(targets, picture, complete)).encode()
        _write(self._folder, makers)

    def _draw(self, targets: GroundTracks, landmarks: GroundTracks) -> bytes:
        last, site = self._last, self._site
        view = view_of(last, site.camera) if last is not None and site.camera is not None else np.zeros((0, 2))
        path = CameraPath(np.reshape(self._camera_path, (-1, 2)), view)
        signs = None if self._story is None else self._story.signs
        name = self.record.input_name
        picture = map_picture(targets, landmarks, site.names, path, site.background, name, signs)
        return cv2.imencode(".png", picture)[1].tobytes()

    def _report(self, targets: GroundTracks, picture: bytes, complete: bool) -> str:
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
        if len(picture) > _LARGE_BYTES:  # as over a photo
            image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
            assert image is not None
            picture = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 82])[1].tobytes()
        report.map_picture = picture
        if self._story is not None:
            self._story.extend(report)
        return report.html()


class GroundMaps(Part[GroundLocations]):
    """tracks.geojson and tracks.kml of people located from the ground, if their longitudes and latitudes are known."""

    files = (GEOJSON, KML)

    def __init__(self, folder: Path, has_degrees: bool) -> None:
        self._folder, self._has_degrees = folder, has_degrees
        self._gathered = Gathered()

    def write(self, located: GroundLocations) -> None:
        """Keep the people of a frame."""
        if self._has_degrees:
            self._gathered.add(located.positions)

    def close(self, complete: bool) -> None:
        """Write the maps. Raises OSError if they cannot be written."""
        tracks = self._gathered.tracks(geographic=True)
        makers = {GEOJSON: lambda: encode_geojson(geojson(tracks)), KML: lambda: kml(tracks).encode()}
        _write(self._folder, makers if self._has_degrees else {})


def _write(folder: Path, makers: Mapping[str, Callable[[], bytes]]) -> None:
    """Write the files one after the other."""
    for name, make in makers.items():
        write_whole(folder / name, make())
