"""summary.csv of a run: one row per target, with its first and last place, path, speeds, classes and zones."""

import math
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.geometry import Jitter
from torchvision_dddas.io.atomic_files import OutputPart
from torchvision_dddas.io.maps.ground_tracks import iso_utc
from torchvision_dddas.io.tables import DEGREES, EAST_NORTH, Column, Schema, TableFiles
from torchvision_dddas.types import FrameResult, most_common

SUMMARY = "summary.csv"
_ENDS = ("first", "last")
_SPEEDS = ("path_m", "mean_speed_m_s", "mean_speed_sigma_m_s", "top_speed_m_s", "top_speed_sigma_m_s")
_PLACES = tuple(column.name for column in (*EAST_NORTH, *DEGREES))
_SCHEMA = Schema(
    "summary",
    *(Column("target", "d"), Column("class"), Column("class_id", ".0f"), Column("frames", "d")),
    *(
        Column(f"{end}_{name}", form)
        for end in _ENDS
        for name, form in (("frame", "d"), ("time_s", ".3f"), ("utc", ""))
    ),
    *(Column(f"{end}_{name}", ".2f") for end in _ENDS for name in ("u_px", "v_px")),
    *(Column(f"{end}_{c.name}", c.format) for end in _ENDS for c in (*EAST_NORTH, *DEGREES)),
    *(Column(name, ".3f") for name in _SPEEDS),
    Column("zones"),
)
_STEP_S, _STEP_SIGMAS = 1.0, 4.0


@dataclass
class _Look:
    """A target at one frame. place: (6,) east, north, longitude, latitude, u, v. own_m2: covariance on the ground."""

    frame: int
    time_s: float
    place: np.ndarray
    own_m2: np.ndarray


@dataclass
class _Row:
    """A target. placed, step: first place, and last step of the path. end: last place, where the path ends.

    top: highest speed over a step, with its standard deviation.
    """

    first: _Look
    last: _Look
    frames: int = 0
    placed: _Look | None = None
    step: _Look | None = None
    end: _Look | None = None
    path_m: float = 0.0
    top: tuple[float, float] = (math.nan, math.nan)
    jitter: Jitter = field(default_factory=Jitter)
    classes: Counter[tuple[str, int]] = field(default_factory=Counter)
    zones: dict[str, None] = field(default_factory=dict)

    def go(self, now: _Look) -> None:
        """Add a step to the path, if it lasts 1 s and its length exceeds four standard deviations of the jitter.

        Shorter steps would add up the jitter of the places.
        """
        self.jitter.add(now.time_s, now.place[:2])
        if self.placed is None or self.step is None:
            self.placed = self.step = now
        self.end = now
        lapse, sigma_m = now.time_s - self.step.time_s, math.sqrt(2) * self.jitter.sigma
        length_m = float(np.hypot(*(now.place[:2] - self.step.place[:2])))
        if lapse >= _STEP_S and length_m > _STEP_SIGMAS * sigma_m:
            self.path_m += length_m
            if not length_m / lapse <= self.top[0]:
                self.top = length_m / lapse, sigma_m / lapse
            self.step = now

    def speeds(self) -> list[float]:
        """Return path, mean and top speed, each speed with its standard deviation.

        The mean speed is over the time of the path. Its error follows from the covariances of the two ends.
        """
        if self.placed is None or self.step is None or self.step is self.placed:
            return [math.nan if self.placed is None else 0.0, *[math.nan] * 4]
        lapse, way = self.step.time_s - self.placed.time_s, self.step.place[:2] - self.placed.place[:2]
        along = way / max(float(np.hypot(*way)), 1e-9)
        variance = float(along @ (self.placed.own_m2 + self.step.own_m2) @ along)
        rest_m = float(np.hypot(*(self.end.place[:2] - self.step.place[:2]))) if self.end is not None else 0.0
        return [self.path_m + rest_m, self.path_m / lapse, math.sqrt(max(variance, 0.0)) / lapse, *self.top]


class Summary(OutputPart[FrameResult]):
    """Writes summary.csv. Memory: about 2 kB per target."""

    def __init__(self, folder: Path, start_utc_s: float = math.nan) -> None:
        self._rows: dict[int, _Row] = {}
        self._start_utc_s = start_utc_s
        self._table = TableFiles[dict[str, list[Any]]]({folder / SUMMARY: (_SCHEMA, lambda rows: rows)})

    def write(self, item: FrameResult) -> None:
        """Add a frame."""
        tracks, located, time_s = item.tracks, item.locations, item.time_s
        feet = tracks.foot_px
        at = {} if located is None else {n: k for k, n in enumerate(located.positions.target.tolist())}
        for k in np.flatnonzero(tracks.row >= 0).tolist():
            number, place, own_m2 = int(tracks.identity[k]), np.full(6, np.nan), np.full((2, 2), np.nan)
            place[4:] = feet[k]
            if located is not None and (row := at.get(number)) is not None:
                positions, own_m2 = located.positions, located.relative_m2[row]
                place[:2] = positions.east_north_m[row]
                place[2:4] = np.nan if positions.lonlat_deg is None else positions.lonlat_deg[row]
            look = _Look(item.number, time_s, place, own_m2)
            target = self._rows.setdefault(number, _Row(look, look))
            target.last, target.frames = look, target.frames + 1
            target.classes[str(tracks.label[k] or ""), int(tracks.class_id[k])] += 1
            if np.isfinite(place[:2]).all() and math.isfinite(time_s):
                target.go(look)
        for event in item.events:
            if event.zone and event.target in self._rows:
                self._rows[event.target].zones[event.zone] = None

    def close(self, complete: bool) -> None:
        """Write the table. Raise OSError if it cannot be written."""
        columns: dict[str, list[Any]] = {name: [] for name in _SCHEMA.names}
        for number, row in sorted(self._rows.items()):
            label, class_id = most_common(row.classes)
            cells: dict[str, Any] = {"target": number, "class": label, "class_id": class_id if class_id >= 0 else None}
            cells |= {
                "frames": row.frames,
                "zones": ";".join(row.zones),
                **dict(zip(_SPEEDS, row.speeds(), strict=True)),
            }
            for end, look in zip(_ENDS, (row.first, row.last), strict=True):
                utc_s = self._start_utc_s + look.time_s
                cells[f"{end}_utc"] = iso_utc(np.array([utc_s]))[0] if math.isfinite(utc_s) else None
                names = ("frame", "time_s", *_PLACES, "u_px", "v_px")
                values = look.frame, look.time_s, *look.place.tolist()
                cells |= {f"{end}_{name}": value for name, value in zip(names, values, strict=True)}
            for name, column in columns.items():
                column.append(cells[name])
        self._table.write(columns)
        self._table.close()

    def discard(self) -> None:
        """Remove the unfinished file."""
        self._table.discard()
