"""Targets located from the air: tables of places and of the camera's poses, and the folder of a run that gives them."""

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from torchvision_dddas.sinks.journal import NAME, Record
from torchvision_dddas.sinks.output import RunFolder
from torchvision_dddas.sinks.positions import COLUMNS, DEGREES
from torchvision_dddas.sinks.tables import TextFiles
from torchvision_dddas.types import CameraPose, Grounded

SAVED = ("cot", "map", "report")
"""What --save may name. The tables, the maps for other tools and run.json are always written."""

MORE = ("score", "time_s", "relative_sigma_m", "velocity_east_m_s", "velocity_north_m_s", "by", "landmarks")
FIXES = (
    *("frame", "time_s", "by", "landmarks_seen", "landmarks_used", "chi2", "freedom", "east_m", "north_m", "up_m"),
    *("heading_deg", "pitch_deg", "roll_deg", "focal", "cause", "changes"),
)


def position_lines(grounded: Grounded) -> str:
    """One line a target in the order of COLUMNS, DEGREES where they are known, and MORE; unknown cells are empty.

    relative_sigma_m is the root of the covariance's trace; landmarks, how many were used.
    """
    at, fix = grounded.positions, grounded.fix
    n, covariance = len(at), at.covariance_m2
    columns: list[tuple[np.ndarray, str]] = [
        (at.east_north_m, ",%.4f,%.4f"),
        (np.stack([covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]], axis=1), ",%.4f,%.4f,%.4f"),
    ]
    if at.lonlat_deg is not None:
        columns.append((at.lonlat_deg, ",%.9f,%.9f"))
    relative = np.sqrt(np.trace(grounded.relative_m2, axis1=1, axis2=2))[:, None]
    columns += [
        (at.score[:, None], ",%.6g"),
        (np.full((n, 1), grounded.time_s), ",%.4f"),
        (relative, ",%.4f"),
        (grounded.velocity_m_s, ",%.4f,%.4f"),
    ]
    values = np.concatenate([column for column, _ in columns], axis=1)
    values[~np.isfinite(values)] = np.nan
    pattern = (
        "%d,%d" + "".join(text for _, text in columns) + f",{fix.by},{fix.state.count('used') + _moved(grounded)}\n"
    )
    rows = zip(at.frame.tolist(), at.target.tolist(), values.tolist(), strict=True)
    return "".join(pattern % (frame, target, *row) for frame, target, row in rows).replace(",nan", ",")


def _moved(grounded: Grounded) -> int:
    # A landmark that was given another's place is used all the same.
    return grounded.fix.state.count("reassigned")


def fix_line(grounded: Grounded) -> str:
    """The line of a frame in the order of FIXES; a cell is empty where a value is unknown."""
    fix = grounded.fix
    used = fix.state.count("used") + _moved(grounded)
    pose = [math.nan] * 7 if fix.pose is None else [*fix.pose.place_m, *angles_deg(fix.pose), fix.pose.focal]
    cells = [
        f"{grounded.frame}",
        _cell(grounded.time_s, 4),
        fix.by,
        f"{len(fix.landmark)}",
        f"{used}",
        _cell(fix.chi2, 3),
        f"{fix.freedom}",
        *(_cell(value, 4) for value in pose[:6]),
        _cell(pose[6], 6),
        _text(fix.cause),
        _text("; ".join(fix.changes)),
    ]
    return ",".join(cells) + "\n"


def angles_deg(pose: CameraPose) -> tuple[float, float, float]:
    """Heading in [0, 360), pitch below the horizon, roll clockwise; straight down the upper edge gives the heading."""
    right, down, forward = np.asarray(pose.axes, float).T
    level = math.hypot(forward[0], forward[1])
    pitch = math.atan2(-forward[2], level)
    if level > 1e-6:
        heading, roll = math.atan2(forward[0], forward[1]), math.atan2(-right[2], -down[2])
    else:
        upper = -down if pitch > 0 else down
        heading, roll = math.atan2(upper[0], upper[1]), 0.0
    return round(math.degrees(heading), 6) % 360, math.degrees(pitch), math.degrees(roll)


def _cell(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


def _text(words: str) -> str:
    """Words as a cell of a CSV, on one line."""
    words = " ".join(words.split())
    return '"' + words.replace('"', '""') + '"' if set(words) & set(',"') else words


class GroundedTables:
    """positions.csv and fixes.csv, written as the frames go by."""

    def __init__(self, folder: Path, geographic: bool) -> None:
        header = [*COLUMNS, *(DEGREES if geographic else ()), *MORE]
        content = {folder / "positions.csv": header, folder / "fixes.csv": FIXES}
        self._files = TextFiles({path: ",".join(names) + "\n" for path, names in content.items()})

    def write(self, grounded: Grounded) -> None:
        """Add the targets of a frame."""
        self._files.write(position_lines(grounded), fix_line(grounded))

    def close(self, complete: bool) -> None:
        """Put the tables in their places. Raises OSError if the last lines cannot be written."""
        self._files.close()

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()


class GroundedJournal(Record):
    """The record of a run that locates targets from the air.

    positions: rows of positions.csv. by: frames by what told where the camera was, `nothing` for the gaps.
    weak: spans of frames that were located, but with something amiss, and what. landmarks: of each, the frames in which
    it was seen and used, and spans of those where it was reassigned or excluded.
    """

    def __init__(self, folder: Path, facts: dict[str, Any], names: Sequence[str]) -> None:
        super().__init__(folder, facts)
        self.positions = 0
        self.names = tuple(names)
        self.by = dict.fromkeys(("pose", "homography", "paper", "telemetry", "nothing"), 0)
        self.weak: list[dict[str, Any]] = []
        self.landmarks: dict[str, dict[str, Any]] = {
            name: {"seen": 0, "used": 0, "reassigned": [], "excluded": []} for name in names
        }
        self._before = 0

    def write(self, grounded: Grounded) -> None:
        """Take note of a frame."""
        frame, fix = grounded.frame, grounded.fix
        self.positions += len(grounded.positions)
        self.by[fix.by or "nothing"] += 1
        for which, state in zip(fix.landmark.tolist(), fix.state, strict=True):
            kept = self.landmarks[self.names[which]]
            kept["seen"] += 1
            kept["used"] += state in ("used", "reassigned")
            if state in ("reassigned", "excluded"):
                self._extend(kept[state], frame)
        if fix.by and fix.cause:
            last = self.weak[-1] if self.weak else None
            if last and last["last"] == self._before and last["cause"] == fix.cause:
                last["last"] = frame
            else:
                self.weak.append({"first": frame, "last": frame, "cause": fix.cause})
        self.counts = {
            "positions": self.positions,
            "by": self.by,
            "landmarks": self.landmarks,
            "weak": self.weak,
        }
        gap = None if fix.by else fix.cause or "nothing told where the camera was"
        self.note(frame, len(grounded.box_px), grounded.seconds, grounded.adjustments, gap)
        self._before = frame

    def _extend(self, spans: list[list[int]], frame: int) -> None:
        if spans and spans[-1][1] == self._before:
            spans[-1][1] = frame
        else:
            spans.append([frame, frame])


class GroundedOutput(RunFolder[Grounded]):
    """Everything that `dddas locate aerial` writes. Raises InputError as RunFolder does."""

    files = ("positions.csv", "fixes.csv", "tracks.geojson", NAME)

    def __init__(self, folder: Path, save: Sequence[str] = SAVED) -> None:
        """Claim a folder, as in RunFolder."""
        super().__init__(folder, save)

    def begin(
        self,
        facts: dict[str, Any],
        names: Sequence[str],
        origin_deg: tuple[float, float] | None,
        start_utc_s: float = float("nan"),
        rate_hz: float | None = None,
        background: Any = None,
    ) -> GroundedJournal:
        """Say what the run is, for run.json, and the landmarks' names.

        origin_deg: longitude and latitude of the local metres, None where there are none. start_utc_s: as in Telemetry.
        """
        self.journal = kept = GroundedJournal(self.folder, facts, names)
        self._sinks = [kept, GroundedTables(self.folder, origin_deg is not None)]
        return kept
