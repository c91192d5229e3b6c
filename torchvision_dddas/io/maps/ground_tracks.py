"""The places of all targets over time, from which maps are made at the end of a run."""

import math
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np

from torchvision_dddas.types import Positions

MOST_ELLIPSES = 2_000
"""Ellipses of a map, about."""

_ROW = np.dtype(
    [
        ("frame", "i8"),
        ("target", "i8"),
        ("time_s", "f8"),
        ("east_north_m", "f8", 2),
        ("covariance_m2", "f8", (2, 2)),
        ("lonlat_deg", "f8", 2),
        ("velocity_m_s", "f8", 2),
    ]
)


@dataclass(frozen=True)
class GroundTracks:
    """All places of all targets, one row a place, by target and then by time.

    target, frame: (N,) int64. time_s: (N,) since the clip's first frame, NaN where unknown. east_north_m: (N, 2).
    covariance_m2: (N, 2, 2), velocity_m_s: (N, 2), NaN where unknown. lonlat_deg: (N, 2); None where there is no
    geographic origin. start_utc_s: seconds since 1970 at time_s = 0; NaN where no clock is known.
    """

    target: np.ndarray
    frame: np.ndarray
    time_s: np.ndarray
    east_north_m: np.ndarray
    covariance_m2: np.ndarray
    lonlat_deg: np.ndarray | None
    velocity_m_s: np.ndarray
    start_utc_s: float = float("nan")

    def __len__(self) -> int:
        return len(self.target)

    @cached_property
    def of(self) -> dict[int, slice]:
        """The rows of each target."""
        targets, first = np.unique(self.target, return_index=True)
        edges = pairwise([*first.tolist(), len(self)])
        return {target: slice(*edge) for target, edge in zip(targets.tolist(), edges, strict=True)}

    @cached_property
    def sigma_m(self) -> np.ndarray:
        """(N,) how well each place is known: the root of the covariance's trace, NaN where it is not."""
        return np.sqrt(self.covariance_m2[:, 0, 0] + self.covariance_m2[:, 1, 1])

    @cached_property
    def times_utc(self) -> list[str] | None:
        """When each place was taken, ISO 8601 to the millisecond; None where no clock is known."""
        if not (math.isfinite(self.start_utc_s) and np.isfinite(self.time_s).all()):
            return None
        return iso_utc(self.start_utc_s + self.time_s)

    def spaced(self, seconds: float, rows: slice) -> list[int]:
        """Rows of a target about so far apart in time, and its last; only the last if times are unknown."""
        last = rows.stop - 1
        due = -math.inf
        chosen: list[int] = []
        for row, at in enumerate(self.time_s[rows].tolist(), rows.start):
            # Rounded time stamps must not skip a row.
            if at >= due - 1e-6:
                chosen.append(row)
                due = at + seconds
        return chosen if chosen and chosen[-1] == last else [*chosen, last]


def iso_utc(utc_s: np.ndarray) -> list[str]:
    """Seconds since 1970 as ISO 8601 to the millisecond, as in 2026-03-01T12:00:00.250Z."""
    stamps = np.round(np.asarray(utc_s, float) * 1000).astype("i8").astype("M8[ms]")
    return [f"{stamp}Z" for stamp in np.datetime_as_string(stamps).tolist()]


class Gathered:
    """Collects rows of GroundTracks, 104 bytes each, and up to three times that while the array grows."""

    def __init__(self) -> None:
        self._rows = np.zeros(256, _ROW)
        self._count = 0

    def add(self, positions: Positions, time_s: float = math.nan, velocity_m_s: np.ndarray | None = None) -> None:
        """Keep the places of a frame."""
        count = self._count + len(positions)
        if count > len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros(max(count, len(self._rows)), _ROW)])
        rows = self._rows[self._count : count]
        rows["frame"], rows["target"], rows["time_s"] = positions.frame, positions.target, time_s
        rows["east_north_m"], rows["covariance_m2"] = positions.east_north_m, positions.covariance_m2
        rows["lonlat_deg"] = np.nan if positions.lonlat_deg is None else positions.lonlat_deg
        rows["velocity_m_s"] = np.nan if velocity_m_s is None else velocity_m_s
        self._count = count

    def tracks(self, geographic: bool, start_utc_s: float = math.nan) -> GroundTracks:
        """The places by target. geographic: whether they have longitudes and latitudes."""
        rows = self._rows[: self._count]
        rows = rows[np.argsort(rows["target"], kind="stable")]
        return GroundTracks(
            rows["target"],
            rows["frame"],
            rows["time_s"],
            rows["east_north_m"],
            rows["covariance_m2"],
            rows["lonlat_deg"] if geographic else None,
            rows["velocity_m_s"],
            start_utc_s,
        )


def ellipse_rows(tracks: GroundTracks, every_s: float = 1.0, most: int = MOST_ELLIPSES) -> np.ndarray:
    """(K,) rows whose ellipses a map shows: the last of each target, and about one each every_s before it.

    The intervals grow where there would be more than `most`; each target's last is always among them.
    """
    known = np.isfinite(tracks.covariance_m2).all(axis=(1, 2))
    span = sum(
        float(t[-1] - t[0]) for t in (tracks.time_s[rows] for rows in tracks.of.values()) if np.isfinite(t).all()
    )
    apart = max(every_s, span / most)
    rows = [row for of in tracks.of.values() for row in tracks.spaced(apart, of)]
    return np.array([row for row in rows if known[row]], int)
