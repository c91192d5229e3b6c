"""Places on the ground as tables and as maps, and the folder of a run that gives them."""

import math
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.io.atomic_files import remove, temporary, write_whole
from torchvision_dddas.io.maps.geojson import encoded, geojson
from torchvision_dddas.io.maps.ground_tracks import Gathered
from torchvision_dddas.io.maps.kml import kml
from torchvision_dddas.io.output.detection_output import RunFolder
from torchvision_dddas.io.output.run_record import NAME, Record
from torchvision_dddas.io.tables import TextFiles
from torchvision_dddas.types import GroundLocations, Positions

COLUMNS = ("frame", "target", "east_m", "north_m", "var_east_m2", "cov_east_north_m2", "var_north_m2")
DEGREES = ("longitude_deg", "latitude_deg")
SIGHTINGS = (
    *("frame", "camera", "target", "x_px", "y_px", "width_px", "height_px", "score", "cut"),
    *("by", "distance_m", "bearing_deg", *COLUMNS[2:]),
)


def csv_lines(positions: Positions, cameras: np.ndarray) -> str:
    """One line a target in the order of COLUMNS, DEGREES where they are known, score, and by how many cameras."""
    lines = []
    for i in range(len(positions)):
        cells = [f"{positions.frame[i]}", f"{positions.target[i]}", *_place(positions, i)]
        if positions.lonlat_deg is not None:
            cells += [f"{v:.9f}" for v in positions.lonlat_deg[i]]
        lines.append(",".join([*cells, f"{positions.score[i]:.6g}", f"{cameras[i]}"]) + "\n")
    return "".join(lines)


def sighting_lines(located: GroundLocations, names: tuple[str, ...]) -> str:
    """One line a box, in the order of SIGHTINGS; a cell is empty where a value is unknown."""
    seen = located.sightings
    covariance = seen.covariance_m2
    lines = []
    for i in range(len(seen)):
        box = ",".join(f"{v:.2f}" for v in located.box_px[i])
        place = (seen.distance_m[i], math.degrees(seen.bearing_rad[i]), *seen.east_north_m[i])
        variances = (covariance[i, 0, 0], covariance[i, 0, 1], covariance[i, 1, 1])
        rest = ",".join([*(_cell(v) for v in place), *(_cell(v, ".6g") for v in variances)])
        lines.append(
            f"{located.frame},{_text(names[located.vehicle[i]])},{located.target[i]},{box},{located.score[i]:.6g},"
            f"{located.cut[i]:d},{seen.by[i]},{rest}\n"
        )
    return "".join(lines)


def _place(positions: Positions, row: int) -> list[str]:
    covariance = positions.covariance_m2[row]
    # A centimetre squared is 0.0001 m2: fixed digits would lose what is known well.
    variances = [covariance[0, 0], covariance[0, 1], covariance[1, 1]]
    return [*(_cell(v) for v in positions.east_north_m[row]), *(_cell(v, ".6g") for v in variances)]


def _text(name: str) -> str:
    """A name as a cell of a CSV."""
    return '"' + name.replace('"', '""') + '"' if set(name) & set(',"\r\n') else name


def _cell(value: float, digits: str = ".4f") -> str:
    return f"{value:{digits}}" if math.isfinite(value) else ""


class PositionTables:
    """positions.csv and sightings.csv, written as the frames go by."""

    def __init__(self, folder: Path, cameras: tuple[str, ...], geographic: bool) -> None:
        self._cameras = cameras
        header = [*COLUMNS, *(DEGREES if geographic else ()), "score", "cameras"]
        content = {folder / "positions.csv": header, folder / "sightings.csv": SIGHTINGS}
        self._files = TextFiles({path: ",".join(names) + "\n" for path, names in content.items()})

    def write(self, located: GroundLocations) -> None:
        """Add the people of a frame."""
        count = (located.members >= 0).sum(axis=1)
        self._files.write(csv_lines(located.positions, count), sighting_lines(located, self._cameras))

    def close(self, complete: bool) -> None:
        """Put the tables in their places. Raises OSError if the last lines cannot be written."""
        self._files.close()

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()


class Map:
    """tracks.geojson and tracks.kml, written at the end."""

    files = ("tracks.geojson", "tracks.kml")

    def __init__(self, folder: Path) -> None:
        self._paths = [folder / name for name in self.files]
        self._gathered = Gathered()

    def write(self, located: GroundLocations) -> None:
        """Add the people of a frame."""
        self._gathered.add(located.positions)

    def close(self, complete: bool) -> None:
        """Write the maps. Raises OSError if they cannot be written."""
        tracks = self._gathered.tracks(geographic=True)
        for path, content in zip(self._paths, (encoded(geojson(tracks)), kml(tracks).encode()), strict=True):
            write_whole(path, content)

    def discard(self) -> None:
        """Remove what was begun."""
        for path in self._paths:
            remove(temporary(path))


class PositionJournal(Record):
    """The record of a run that locates people.

    people: rows of positions.csv. by: sightings by what told their distance, `bearing` where nothing did.
    """

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        super().__init__(folder, facts)
        self.people = 0
        self.by = dict.fromkeys(("both", "height", "feet", "bearing"), 0)
        self.counts = {"people": 0, "sightings": self.by}

    def write(self, located: GroundLocations) -> None:
        """Take note of a frame."""
        self.people += len(located.positions)
        for by in located.sightings.by.tolist():
            self.by[by] += 1
        self.counts = {"people": self.people, "sightings": self.by}
        self.note(located.frame, len(located.sightings), {})


class PositionOutput(RunFolder[GroundLocations]):
    """Everything that `dddas locate ground` writes. Raises InputError as RunFolder does."""

    files = ("positions.csv", "sightings.csv", *Map.files, NAME)

    def __init__(self, folder: Path) -> None:
        """Claim a folder, as in RunFolder."""
        super().__init__(folder, ())

    def begin(self, facts: dict[str, Any], cameras: tuple[str, ...], geographic: bool) -> PositionJournal:
        """Say what the run is, for run.json, the cameras' names, and whether longitudes and latitudes are known."""
        self.journal = kept = PositionJournal(self.folder, facts)
        self._geographic = geographic
        self._sinks = [kept, PositionTables(self.folder, cameras, geographic)]
        if geographic:
            self._sinks.append(Map(self.folder))
        return kept

    def close(self, complete: bool) -> None:
        """Put everything in its place, as in RunFolder; maps of an earlier run here go if this one makes none."""
        super().close(complete)
        if not self._geographic:
            for name in Map.files:
                remove(self.folder / name)
