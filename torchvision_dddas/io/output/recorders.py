"""The output folder of each command."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from operator import attrgetter
from typing import Any, ClassVar

import numpy as np

from torchvision_dddas.io.atomic_files import OutputPart
from torchvision_dddas.io.images import Masks
from torchvision_dddas.io.output import tables
from torchvision_dddas.io.output.map_files import COT, AerialMaps, GroundMaps, MapSite
from torchvision_dddas.io.output.recorder import PartOf, RunRecorder
from torchvision_dddas.io.output.run_log import LOG_TXT, RunStory
from torchvision_dddas.io.output.run_record import (
    NO_POSE,
    RUN_JSON,
    RunRecord,
    Spans,
    describe_nothing_located,
    without_numbers,
)
from torchvision_dddas.io.output.run_report import REPORT
from torchvision_dddas.io.output.scale_record import ScaleRecord
from torchvision_dddas.io.output.summary import SUMMARY, Summary
from torchvision_dddas.io.output.zone_events import EventFiles, ZoneCounts
from torchvision_dddas.io.overlay import LIKELY, RunPictures, draw_people, draw_scene
from torchvision_dddas.io.overlay_video import OverlayPicture, OverlayVideo
from torchvision_dddas.io.tables import detection_tables
from torchvision_dddas.types import (
    AerialLocations,
    Confirmation,
    FrameResult,
    GroundLocations,
    PeopleFrame,
    Scene,
    SharedFrame,
    TrackedFrame,
    Zone,
)


class DetectionRecorder(RunRecorder[Scene]):
    """Write the output folder of `dddas detect`: tables, masks and an overlay."""

    files = ("detections.txt", "detections.csv", "overlay.mp4", RUN_JSON)
    numbered = ("masks",)
    saved = ("masks", "overlay")

    def begin(self, facts: Mapping[str, Any], rate_hz: float) -> RunRecord:
        """Start the run. facts: entries for run.json. rate_hz: frame rate of the overlay."""
        parts: dict[str, OutputPart[Scene]] = {
            "tables": detection_tables(self.folder),
            "masks": Masks(self.folder),
            "overlay": OverlayVideo(self.folder, rate_hz, draw_scene),
        }
        record = self.start({**facts, "outputs": ["tables", *self.save]}, parts)
        record.scale = ScaleRecord(facts.get("settings", {}))
        return record

    def _count(self, item: Scene) -> None:
        cause = None if item.reliable else item.cause
        self.record.note(item.frame.number, len(item.detections), item.seconds, item.adjustments, cause)


class TrackRecorder(RunRecorder[TrackedFrame]):
    """Write the output folder of `dddas track`: tables and an overlay."""

    files = ("tracks.csv", "tracks.txt", "appearance.csv", "overlay.mp4", RUN_JSON)
    saved = ("overlay",)

    def begin(self, facts: Mapping[str, Any], rate_hz: float, size: tuple[int, int]) -> RunRecord:
        """Start the run. rate_hz, size: frame rate and (width, height) of the overlay."""
        pictures = RunPictures(size)
        parts: dict[str, OutputPart[TrackedFrame]] = {
            "tables": tables.track_tables(self.folder),
            "appearance": tables.appearance_table(self.folder),
            "overlay": OverlayVideo(self.folder, rate_hz, lambda tracked: pictures(FrameResult(tracked))),
        }
        record = self.start({**facts, "outputs": ["tables", *self.save]}, parts)
        if facts.get("detections") is None:
            record.scale = ScaleRecord(facts.get("settings", {}))
        return record

    def _count(self, item: TrackedFrame) -> None:
        _count_tracks(self.record, item)


class PeopleRecorder(RunRecorder[PeopleFrame]):
    """Write the output folder of `dddas people`: tables and an overlay.

    The record counts unlikely people and people cut by the picture's border. It states which share of the windows of
    all frames was searched.
    """

    files = ("detections.txt", "detections.csv", "overlay.png", "overlay.mp4", RUN_JSON)
    numbered = ("masks",)  # masks of an earlier `dddas detect`, whose detections.csv is replaced
    saved = ("overlay",)

    def begin(self, facts: Mapping[str, Any], rate_hz: float, is_single: bool = False) -> RunRecord:
        """Start the run. rate_hz: frame rate of the overlay. is_single: input and overlay are a single image."""
        overlay: OutputPart[PeopleFrame] = OverlayVideo(self.folder, rate_hz, draw_people)
        if is_single:
            overlay = OverlayPicture(self.folder, draw_people)
        record = self.start(
            {**facts, "outputs": ["tables", *self.save]},
            {"tables": tables.people_tables(self.folder), "overlay": overlay},
        )
        searched = ("share_of_windows", "frames_everywhere", "frames_in_regions", "frames_nowhere")
        record.counts = {"unlikely": 0, "cut": 0, "searched": dict.fromkeys(searched, 0)}
        self._shares = 0.0
        return record

    def _count(self, item: PeopleFrame) -> None:
        counts, people = self.record.counts, item.people
        counts["unlikely"] += int((people.score < LIKELY).sum())
        counts["cut"] += int(people.cut.sum())
        if not item.cause:
            searched = counts["searched"]
            kind = "everywhere" if item.regions_px is None else "nowhere" if item.share == 0 else "in_regions"
            searched[f"frames_{kind}"] += 1
            self._shares += item.share
            frames = sum(searched.values()) - searched["share_of_windows"]
            searched["share_of_windows"] = round(self._shares / frames, 4)
        self.record.note(item.frame.number, len(people), item.seconds, item.adjustments, item.cause or None)


class GroundRecorder(RunRecorder[GroundLocations]):
    """Write the output folder of `dddas locate ground`: tables and maps.

    The record counts rows of positions.csv, and sightings by the source of their distance (`bearing`: no distance).
    """

    files = ("positions.csv", "sightings.csv", *GroundMaps.files, RUN_JSON)

    def begin(self, facts: Mapping[str, Any], cameras: Sequence[str], has_degrees: bool) -> RunRecord:
        """Start the run. cameras: names of the cameras. has_degrees: whether longitudes and latitudes are known."""
        parts: dict[str, OutputPart[GroundLocations]] = {
            "tables": tables.ground_tables(self.folder, cameras, has_degrees),
            "maps": GroundMaps(self.folder, has_degrees),
        }
        record = self.start(facts, parts)
        record.counts = {"people": 0, "sightings": dict.fromkeys(("both", "height", "feet", "bearing"), 0)}
        return record

    def _count(self, item: GroundLocations) -> None:
        counts = self.record.counts
        counts["people"] += len(item.positions)
        for by in item.sightings.by.tolist():
            counts["sightings"][by] += 1
        self.record.note(item.frame, len(item.sightings), {})


class ConfirmationRecorder(RunRecorder[Confirmation]):
    """Write the output folder of `dddas confirm`: the table of blobs with findings. Count the blobs of each kind."""

    files = ("confirmed.csv", RUN_JSON)

    def begin(self, facts: Mapping[str, Any], header: Sequence[str], cells: Sequence[Sequence[str]]) -> RunRecord:
        """Start the run. header, cells: column names and cells of the table of blobs, sorted by frame."""
        record = self.start(facts, {"table": tables.confirmed_table(self.folder, header, cells)})
        record.counts = {"kinds": {}, "rows_looked_at": 0}
        return record

    def _count(self, item: Confirmation) -> None:
        counts = self.record.counts
        for kind in item.kind:
            counts["kinds"][kind] = counts["kinds"].get(kind, 0) + 1
        counts["rows_looked_at"] += sum(bool(names) for names in item.seen_by)
        self.record.note(item.frame, len(item.kind), {})


class ViewsRecorder(RunRecorder[SharedFrame]):
    """Write the output folder of `dddas views`: tables with shared identities, of pairs, and of maps between views."""

    files = ("view*.csv", "pairs.csv", "maps.csv", RUN_JSON)

    def begin(
        self, facts: Mapping[str, Any], own: str, cells: Sequence[tuple[list[str], list[list[str]]]]
    ) -> RunRecord:
        """Start the run. own: column of the tables' own identities. cells: column names and cells of each table."""
        parts: dict[str, OutputPart[SharedFrame]] = {
            f"view{k}": tables.view_table(self.folder, k, own, *view) for k, view in enumerate(cells)
        }
        record = self.start(
            facts, {**parts, "pairs": tables.pair_table(self.folder), "maps": tables.map_table(self.folder)}
        )
        self._views: dict[int, set[int]] = {}
        self._registered: Counter[str] = Counter()
        record.counts = {"identities": 0, "shared": 0, "registered": {}}
        return record

    def _count(self, item: SharedFrame) -> None:
        for k, shared in enumerate(item.shared):
            for number in shared.tolist():
                self._views.setdefault(number, set()).add(k)
        for (i, j), found in item.maps.items():
            self._registered[f"{i + 1}-{j + 1}"] += found.b_from_a is not None
        several = sum(len(views) > 1 for views in self._views.values())
        self.record.counts |= {"identities": len(self._views), "shared": several, "registered": dict(self._registered)}
        self.record.note(item.moment, sum(map(len, item.views)), {})

    def note_overlap(self) -> None:
        """Note pairs of views that were not registered, and in how many moments."""
        for pair, count in self._registered.items():
            if count < self.record.frames:
                why = "the overlap was not found, or too few targets were in it" if count else "no overlap was found"
                moments = f"in {self.record.frames - count} of {self.record.frames} moments"
                hint = "" if count else "; check that the clips begin at the same time and share five targets"
                self.record.notes.append(f"views {pair}: {why} {moments}{hint}")


class AerialRecorder(RunRecorder[AerialLocations]):
    """Write the output folder of `dddas locate aerial`: tables, maps and a report."""

    files = ("positions.csv", "fixes.csv", *AerialMaps.files, RUN_JSON)
    saved = ("cot", "map", "report")

    def begin(self, facts: Mapping[str, Any], site: MapSite) -> RunRecord:
        """Start the run."""
        maps = AerialMaps(self.folder, self.save, site)
        places = tables.aerial_tables(self.folder, site.origin_deg is not None, _grid(facts))
        parts: dict[str, OutputPart[AerialLocations]] = {"maps": maps, "tables": places}
        record = maps.record = self.start({**site.facts, **facts}, parts)
        record.notes += _missing_maps(site, self.save)
        self._counts = _LocationCounts(record, site.names)
        return record

    def _count(self, item: AerialLocations) -> None:
        self._counts.add(item)

    def close(self, complete: bool) -> None:
        """Note the reason if nothing was located, and move all files to their places."""
        self._counts.note_unplaced()
        super().close(complete)


class PipelineRecorder(RunRecorder[FrameResult]):
    """Write the output folder of `dddas run`: tables, overlay, log and report, and maps if targets are located."""

    found_files: ClassVar[tuple[str, ...]] = (
        *("detections.csv", "detections.txt", "tracks.csv", "tracks.txt", "appearance.csv", SUMMARY, *EventFiles.files),
        *(LOG_TXT, REPORT, "overlay.mp4", RUN_JSON),
    )
    """Files of a run without located targets."""
    files: ClassVar[tuple[str, ...]] = (
        *(*found_files, "landmarks.csv", "confirmed.csv", "crowds.csv", "fused.csv"),
        *(name for name in AerialRecorder.files if name not in (REPORT, RUN_JSON)),
    )
    numbered: ClassVar[tuple[str, ...]] = ("masks",)  # as in PeopleRecorder
    saved: ClassVar[tuple[str, ...]] = ("overlay", *AerialRecorder.saved)

    def begin(
        self,
        facts: Mapping[str, Any],
        rate_hz: float,
        size: tuple[int, int],
        site: MapSite | None = None,
        zones: Sequence[Zone] = (),
    ) -> RunRecord:
        """Start the run. rate_hz, size: frame rate and (width, height) of the overlay. site: None: locate nothing."""
        folder, save = self.folder, self.save
        names = () if site is None else site.names
        pictures = RunPictures(size, names, zones)
        self.story = RunStory(folder, names, pictures if "report" in save else None, site is not None)
        parts: dict[str, OutputPart[FrameResult]] = {}
        start_utc_s = math.nan if site is None else site.start_utc_s
        if site is not None:
            has_degrees = site.origin_deg is not None
            maps = AerialMaps(folder, save, site, self.story, zones)
            parts |= {
                "maps": PartOf(maps, _locations),
                "positions": PartOf(tables.aerial_tables(folder, has_degrees, _grid(facts)), _locations),
                **({"landmarks": tables.landmark_table(folder, names, has_degrees)} if names else {}),
                "confirmed": tables.confirmed_positions(folder, has_degrees),
                "crowds": tables.crowd_table(folder, has_degrees),
                "fused": PartOf(tables.fused_table(folder, has_degrees), attrgetter("fused")),
            }
        parts |= {
            "detections": PartOf(detection_tables(folder), _scene),
            "tracks": PartOf(tables.track_tables(folder), attrgetter("tracked")),
            "appearance": PartOf(tables.appearance_table(folder), attrgetter("tracked")),
            "overlay": OverlayVideo(folder, rate_hz, pictures),
            "story": self.story,
            "summary": Summary(folder, start_utc_s),
        }
        has_crowds = site is not None and facts.get("settings", {}).get("crowds", {}).get("join_m", 0) > 0
        if zones or has_crowds:
            parts["events"] = EventFiles(folder, zones, start_utc_s, site is not None and site.origin_deg is not None)
        record = self.story.record = self.start({**(site.facts if site is not None else {}), **facts}, parts)
        record.scale = ScaleRecord(facts.get("settings", {}))
        self._zones = ZoneCounts(zones)
        if zones:
            record.counts["zones"] = self._zones.rows
        if has_crowds:
            record.counts["crowd_events"] = self._zones.crowds
        self._locations = None
        if site is not None:
            maps.record, self._maps = record, maps
            record.notes += _missing_maps(site, save)
            self._locations, self._not_found = _LocationCounts(record, names), Spans(is_exact=True)
            record.counts["nothing_found"] = self._not_found.rows
        return record

    def _count(self, item: FrameResult) -> None:
        tracked = item.tracked
        self._zones.add(item.events)
        if self._locations is None:
            _count_tracks(self.record, tracked)
            return
        self._locations.add(_locations(item))
        if item.fused is not None:
            self._maps.add_fused(item.fused)
        _count_identities(self.record.counts, tracked)
        if tracked.cause:
            self._not_found.add(tracked.number, tracked.number - 1, tracked.cause)

    def close(self, complete: bool) -> None:
        """Note the reason if nothing was located, and move all files to their places."""
        if self._locations is not None:
            self._locations.note_unplaced()
        super().close(complete)


def _count_identities(counts: dict[str, Any], tracked: TrackedFrame) -> None:
    """Count a frame: identities so far, boxes that bridge gaps between detections, detections without identity.

    Count decisions about the use of appearance and their causes, and keep the range of dispersions.
    """
    counts["identities"] = int(tracked.tracks.identity.max(initial=counts.get("identities", 0)))
    counts["bridges"] = counts.get("bridges", 0) + int((tracked.tracks.row < 0).sum())
    counts["untracked"] = counts.get("untracked", 0) + len(tracked.untracked)
    if (use := tracked.tracks.appearance) is not None:
        kept = counts.setdefault("appearance", {"decisions": 0, "looked_at": 0, "causes": {}})
        kept["decisions"] += 1
        kept["looked_at"] += use.looked
        cause = without_numbers(use.cause)
        kept["causes"][cause] = kept["causes"].get(cause, 0) + 1
        for name, value in asdict(use).items():
            if name.endswith("dispersion") and math.isfinite(value):
                low, high = kept.get(name, (value, value))
                kept[name] = [min(low, value), max(high, value)]


def _count_tracks(record: RunRecord, tracked: TrackedFrame) -> None:
    """Count a frame of a run with identities but without places."""
    counts, targets = record.counts, len(tracked.detections)
    counts.setdefault("first_frame", tracked.number)
    counts["last_frame"] = tracked.number
    _count_identities(counts, tracked)
    counts["tracked"] = record.targets + targets - counts["untracked"]
    record.note(tracked.number, targets, tracked.seconds, tracked.adjustments, tracked.cause or None)


class _LocationCounts:
    """Counts results of locating from the air in a record.

    positions: rows of positions.csv. unplaced: targets of located frames without a place. frames_without_position:
    frames that are not located, for example if a log covers only a part of a clip. by: frames by the source of the
    camera's pose, `nothing` for frames that are not located. weak: spans of frames that were located with a warning.
    repairs: changes and their reasons. landmarks: the number of frames in which each landmark was seen, used, and left
    out although the frame was located, and the spans of frames in which it was reassigned or excluded.
    """

    def __init__(self, record: RunRecord, names: Sequence[str]) -> None:
        """names: names of the landmarks."""
        self._record, self._names = record, tuple(names)
        self._weak, self._repairs = Spans(), Spans()
        record.counts |= {
            "positions": 0,
            "unplaced": 0,
            "frames_without_position": 0,
            "by": dict.fromkeys(("pose", "homography", "paper", "telemetry", "nothing"), 0),
            "landmarks": {n: {"seen": 0, "used": 0, "left_out": 0, "reassigned": [], "excluded": []} for n in names},
            "weak": self._weak.rows,
            "repairs": self._repairs.rows,
        }

    def add(self, located: AerialLocations) -> None:
        """Count a frame."""
        record, frame, fix = self._record, located.frame, located.fix
        counts, before = record.counts, record.last_frame
        counts["positions"] += len(located.positions)
        counts["unplaced"] += (len(located.box_px) - len(located.positions)) * bool(fix.by)
        counts["by"][fix.by or "nothing"] += 1
        counts["frames_without_position"] += not fix.by
        for which, state, is_used in zip(fix.landmark.tolist(), fix.state, fix.is_used, strict=True):
            landmark = counts["landmarks"][self._names[which]]
            landmark["seen"] += 1
            landmark["used"] += is_used
            landmark["left_out"] += bool(fix.by) and not is_used
            if state in ("reassigned", "excluded"):
                spans = landmark[state]
                if spans and spans[-1][1] == before:
                    spans[-1][1] = frame
                else:
                    spans.append([frame, frame])
        if fix.by and fix.cause:
            self._weak.add(frame, before, fix.cause, by=fix.by)
        for change in fix.changes:
            self._repairs.add(frame, before, change)
        cause = None if fix.by else fix.cause or NO_POSE
        record.note(frame, len(located.box_px), located.seconds, located.adjustments, cause)

    def note_unplaced(self) -> None:
        """Note targets without a place, and why nothing was located; call it at the end of the run."""
        record, counts = self._record, self._record.counts
        if unplaced := counts["unplaced"]:
            record.notes.append(
                f"{unplaced} boxes of located frames have no place: they lie above the horizon or off the known "
                "ground, or their distance is uncertain by more than a fifth, as near the horizon or from a low vehicle"
            )
        if counts["positions"] == 0:
            causes = Counter[str]()
            for span in record.unreliable.rows:
                causes[span["cause"]] += span["last"] - span["first"] + 1
            record.notes.append(describe_nothing_located(causes, unplaced))


def _missing_maps(site: MapSite, save: Sequence[str]) -> list[str]:
    """Notes on maps that are left out."""
    if site.origin_deg is None:
        return ["no longitude and latitude are known: positions are local metres, without maps for other tools"]
    if site.facts["start_utc"] is None and "cot" in save:
        return [f"no clock is known: {COT} is left out, and times are seconds since the first frame"]
    return []


def _locations(result: FrameResult) -> AerialLocations:
    assert result.locations is not None
    return result.locations


def _scene(result: FrameResult) -> Scene:
    """Return a scene with the parts that tables of detections need."""
    assert result.tracked.frame is not None
    return Scene(result.tracked.frame, np.zeros((0, 0), np.uint16), result.tracked.detections, 1)


def _grid(facts: Mapping[str, Any]) -> str:
    """Return the grid that the settings of a run name."""
    return str(facts.get("settings", {}).get("aerial", {}).get("grid", ""))
