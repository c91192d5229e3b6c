"""The landmarks as they were seen and used: a table that `dddas locate aerial --landmarks` takes."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from torchvision_dddas.io.tables import TextFiles
from torchvision_dddas.types import FrameResult

PLACES = {True: ("longitude_deg", "latitude_deg"), False: ("east_m", "north_m")}
COLUMNS = ("frame", "landmark", "u_px", "v_px")
MORE = ("sigma_m", "seen_by", "state")


class MarkTable:
    """landmarks.csv, written as the frames go by."""

    def __init__(self, folder: Path, names: Sequence[str], geographic: bool) -> None:
        """names: of the landmarks. geographic: whether longitudes and latitudes are known."""
        self._names = [_cell(name) for name in names]
        columns = (*COLUMNS, *PLACES[geographic], *MORE)
        self._files = TextFiles({folder / "landmarks.csv": ",".join(columns) + "\n"})

    def write(self, surveyed: FrameResult) -> None:
        """Add the landmarks of a frame that the picture shows."""
        grounded = surveyed.grounded
        if grounded is None:
            return
        marks = grounded.marks
        place, digits = marks.east_north_m, 4
        if surveyed.mark_lonlat_deg is not None:
            place, digits = surveyed.mark_lonlat_deg, 9
        state = dict(zip(grounded.fix.landmark.tolist(), grounded.fix.state, strict=True))
        by = surveyed.sighted_by or ("",) * len(marks)
        lines = []
        for k in np.flatnonzero(np.isfinite(marks.image_px).all(axis=1)).tolist():
            which = int(marks.landmark[k])
            u, v = marks.image_px[k]
            a, b = (f"{x:.{digits}f}" if math.isfinite(x) else "" for x in place[k])
            rest = f"{marks.sigma_m[k]:.4g},{by[k]},{state.get(which, '')}"
            lines.append(f"{grounded.frame},{self._names[which]},{u:.3f},{v:.3f},{a},{b},{rest}\n")
        self._files.write("".join(lines))

    def close(self, complete: bool) -> None:
        """Put the table in its place. Raises OSError if the last lines cannot be written."""
        self._files.close()

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()


def _cell(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if set(name) & set(',"\r\n') else name
