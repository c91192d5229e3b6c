"""The folder of a run that recognizes people: tables, overlay, and the record with its counts."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from torchvision_dddas.io.output.detection_output import RunFolder
from torchvision_dddas.io.output.people_tables import PeopleTables
from torchvision_dddas.io.output.run_record import Record
from torchvision_dddas.io.overlay import OverlayPicture, OverlayVideo, draw_people
from torchvision_dddas.io.overlay.layers import LIKELY
from torchvision_dddas.types import PeopleFrame

SAVED = ("overlay",)
"""What --save may name. The tables and run.json are always written."""


class PeopleJournal(Record):
    """The record of a run that recognizes people.

    unlikely: people who are less likely than not ones. cut: people whom the picture's border cuts. share: windows
    searched, as a share of all those of all frames. overlay: name of the film, or of the picture where there is one.
    """

    def __init__(self, folder: Path, facts: dict[str, Any]) -> None:
        super().__init__(folder, facts)
        self.unlikely = self.cut = self.everywhere = self.nowhere = self.unread = 0
        self.share = 0.0
        self.overlay = "overlay.mp4"

    def write(self, recognized: PeopleFrame) -> None:
        """Take note of a frame."""
        self.unlikely += int((recognized.people.score < LIKELY).sum())
        self.cut += int(recognized.people.cut.sum())
        if recognized.cause:
            self.unread += 1
        else:
            self.everywhere += recognized.regions_px is None
            self.nowhere += recognized.share == 0
            looked = self.frames + 1 - self.unread
            self.share += (recognized.share - self.share) / looked
        self.counts = {
            "unlikely": self.unlikely,
            "cut": self.cut,
            "searched": {
                "share_of_windows": round(self.share, 4),
                "frames_everywhere": self.everywhere,
                "frames_in_regions": self.frames + 1 - self.unread - self.everywhere - self.nowhere,
                "frames_nowhere": self.nowhere,
            },
        }
        self.note(
            recognized.frame.number,
            len(recognized.people),
            recognized.seconds,
            recognized.adjustments,
            recognized.cause or None,
        )


class PeopleOutput(RunFolder[PeopleFrame]):
    """Everything that `dddas people` writes. Raises InputError as RunFolder does."""

    files = ("detections.txt", "detections.csv", "overlay.png", *RunFolder.files)

    def __init__(self, folder: Path, save: Sequence[str] = SAVED) -> None:
        """Claim a folder, as in RunFolder."""
        super().__init__(folder, save)

    def begin(self, facts: dict[str, Any], rate_hz: float, single: bool = False) -> PeopleJournal:
        """Say what the run is, for run.json, and how fast the overlay plays; single: it is one picture, no film."""
        self.journal = kept = PeopleJournal(self.folder, {**facts, "outputs": ["tables", *self._save]})
        self._sinks = [kept, PeopleTables(self.folder)]
        kept.overlay = "overlay.png" if single else "overlay.mp4"
        if "overlay" in self._save:
            self._sinks.append(
                OverlayPicture(self.folder, draw_people) if single else OverlayVideo(self.folder, rate_hz, draw_people)
            )
        return kept
