"""The folder of a run of the whole path: what was found, who is who, where on the ground, and the record of it all."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

import numpy as np

from torchvision_dddas.io.atomic_files import remove
from torchvision_dddas.io.output.confirmation_output import ConfirmedPlaces
from torchvision_dddas.io.output.detection_output import RunFolder, Sink, uninterrupted
from torchvision_dddas.io.output.landmark_table import MarkTable
from torchvision_dddas.io.output.location_output import SAVED as MAPS
from torchvision_dddas.io.output.location_output import GroundedJournal, GroundedOutput
from torchvision_dddas.io.output.run_log import NAME as LOG
from torchvision_dddas.io.output.run_log import WORLD
from torchvision_dddas.io.output.run_record import Record
from torchvision_dddas.io.output.track_output import TrackJournal
from torchvision_dddas.io.output.track_tables import TrackTables
from torchvision_dddas.io.overlay import OverlayVideo, RunPictures
from torchvision_dddas.io.report.run_story import REPORT, RunStory
from torchvision_dddas.io.tables import detection_tables
from torchvision_dddas.types import FrameResult, Scene, TrackedFrame

SAVED = ("overlay", *MAPS)
"""What --save may name. The tables and run.json are always written."""

FOUND = ("detections.csv", "detections.txt", "tracks.csv", "tracks.txt", LOG, REPORT, *RunFolder.files)
ALL = (*FOUND, "landmarks.csv", "confirmed.csv", *(name for name in GroundedOutput.files if name not in FOUND))
"""What a run leaves where nothing is located, and where targets are."""

Part = TypeVar("Part")


class FoundOutput(RunFolder[FrameResult]):
    """What `dddas run` writes where nothing lays the pictures on the ground. Raises InputError as RunFolder does."""

    # Those too that only a run that locates makes: of an earlier one here they go, of someone else they stop this one.
    files = ALL

    def begin(self, facts: dict[str, Any], rate_hz: float, size: tuple[int, int]) -> TrackJournal:
        """Say what the run is, for run.json; how fast the overlay plays and its (width, height)."""
        self.journal = self._kept = kept = TrackJournal(self.folder, facts)
        self._facts = facts
        self._story, more = _found(self.folder, self._save, rate_hz, size, (), kept, facts)
        self._sinks = [_Of(kept, _followed), *more]
        return kept

    def event(self, frame: int, text: str, time_s: float | None = None, kind: str = WORLD) -> None:
        """As in SurveyOutput."""
        self._story.event(frame, text, time_s, kind)

    def scored(self, measures: Mapping[str, Any], said: Sequence[str] = ()) -> None:
        """As in SurveyOutput."""
        self._story.scored(measures, said)

    def close(self, complete: bool) -> None:
        """Put everything in its place, as in RunFolder; what an earlier run here located goes."""
        made = set(FOUND)
        if "report" in self._save and self._kept.frames:
            kept = self._kept
            counted = [("frames", kept.frames), ("detections", kept.targets), ("identities", kept.identities)]
            with uninterrupted(), self._refusals():
                self._story.report(self._facts, [(name, f"{count}") for name, count in counted], complete)
        else:
            made -= {REPORT}
        super().close(complete)
        for name in set(ALL) - made:
            remove(self.folder / name)


class SurveyOutput(GroundedOutput):
    """What `dddas run` writes beside what `dddas locate aerial` does. Give it frames by `survey`."""

    files = ALL  # type: ignore[assignment]

    def __init__(self, folder: Path, save: Sequence[str] = SAVED) -> None:
        """Claim a folder, as in RunFolder."""
        super().__init__(folder, save)
        self._more: list[Sink[FrameResult]] = []

    def also(self, kept: Record, rate_hz: float, size: tuple[int, int], names: Sequence[str], geographic: bool) -> None:
        """After begin: what to write beside. kept: its record; geographic: whether longitudes are known."""
        facts = kept.facts if isinstance(kept, GroundedJournal) else {}
        self._story, found = _found(self.folder, self._save, rate_hz, size, names, kept, facts)
        self._maps.more = self._story
        self._more = [
            _Identities(kept),
            MarkTable(self.folder, names, geographic),
            ConfirmedPlaces(self.folder, geographic),
            *found,
        ]

    def event(self, frame: int, text: str, time_s: float | None = None, kind: str = WORLD) -> None:
        """Say, after `also`, what the frames do not tell themselves, for the log and the report.

        Best before the frame is surveyed: then a key frame shows it. time_s: None where the frame tells when.
        kind: one of those of run_log, as WORLD or PROBLEM.
        """
        self._story.event(frame, text, time_s, kind)

    def scored(self, measures: Mapping[str, Any], said: Sequence[str] = ()) -> None:
        """Say, after the last frame, how good the run was against the truth: values by name, and in words."""
        self._story.scored(measures, said)

    def survey(self, item: FrameResult) -> None:
        """Write a frame to every sink, or to none if Ctrl-C came before. Raises InputError if the disk refuses."""
        assert item.grounded is not None
        with uninterrupted(), self._refusals():
            for sink in self._sinks:
                sink.write(item.grounded)
            for more in self._more:
                more.write(item)

    def close(self, complete: bool) -> None:
        """Put everything in its place, run.json last. Raises InputError if the disk refuses."""
        with uninterrupted():
            with self._refusals():
                for sink in reversed(self._more):
                    sink.close(complete)
            super().close(complete)

    def discard(self) -> None:
        """Leave only what is whole."""
        with uninterrupted():
            for sink in reversed(self._more):
                sink.discard()
            super().discard()


def _found(
    folder: Path,
    save: Sequence[str],
    rate_hz: float,
    size: tuple[int, int],
    names: Sequence[str],
    kept: Record,
    facts: Mapping[str, Any],
) -> tuple[RunStory, list[Sink[FrameResult]]]:
    """Tables of what was found and who is who, the overlay, and the log."""
    sinks: list[Sink[FrameResult]] = [_Of(detection_tables(folder), _scene), _Of(TrackTables(folder), _followed)]
    pictures = RunPictures(size, names)
    if "overlay" in save:
        sinks.append(OverlayVideo(folder, rate_hz, pictures))
    shown = pictures if "report" in save else None
    story = RunStory(folder, Path(str(facts.get("input", ""))).name, kept, names, shown)
    return story, [*sinks, story]


class _Of(Generic[Part]):
    """A sink of a part of what is known of a frame."""

    def __init__(self, sink: Sink[Part], part: Callable[[FrameResult], Part]) -> None:
        self._sink, self._part = sink, part
        self.close, self.discard = sink.close, sink.discard

    def write(self, surveyed: FrameResult) -> None:
        self._sink.write(self._part(surveyed))


class _Identities:
    """Counts of identities in the record of what was located, and the frames in which nothing could be found."""

    def __init__(self, kept: Record) -> None:
        self._kept = kept
        self._identities = self._bridges = self._untracked = 0
        self._unseen: list[dict[str, Any]] = []

    def write(self, surveyed: FrameResult) -> None:
        followed = surveyed.followed
        self._identities = int(followed.tracks.identity.max(initial=self._identities))
        self._bridges += int((followed.tracks.row < 0).sum())
        self._untracked += len(followed.untracked)
        if followed.cause:
            last = self._unseen[-1] if self._unseen else None
            if last and last["cause"] == followed.cause and last["last"] == followed.number - 1:
                last["last"] = followed.number
            else:
                self._unseen.append({"first": followed.number, "last": followed.number, "cause": followed.cause})
        self._kept.counts |= {
            "identities": self._identities,
            "bridges": self._bridges,
            "untracked": self._untracked,
            "nothing_found": self._unseen,
        }

    def close(self, complete: bool) -> None:
        pass

    def discard(self) -> None:
        pass


def _followed(surveyed: FrameResult) -> TrackedFrame:
    return surveyed.followed


def _scene(surveyed: FrameResult) -> Scene:
    """As far as the tables of detections look at it."""
    followed = surveyed.followed
    assert followed.frame is not None
    return Scene(followed.frame, np.zeros((0, 0), np.uint16), followed.detections, 1)
