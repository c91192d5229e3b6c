"""The folder of a run that gives identities: tables, overlay, and the record with its counts."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchvision_dddas.io.output.detection_output import RunFolder
from torchvision_dddas.io.output.run_record import Record
from torchvision_dddas.io.output.track_tables import TrackTables
from torchvision_dddas.io.overlay import OverlayVideo, TrackPictures
from torchvision_dddas.types import TrackedFrame

SAVED = ("overlay",)
"""What --save may name. The tables and run.json are always written."""


class TrackJournal(Record):
    """The record of a run that gives identities.

    identities: how many were given; they are numbered from 1 without gaps. first: number of the first frame.
    """

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        super().__init__(folder, facts)
        self.identities = self.bridges = self.untracked = self.first = 0

    def write(self, followed: TrackedFrame) -> None:
        """Take note of a frame."""
        tracks, targets = followed.tracks, len(followed.detections)
        seen = int((tracks.row >= 0).sum())
        self.identities = int(tracks.identity.max(initial=self.identities))
        self.first = self.first or followed.number
        self.bridges += len(tracks) - seen
        self.untracked += targets - seen
        self.counts = {
            "first_frame": self.first,
            "last_frame": followed.number,
            "identities": self.identities,
            "tracked": self.targets + targets - self.untracked,
            "untracked": self.untracked,
            "bridges": self.bridges,
        }
        self.note(followed.number, targets, followed.seconds, followed.adjustments, followed.cause or None)


class TrackOutput(RunFolder[TrackedFrame]):
    """Everything that `dddas track` writes. Raises InputError as RunFolder does."""

    files = ("tracks.txt", "tracks.csv", *RunFolder.files)

    def __init__(self, folder: Path, save: Sequence[str] = SAVED) -> None:
        """Claim a folder, as in RunFolder."""
        super().__init__(folder, save)

    def begin(self, facts: dict[str, Any], rate_hz: float, size: tuple[int, int]) -> TrackJournal:
        """Say what the run is, for run.json; how fast the overlay plays and its (width, height)."""
        self.journal = kept = TrackJournal(self.folder, {**facts, "outputs": ["tables", *self._save]})
        self._sinks = [kept, TrackTables(self.folder)]
        if "overlay" in self._save:
            self._sinks.append(OverlayVideo(self.folder, rate_hz, TrackPictures(size)))
        return kept
