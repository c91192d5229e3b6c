"""The blobs' table with what the people near them say, and the folder of a run that gives it."""

import csv
import io
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchvision_dddas.io.atomic_files import remove
from torchvision_dddas.io.output.detection_output import RunFolder
from torchvision_dddas.io.output.position_output import COLUMNS as POSITION_COLUMNS
from torchvision_dddas.io.output.position_output import DEGREES
from torchvision_dddas.io.output.run_record import NAME, Record
from torchvision_dddas.io.tables import TextFiles
from torchvision_dddas.types import Confirmation, FrameResult, Positions

COLUMNS = ("kind", "probability", "seen_by", "people", "nearest_m", "nearest_sigmas", "best_score")
"""What is added to the blobs' own columns; a column of theirs with such a name is replaced."""


def csv_lines(confirmed: Confirmation, given: Sequence[Sequence[str]]) -> str:
    """One line a blob: its own cells, then COLUMNS; a cell is empty where a value is unknown.

    given: the own cells of all rows of the table. seen_by: names of vehicles, apart by semicolons.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    for i, row in enumerate(confirmed.row.tolist()):
        numbers = [(confirmed.nearest_m, 3), (confirmed.nearest_sigmas, 3), (confirmed.best, 4)]
        writer.writerow(
            [
                *given[row],
                confirmed.kind[i],
                f"{confirmed.probability[i]:.4f}",
                ";".join(confirmed.seen_by[i]),
                confirmed.people[i],
                *(_cell(float(values[i]), digits) for values, digits in numbers),
            ]
        )
    return text.getvalue()


def _cell(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else ""


class ConfirmedTable:
    """confirmed.csv, written as the frames go by."""

    def __init__(self, folder: Path, header: Sequence[str], given: Sequence[Sequence[str]]) -> None:
        self._given = given
        self._files = TextFiles({folder / "confirmed.csv": ",".join([*header, *COLUMNS]) + "\n"})

    def write(self, confirmed: Confirmation) -> None:
        """Add the blobs of a frame."""
        self._files.write(csv_lines(confirmed, self._given))

    def close(self, complete: bool) -> None:
        """Put the table in its place. Raises OSError if the last lines cannot be written."""
        self._files.close()

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()


class ConfirmedPlaces:
    """confirmed.csv of targets located from the air, written as the frames go by; none where nobody looked at any."""

    def __init__(self, folder: Path, geographic: bool) -> None:
        """geographic: whether longitudes and latitudes are known."""
        header = [*POSITION_COLUMNS, *(DEGREES if geographic else ()), *COLUMNS]
        self.path, self._geographic = folder / "confirmed.csv", geographic
        self._files = TextFiles({self.path: ",".join(header) + "\n"})
        self._written = False

    def write(self, surveyed: FrameResult) -> None:
        """Add the targets of a frame."""
        confirmed, grounded = surveyed.confirmed, surveyed.grounded
        if confirmed is None or grounded is None:
            return
        self._written = True
        given = position_text(grounded.positions, self._geographic)
        self._files.write(csv_lines(confirmed, given))

    def close(self, complete: bool) -> None:
        """Put the table in its place, or remove that of an earlier run. Raises OSError as ConfirmedTable does."""
        if self._written:
            self._files.close()
        else:
            remove(self.path)

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()


def position_text(positions: Positions, geographic: bool) -> list[list[str]]:
    """The cells of POSITION_COLUMNS and DEGREES of each row."""
    rows = []
    for k in range(len(positions)):
        (east, north), covariance = positions.east_north_m[k].tolist(), positions.covariance_m2[k]
        spread = [f"{v:.6g}" if math.isfinite(v) else "" for v in covariance[[0, 0, 1], [0, 1, 1]].tolist()]
        cells = [f"{positions.frame[k]}", f"{positions.target[k]}", f"{east:.4f}", f"{north:.4f}", *spread]
        if geographic:
            degrees = positions.lonlat_deg
            cells += ["", ""] if degrees is None else [f"{v:.9f}" for v in degrees[k].tolist()]
        rows.append(cells)
    return rows


class ConfirmJournal(Record):
    """The record of a run that confirms blobs. kinds: rows of each kind."""

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        super().__init__(folder, facts)
        self.kinds: Counter[str] = Counter()
        self.looked = 0
        self.counts = {"kinds": {}, "rows_looked_at": 0}

    def write(self, confirmed: Confirmation) -> None:
        """Take note of a frame."""
        self.kinds.update(confirmed.kind)
        self.looked += sum(bool(names) for names in confirmed.seen_by)
        self.counts = {"kinds": dict(self.kinds), "rows_looked_at": self.looked}
        self.note(confirmed.frame, len(confirmed.kind), {})


class ConfirmOutput(RunFolder[Confirmation]):
    """Everything that `dddas confirm` writes. Raises InputError as RunFolder does."""

    files = ("confirmed.csv", NAME)

    def __init__(self, folder: Path) -> None:
        """Claim a folder, as in RunFolder."""
        super().__init__(folder, ())

    def begin(self, facts: dict[str, Any], header: Sequence[str], given: Sequence[Sequence[str]]) -> ConfirmJournal:
        """Say what the run is, for run.json, and what the blobs' table holds, sorted by frame."""
        self.journal = kept = ConfirmJournal(self.folder, facts)
        self._sinks = [kept, ConfirmedTable(self.folder, header, given)]
        return kept
