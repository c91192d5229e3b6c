"""The tracks as tables: MOTChallenge text for other tools, and CSV with named columns, every detection and the rest."""

import math
from pathlib import Path

import numpy as np

from torchvision_dddas.io.overlay.layers import Trails
from torchvision_dddas.io.tables import TextFiles, compass_deg
from torchvision_dddas.types import TrackedFrame

COLUMNS = (
    *("frame", "identity", "x_px", "y_px", "width_px", "height_px", "score", "kind"),
    *("row", "heading_deg", "speed_px_per_frame"),
)


def mot_lines(followed: TrackedFrame) -> str:
    """`frame,identity,x,y,width,height,score,-1,-1,-1`, a line a box that has an identity: frames from 1."""
    tracks = followed.tracks
    return "".join(
        f"{followed.number},{identity},{x:.2f},{y:.2f},{w:.2f},{h:.2f},{score:.6g},-1,-1,-1\n"
        for identity, (x, y, w, h), score in zip(
            tracks.identity.tolist(), tracks.box_px.tolist(), tracks.score.tolist(), strict=True
        )
    )


def csv_lines(followed: TrackedFrame, motions: dict[int, tuple[float, float]]) -> str:
    """One line a box in the order of COLUMNS, those without identity last; a cell is empty where a value is unknown.

    kind: `detection`; `bridge` for a box between two detections; `untracked` for a detection without identity.
    row: the detection's line in the file it comes from, or its number in the frame. motions: identity -> heading in
    degrees clockwise from image up and speed in pixels a frame, both over the ground.
    """
    tracks, given = followed.tracks, followed.detections
    rows = followed.lines if len(followed.lines) else np.arange(1, len(given) + 1)
    lines = []
    for identity, box, score, row in zip(
        tracks.identity.tolist(), tracks.box_px.tolist(), tracks.score.tolist(), tracks.row.tolist(), strict=True
    ):
        kind, place = ("detection", rows[row]) if row >= 0 else ("bridge", "")
        heading, speed = motions.get(identity, (math.nan, math.nan))
        moving = "," if math.isnan(speed) else f"{heading:.1f},{speed:.3f}"
        lines.append(f"{followed.number},{identity},{_box(box)},{score:.6g},{kind},{place},{moving}\n")
    for row in followed.untracked:
        box, score = given.box_px[row].tolist(), given.score[row]
        lines.append(f"{followed.number},,{_box(box)},{score:.6g},untracked,{rows[row]},,\n")
    return "".join(lines)


def _box(box: list[float]) -> str:
    return ",".join(f"{value:.2f}" for value in box)


class TrackTables:
    """tracks.txt and tracks.csv, written as the clip goes by."""

    def __init__(self, folder: Path) -> None:
        self._files = TextFiles({folder / "tracks.txt": "", folder / "tracks.csv": ",".join(COLUMNS) + "\n"})
        self._trails = Trails(length=2)

    def write(self, followed: TrackedFrame) -> None:
        """Add the boxes of a frame."""
        self._trails.add(followed)
        self._files.write(mot_lines(followed), csv_lines(followed, self._motions(followed)))

    def close(self, complete: bool) -> None:
        """Put the tables in their places. Raises OSError if the last lines cannot be written."""
        self._files.close()

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()

    def _motions(self, followed: TrackedFrame) -> dict[int, tuple[float, float]]:
        """Heading and speed since the box before, of those identities that have one."""
        found = {}
        for identity in followed.tracks.identity.tolist():
            trail = self._trails.places[identity]
            if len(trail) == 2:
                (before, u0, v0), (now, u1, v1) = trail
                speed = math.hypot(u1 - u0, v1 - v0) / (now - before)
                found[identity] = compass_deg(math.atan2(v1 - v0, u1 - u0)), speed
        return found
