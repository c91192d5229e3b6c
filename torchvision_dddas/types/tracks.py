"""Tracks, and the results for a frame."""

import math
from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.types.detections import Detections
from torchvision_dddas.types.frames import Adjustment, Frame
from torchvision_dddas.types.ground import AerialLocations, Confirmation, FusedTargets, GroundCrowds
from torchvision_dddas.types.record import Record
from torchvision_dddas.types.table import Boxes, complete_table
from torchvision_dddas.types.worlds import Command
from torchvision_dddas.types.zones import ZoneEvent


@dataclass(frozen=True)
class AppearanceUse(Record):
    """Whether the association of a frame used the appearance of targets, and the reason.

    weight: of the locations in the source's association; NaN in the default association, which adds appearance to
    scores. location_dispersion, appearance_dispersion: dispersions of the source's rule, in [0, 1]; NaN if not
    computed.

    >>> td.AppearanceUse(looked=True, cause="two boxes overlap")
    AppearanceUse(looked=True, cause='two boxes overlap')
    """

    looked: bool
    cause: str
    weight: float = float("nan")
    location_dispersion: float = float("nan")
    appearance_dispersion: float = float("nan")


@dataclass(frozen=True)
class Tracks(Boxes):
    """The targets of one frame with identities, one row per target.

    identity: (N,) int64 from 1, unique within a run. box_px, score: as in Detections. row: (N,) int64, the row in the
    frame's detections; -1 for a box that bridges a gap. link: (N,) in [0, 1], confidence that the box belongs to its
    identity, and not to another identity that could have taken it. NaN for the first box of a track, for a bridging
    box, and if unknown. label, class_id: of the detection; a bridging box keeps its identity's earlier class.
    frame: number of the frame; (N,) in a table that `concat` has joined. appearance: whether it was used; None if there
    was no choice: nothing to link, or no picture. provisional: whether later frames may change the tracks, as those of
    `Tracker(lag=0)` at once. corrects: the identities of the provisional tracks of this frame that are gone, or belong
    to another box.

    >>> box_px = np.array([[10.0, 20, 5, 9], [40, 20, 5, 9]])
    >>> tracks = td.Tracks(3, np.array([7, 9]), box_px, np.ones(2), np.array([0, 1]))
    >>> tracks[tracks.id == 9].xyxy
    array([[40., 20., 45., 29.]])
    >>> td.Tracks.concat([tracks, tracks[:1]]).id
    array([7, 9, 7])
    """

    frame: int
    identity: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    box_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 4)))
    score: np.ndarray = field(default_factory=lambda: np.zeros(0))
    row: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    link: np.ndarray = field(default_factory=lambda: np.zeros(0))
    appearance: AppearanceUse | None = None
    label: np.ndarray = field(default_factory=lambda: np.zeros(0, object))
    class_id: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    provisional: bool = False
    corrects: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        complete_table(self, len(self.identity), link=np.nan, label="", class_id=-1)

    @property
    def id(self) -> np.ndarray:
        """(N,) the identities."""
        return self.identity


@dataclass(frozen=True)
class TrackedFrame(Record):
    """The result of tracking for one frame.

    number: 1-based position in the clip. frame: the picture, or None. detections: the tracker's input.
    tracks: detections with an identity, and boxes that bridge gaps.
    now_from_before: (3, 3) pixel homography from the previous tracked frame; None: no motion, or unknown.
    lines: (N,) int64, lines of the detections in their file; empty for own detections.
    cause: why there is no result. adjustments, seconds, repeats: as in Scene.

    >>> found = td.Detections([[10, 20, 5, 9], [40, 20, 5, 9]], [0.9, 0.8])
    >>> tracks = td.Tracks(3, np.array([7]), found.box_px[:1], found.score[:1], np.array([0]))
    >>> td.TrackedFrame(3, None, found, tracks).untracked
    [1]
    """

    number: int
    frame: Frame | None
    detections: Detections
    tracks: Tracks
    now_from_before: np.ndarray | None = None
    lines: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    cause: str = ""
    adjustments: tuple[Adjustment, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)
    repeats: int = 0

    @property
    def untracked(self) -> list[int]:
        """The rows of the detections that have no identity."""
        tracked = set(self.tracks.row.tolist())
        return [row for row in range(len(self.detections)) if row not in tracked]


@dataclass(frozen=True)
class FrameResult(Record):
    """The result of the whole pipeline for one frame.

    tracked: the frame's targets, without the landmarks. locations: their positions on the ground; None if nothing
    locates them. sighted_by: (n,) how each landmark of locations.marks was seen: motion, colour or table.
    mark_lonlat_deg: (n, 2) positions of the landmarks; None without a geographic origin.
    confirmed: the UGVs' verdict on each row of locations.positions; None without UGV cameras.
    crowds: the crowds as the UGVs see them; None without UGV cameras.
    command: the order to the vehicles after this frame; None: no change.
    events: events of targets at zones that are certain by this frame.
    fused: the targets by the data of all platforms at this frame; None without ground platforms.

    >>> tracks = td.Tracks(3, np.array([7]), np.array([[10.0, 20, 5, 9]]), np.ones(1), np.zeros(1, int))
    >>> result = td.FrameResult(td.TrackedFrame(3, None, td.Detections(), tracks))
    >>> result.number, result.tracks.id
    (3, array([7]))
    """

    tracked: TrackedFrame
    locations: AerialLocations | None = None
    sighted_by: tuple[str, ...] = ()
    mark_lonlat_deg: np.ndarray | None = None
    confirmed: Confirmation | None = None
    command: "Command | None" = None
    crowds: GroundCrowds | None = None
    events: tuple[ZoneEvent, ...] = ()
    fused: FusedTargets | None = None

    @property
    def frame(self) -> Frame | None:
        """The frame; None if it could not be read."""
        return self.tracked.frame

    @property
    def number(self) -> int:
        """1-based number of the frame."""
        return self.tracked.number

    @property
    def time_s(self) -> float:
        """The time of the frame by the telemetry's clock if it was located, else by the clip's; NaN if unknown."""
        if self.locations is not None:
            return self.locations.time_s
        return math.nan if self.frame is None else self.frame.time_s

    @property
    def repeats(self) -> int:
        """The earlier frame that this frame repeats, as in Scene."""
        return self.tracked.repeats

    @property
    def tracks(self) -> Tracks:
        """The targets of the frame with their identities."""
        return self.tracked.tracks

    @property
    def adjustments(self) -> tuple[Adjustment, ...]:
        """The changes of parameters at the frame, with their reasons."""
        return self.tracked.adjustments if self.locations is None else self.locations.adjustments
