"""Targets located from the air as tables: where they are, and how each picture lies on the ground."""

import math
from pathlib import Path

import numpy as np

from torchvision_dddas.io.output.position_output import COLUMNS, DEGREES
from torchvision_dddas.io.report.timelines import USED
from torchvision_dddas.io.tables import TextFiles
from torchvision_dddas.types import AerialLocations, CameraPose, Fix

MORE = ("score", "time_s", "relative_sigma_m", "velocity_east_m_s", "velocity_north_m_s", "by", "landmarks")
"""Columns of positions.csv after those that all positions have."""

FIXES = (
    *("frame", "time_s", "by", "landmarks_seen", "landmarks_used", "chi2", "freedom", "east_m", "north_m", "up_m"),
    *("heading_deg", "pitch_deg", "roll_deg", "upper_edge_deg", "focal", "cause", "changes"),
)
"""Columns of fixes.csv. Where the camera looks nearly straight down, heading and roll are loose, each against the
other; the bearing of the picture's upper edge is steady there. focal: as a share of what the camera's file says."""


def position_lines(grounded: AerialLocations) -> str:
    """One line a target in the order of COLUMNS, DEGREES where they are known, and MORE; unknown cells are empty.

    relative_sigma_m: relative to the team, the root of the covariance's trace. landmarks: how many were used.
    """
    at, fix = grounded.positions, grounded.fix
    n, covariance = len(at), at.covariance_m2
    columns: list[tuple[np.ndarray, str]] = [
        (at.east_north_m, ",%.4f,%.4f"),
        (np.stack([covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]], axis=1), ",%.6g,%.6g,%.6g"),
    ]
    if at.lonlat_deg is not None:
        columns.append((at.lonlat_deg, ",%.9f,%.9f"))
    columns += [
        (at.score[:, None], ",%.6g"),
        (np.full((n, 1), grounded.time_s), ",%.4f"),
        (np.sqrt(np.trace(grounded.relative_m2, axis1=1, axis2=2))[:, None], ",%.6g"),
        (grounded.velocity_m_s, ",%.4f,%.4f"),
    ]
    values = np.concatenate([column for column, _ in columns], axis=1)
    values[~np.isfinite(values)] = np.nan
    pattern = "%d,%d" + "".join(text for _, text in columns) + f",{fix.by},{used(fix)}\n"
    rows = zip(at.frame.tolist(), at.target.tolist(), values.tolist(), strict=True)
    return "".join(pattern % (frame, target, *row) for frame, target, row in rows).replace(",nan", ",")


def fix_line(grounded: AerialLocations) -> str:
    """The line of a frame in the order of FIXES; a cell is empty where a value is unknown."""
    fix = grounded.fix
    pose = [math.nan] * 8
    if fix.pose is not None:
        pose = [*fix.pose.place_m, *angles_deg(fix.pose), upper_edge_deg(fix.pose), fix.pose.focal]
    cells = [
        f"{grounded.frame}",
        _cell(grounded.time_s, 4),
        fix.by,
        f"{len(fix.landmark)}",
        f"{used(fix)}",
        _cell(fix.chi2, 3),
        f"{fix.freedom}",
        *(_cell(value, 4) for value in pose[:7]),
        _cell(pose[7], 6),
        _text(fix.cause),
        _text("; ".join(fix.changes)),
    ]
    return ",".join(cells) + "\n"


def used(fix: Fix) -> int:
    """How many landmarks took part."""
    return sum(state in USED for state in fix.state)


def angles_deg(pose: CameraPose) -> tuple[float, float, float]:
    """Heading in [0, 360), pitch below the horizon, roll clockwise; straight down the upper edge gives the heading."""
    heading, pitch, roll = pose.angles_rad
    # Rounded first, so that a hair below north is not written as 360.
    return round(math.degrees(heading), 4) % 360, math.degrees(pitch), math.degrees(roll)


def upper_edge_deg(pose: CameraPose) -> float:
    """Where the picture's upper edge lies, seen from its middle: a bearing in [0, 360); NaN where it is overhead."""
    east, north, _ = -np.asarray(pose.axes, float)[:, 1]
    return round(math.degrees(math.atan2(east, north)), 4) % 360 if math.hypot(east, north) > 1e-9 else math.nan


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

    def write(self, grounded: AerialLocations) -> None:
        """Add the targets of a frame."""
        self._files.write(position_lines(grounded), fix_line(grounded))

    def close(self, complete: bool) -> None:
        """Put the tables in their places. Raises OSError if the last lines cannot be written."""
        self._files.close()

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()
