"""What each command writes into its output folder."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from torchvision_dddas.io.atomic_files import remove
from torchvision_dddas.io.images import Masks
from torchvision_dddas.io.output.ground_maps import COT, AerialMaps, GroundMaps, Site
from torchvision_dddas.io.output.recorder import Part, PartOf, RunRecorder, uninterrupted
from torchvision_dddas.io.output.run_log import LOG_TXT
from torchvision_dddas.io.output.run_record import (
    RUN_JSON,
    AerialRecord,
    ConfirmationRecord,
    DetectionRecord,
    GroundRecord,
    IdentityCounts,
    PeopleRecord,
    RunRecord,
    Spans,
    TrackRecord,
)
from torchvision_dddas.io.output.run_report import REPORT
from torchvision_dddas.io.output.run_story import RunStory
from torchvision_dddas.io.output.tables import (
    ConfirmedPositions,
    aerial_tables,
    confirmed_table,
    ground_tables,
    landmark_table,
    people_tables,
    track_tables,
)
from torchvision_dddas.io.overlay import OverlayPicture, OverlayVideo, TrackPictures, draw_people, draw_scene
from torchvision_dddas.io.overlay.layers import RunPictures
from torchvision_dddas.io.tables import detection_tables
from torchvision_dddas.types import (
    AerialLocations,
    Confirmation,
    FrameResult,
    GroundLocations,
    PeopleFrame,
    Scene,
    TrackedFrame,
)


class DetectionRecorder(RunRecorder[Scene]):
    """The folder of `dddas detect`: tables, masks, overlay."""

    files: ClassVar[tuple[str, ...]] = ("detections.txt", "detections.csv", *RunRecorder.files)
    saved: ClassVar[tuple[str, ...]] = ("masks", "overlay")

    def begin(self, facts: Mapping[str, Any], rate_hz: float) -> DetectionRecord:
        """Start the run. facts: for run.json. rate_hz: of the overlay."""
        record = DetectionRecord(self.folder, {**facts, "outputs": ["tables", *self.save]})
        parts: list[Part[Scene]] = [record, detection_tables(self.folder)]
        if "masks" in self.save:
            parts.append(Masks(self.folder))
        if "overlay" in self.save:
            parts.append(OverlayVideo(self.folder, rate_hz, draw_scene))
        self.add_parts(record, parts)
        return record


class TrackRecorder(RunRecorder[TrackedFrame]):
    """The folder of `dddas track`: tables, overlay."""

    files: ClassVar[tuple[str, ...]] = ("tracks.txt", "tracks.csv", *RunRecorder.files)
    saved: ClassVar[tuple[str, ...]] = ("overlay",)

    def begin(self, facts: Mapping[str, Any], rate_hz: float, size: tuple[int, int]) -> TrackRecord:
        """Start the run. rate_hz, size: of the overlay, (width, height)."""
        record = TrackRecord(self.folder, {**facts, "outputs": ["tables", *self.save]})
        parts: list[Part[TrackedFrame]] = [record, track_tables(self.folder)]
        if "overlay" in self.save:
            parts.append(OverlayVideo(self.folder, rate_hz, TrackPictures(size)))
        self.add_parts(record, parts)
        return record


class PeopleRecorder(RunRecorder[PeopleFrame]):
    """The folder of `dddas people`: tables, overlay."""

    files: ClassVar[tuple[str, ...]] = ("detections.txt", "detections.csv", "overlay.png", *RunRecorder.files)
    saved: ClassVar[tuple[str, ...]] = ("overlay",)

    def begin(self, facts: Mapping[str, Any], rate_hz: float, is_single: bool = False) -> PeopleRecord:
        """Start the run. rate_hz: of the overlay. is_single: one image, whose overlay is no video."""
        record = PeopleRecord(self.folder, {**facts, "outputs": ["tables", *self.save]})
        parts: list[Part[PeopleFrame]] = [record, people_tables(self.folder)]
        record.overlay = "overlay.png" if is_single else "overlay.mp4"
        if "overlay" in self.save and is_single:
            parts.append(OverlayPicture(self.folder, draw_people))
        elif "overlay" in self.save:
            parts.append(OverlayVideo(self.folder, rate_hz, draw_people))
        self.add_parts(record, parts)
        return record


class GroundRecorder(RunRecorder[GroundLocations]):
    """The folder of `dddas locate ground`: tables, maps."""

    files: ClassVar[tuple[str, ...]] = ("positions.csv", "sightings.csv", *GroundMaps.files, RUN_JSON)

    def begin(self, facts: Mapping[str, Any], cameras: Sequence[str], has_degrees: bool) -> GroundRecord:
        """Start the run. cameras: their names. has_degrees: whether longitudes and latitudes are known."""
        record = GroundRecord(self.folder, facts)
        tables = ground_tables(self.folder, cameras, has_degrees)
        self.add_parts(record, [record, tables, GroundMaps(self.folder, has_degrees)])
        return record


class ConfirmationRecorder(RunRecorder[Confirmation]):
    """The folder of `dddas confirm`: the blobs' table with what was found of them."""

    files: ClassVar[tuple[str, ...]] = ("confirmed.csv", RUN_JSON)

    def begin(
        self, facts: Mapping[str, Any], header: Sequence[str], cells: Sequence[Sequence[str]]
    ) -> ConfirmationRecord:
        """Start the run. header, cells: of the blobs' table, sorted by frame."""
        record = ConfirmationRecord(self.folder, facts)
        self.add_parts(record, [record, confirmed_table(self.folder, header, cells)])
        return record


class AerialRecorder(RunRecorder[AerialLocations]):
    """The folder of `dddas locate aerial`: tables, maps, a report."""

    files: ClassVar[tuple[str, ...]] = ("positions.csv", "fixes.csv", *AerialMaps.files, RUN_JSON)
    saved: ClassVar[tuple[str, ...]] = ("cot", "map", "report")

    def begin(self, facts: Mapping[str, Any], site: Site) -> AerialRecord:
        """Start the run."""
        record = _aerial_record(self.folder, facts, site, self.save)
        maps = AerialMaps(self.folder, record, self.save, site)
        self.add_parts(record, [record, maps, aerial_tables(self.folder, site.origin_deg is not None)])
        return record


class PipelineRecorder(RunRecorder[FrameResult]):
    """The folder of `dddas run`: tables, overlay, log, and where targets are located maps and a report of them."""

    found_files: ClassVar[tuple[str, ...]] = (
        "detections.csv",
        "detections.txt",
        "tracks.csv",
        "tracks.txt",
        LOG_TXT,
        REPORT,
        *RunRecorder.files,
    )
    """Files of a run that locates nothing."""
    files: ClassVar[tuple[str, ...]] = (
        *(*found_files, "landmarks.csv", "confirmed.csv"),
        *(name for name in AerialRecorder.files if name not in (REPORT, RUN_JSON)),
    )
    saved: ClassVar[tuple[str, ...]] = ("overlay", *AerialRecorder.saved)

    def begin(
        self, facts: Mapping[str, Any], rate_hz: float, size: tuple[int, int], site: Site | None = None
    ) -> RunRecord:
        """Start the run. rate_hz, size: of the overlay, (width, height). site: None if nothing is located."""
        folder, save = self.folder, self.save
        names = () if site is None else site.names
        pictures = RunPictures(size, names)
        name = Path(str(facts.get("input", ""))).name
        aerial = None if site is None else _aerial_record(folder, facts, site, save)
        tracked = None if aerial is not None else TrackRecord(folder, facts)
        record: RunRecord = aerial or tracked  # type: ignore[assignment]
        self.story = RunStory(folder, name, record, names, pictures if "report" in save else None)
        found: list[Part[FrameResult]] = [
            PartOf(detection_tables(folder), _scene),
            PartOf(track_tables(folder), _followed),
        ]
        if "overlay" in save:
            found.append(OverlayVideo(folder, rate_hz, pictures))
        self._is_located = site is not None
        if aerial is not None and site is not None:
            has_degrees = site.origin_deg is not None
            parts: list[Part[FrameResult]] = [
                PartOf(aerial, _grounded),
                PartOf(AerialMaps(folder, aerial, save, site, self.story), _grounded),
                PartOf(aerial_tables(folder, has_degrees), _grounded),
                _IdentityCounter(record),
                landmark_table(folder, names, has_degrees),
                ConfirmedPositions(folder, has_degrees),
            ]
        elif tracked is not None:
            parts = [PartOf(tracked, _followed)]
        self.add_parts(record, [*parts, *found, self.story])
        return record

    def close(self, complete: bool) -> None:
        """Put everything in its place; a run that locates nothing removes the files of an earlier one that did."""
        has_report = not self._is_located and "report" in self.save and self.story.record.frames > 0
        if has_report:
            with uninterrupted(), self._refusals():
                self.story.report(complete)
        super().close(complete)
        if not self._is_located:
            made = set(self.found_files) - (set() if has_report else {REPORT})
            for name in set(PipelineRecorder.files) - made:
                remove(self.folder / name)


class _IdentityCounter:
    """Adds the counts of identities, and the frames in which nothing was found, to the record of a run that locates."""

    def __init__(self, record: RunRecord) -> None:
        self._record, self._counts, self._not_found = record, IdentityCounts(), Spans(is_exact=True)

    def write(self, result: FrameResult) -> None:
        followed = result.tracked
        self._counts.add(followed)
        if followed.cause:
            self._not_found.add(followed.number, followed.number - 1, followed.cause)
        self._record.counts |= {**vars(self._counts), "nothing_found": self._not_found.rows}

    def close(self, complete: bool) -> None:
        """Nothing to write."""

    def discard(self) -> None:
        """Nothing to remove."""


def _aerial_record(folder: Path, facts: Mapping[str, Any], site: Site, save: Sequence[str]) -> AerialRecord:
    record = AerialRecord(folder, {**site.facts, **facts}, site.names)
    if site.origin_deg is None:
        record.notes.append("no longitude and latitude are known: no maps for other tools, but local metres")
    elif site.facts["start_utc"] is None and "cot" in save:
        record.notes.append(f"no clock is known: no {COT}, and times are seconds since the first frame")
    return record


def _followed(result: FrameResult) -> TrackedFrame:
    return result.tracked


def _grounded(result: FrameResult) -> AerialLocations:
    assert result.locations is not None
    return result.locations


def _scene(result: FrameResult) -> Scene:
    """The part of a scene that tables of detections need."""
    assert result.tracked.frame is not None
    return Scene(result.tracked.frame, np.zeros((0, 0), np.uint16), result.tracked.detections, 1)
