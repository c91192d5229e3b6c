"""Places on the ground as tables and as GeoJSON, and the folder of a run that gives them."""

import json
import math
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.sinks.journal import NAME, Record
from torchvision_dddas.sinks.output import RunFolder
from torchvision_dddas.sinks.tables import TextFiles
from torchvision_dddas.sinks.whole import remove, temporary, write_whole
from torchvision_dddas.types import Located, Positions

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


def sighting_lines(located: Located, names: tuple[str, ...]) -> str:
    """One line a box, in the order of SIGHTINGS; a cell is empty where a value is unknown."""
    seen = located.sightings
    covariance = seen.covariance_m2
    lines = []
    for i in range(len(seen)):
        box = ",".join(f"{v:.2f}" for v in located.box_px[i])
        place = [*seen.east_north_m[i], covariance[i, 0, 0], covariance[i, 0, 1], covariance[i, 1, 1]]
        rest = ",".join(_cell(v) for v in (seen.distance_m[i], math.degrees(seen.bearing_rad[i]), *place))
        lines.append(
            f"{located.frame},{_text(names[located.vehicle[i]])},{located.target[i]},{box},{located.score[i]:.6g},"
            f"{located.cut[i]:d},{seen.by[i]},{rest}\n"
        )
    return "".join(lines)


def geojson(positions: Positions) -> dict[str, Any]:
    """A FeatureCollection (RFC 7946), a feature a target: a line, or a point where it was located once.

    `frames` has the frame of each place, `sigma_m` how well it is known: the root of the covariance's trace, null where
    it is not. A line over 180 degrees of longitude is cut there, into lines whose ends on it are no places of frames.
    Raises ValueError where there is no geographic origin.
    """
    if positions.lonlat_deg is None:
        raise ValueError("these positions have no longitude and latitude")
    features = []
    for target in np.unique(positions.target).tolist():
        rows = np.flatnonzero(positions.target == target)
        # 1e-8 of a degree is a millimetre.
        places = [[round(float(v), 8) for v in positions.lonlat_deg[row]] for row in rows]
        sigma = np.sqrt(np.trace(positions.covariance_m2[rows], axis1=1, axis2=2))
        shape = _line(places) if len(rows) > 1 else {"type": "Point", "coordinates": places[0]}
        features.append(
            {
                "type": "Feature",
                "geometry": shape,
                "properties": {
                    "target": target,
                    "frames": positions.frame[rows].tolist(),
                    "sigma_m": [round(float(s), 3) if math.isfinite(s) else None for s in sigma],
                },
            }
        )
    return {"type": "FeatureCollection", "features": features}


def _line(places: list[list[float]]) -> dict[str, Any]:
    lines = [places[:1]]
    for before, after in pairwise(places):
        if abs(after[0] - before[0]) > 180:
            edge = math.copysign(180.0, before[0])
            # Degrees to the edge, and from it on the other side.
            here, there = abs(edge - before[0]), abs(-edge - after[0])
            share = here / (here + there) if here + there > 0 else 0.0
            latitude = round(before[1] + share * (after[1] - before[1]), 8)
            lines[-1].append([edge, latitude])
            lines.append([[-edge, latitude]])
        lines[-1].append(after)
    if len(lines) == 1:
        return {"type": "LineString", "coordinates": lines[0]}
    return {"type": "MultiLineString", "coordinates": lines}


def _place(positions: Positions, row: int) -> list[str]:
    covariance = positions.covariance_m2[row]
    values = [*positions.east_north_m[row], covariance[0, 0], covariance[0, 1], covariance[1, 1]]
    return [_cell(v) for v in values]


def _text(name: str) -> str:
    """A name as a cell of a CSV."""
    return '"' + name.replace('"', '""') + '"' if set(name) & set(',"\r\n') else name


def _cell(value: float) -> str:
    return f"{value:.4f}" if math.isfinite(value) else ""


class PositionTables:
    """positions.csv and sightings.csv, written as the frames go by."""

    def __init__(self, folder: Path, cameras: tuple[str, ...], geographic: bool) -> None:
        self._cameras = cameras
        header = [*COLUMNS, *(DEGREES if geographic else ()), "score", "cameras"]
        content = {folder / "positions.csv": header, folder / "sightings.csv": SIGHTINGS}
        self._files = TextFiles({path: ",".join(names) + "\n" for path, names in content.items()})

    def write(self, located: Located) -> None:
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
    """tracks.geojson, written at the end."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / "tracks.geojson"
        self._parts: list[Positions] = []

    def write(self, located: Located) -> None:
        """Add the people of a frame."""
        self._parts.append(located.positions)

    def close(self, complete: bool) -> None:
        """Write the map. Raises OSError if it cannot be written."""
        parts = self._parts
        whole = Positions(lonlat_deg=np.zeros((0, 2)))
        if parts:
            names = ("frame", "target", "east_north_m", "covariance_m2", "score", "lonlat_deg")
            columns: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
            whole = Positions(**columns)
        write_whole(self._path, (json.dumps(geojson(whole)) + "\n").encode())

    def discard(self) -> None:
        """Remove what was begun."""
        remove(temporary(self._path))


class PositionJournal(Record):
    """The record of a run that locates people.

    people: rows of positions.csv. by: sightings by what told their distance, `bearing` where nothing did.
    """

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        super().__init__(folder, facts)
        self.people = 0
        self.by = dict.fromkeys(("both", "height", "feet", "bearing"), 0)
        self.counts = {"people": 0, "sightings": self.by}

    def write(self, located: Located) -> None:
        """Take note of a frame."""
        self.people += len(located.positions)
        for by in located.sightings.by.tolist():
            self.by[by] += 1
        self.counts = {"people": self.people, "sightings": self.by}
        self.note(located.frame, len(located.sightings), {})


class PositionOutput(RunFolder[Located]):
    """Everything that `dddas locate ground` writes. Raises InputError as RunFolder does."""

    files = ("positions.csv", "sightings.csv", "tracks.geojson", NAME)

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
        """Put everything in its place, as in RunFolder; a map of an earlier run here goes if this one makes none."""
        super().close(complete)
        if not self._geographic:
            remove(self.folder / "tracks.geojson")
