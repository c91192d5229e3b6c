"""The blobs' table with what the people near them say, and the folder of a run that gives it."""

import csv
import io
import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchvision_dddas.sinks.journal import NAME, Record
from torchvision_dddas.sinks.output import RunFolder
from torchvision_dddas.sinks.tables import TextFiles
from torchvision_dddas.types import Confirmed

COLUMNS = ("kind", "probability", "seen_by", "people", "nearest_m", "nearest_sigmas", "best_score")
"""What is added to the blobs' own columns; a column of theirs with such a name is replaced."""


def csv_lines(confirmed: Confirmed, given: Sequence[Sequence[str]]) -> str:
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

    def write(self, confirmed: Confirmed) -> None:
        """Add the blobs of a frame."""
        self._files.write(csv_lines(confirmed, self._given))

    def close(self, complete: bool) -> None:
        """Put the table in its place. Raises OSError if the last lines cannot be written."""
        self._files.close()

    def discard(self) -> None:
        """Remove what was begun."""
        self._files.discard()


class ConfirmJournal(Record):
    """The record of a run that confirms blobs. kinds: rows of each kind."""

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        super().__init__(folder, facts)
        self.kinds: Counter[str] = Counter()
        self.looked = 0
        self.counts = {"kinds": {}, "rows_looked_at": 0}

    def write(self, confirmed: Confirmed) -> None:
        """Take note of a frame."""
        self.kinds.update(confirmed.kind)
        self.looked += sum(bool(names) for names in confirmed.seen_by)
        self.counts = {"kinds": dict(self.kinds), "rows_looked_at": self.looked}
        self.note(confirmed.frame, len(confirmed.kind), {})


class ConfirmOutput(RunFolder[Confirmed]):
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
