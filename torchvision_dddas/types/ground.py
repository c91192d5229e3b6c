"""Cameras, poses, landmarks, and places on the ground."""

from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.types.frames import Adjustment
from torchvision_dddas.types.table import Table, complete_table


@dataclass(frozen=True)
class Camera:
    """A camera above the ground, with standard deviations (sigma).

    size_px: (width, height). focal_px: along u and v. centre_px: u, v of the optical axis. k1, k2: OpenCV's radial
    distortion. place: longitude and latitude in degrees if geographic, else local metres east and north.
    heading_rad: clockwise from true north. pitch_rad: below the horizon. roll_rad: clockwise, seen from behind.
    height_m: above ground, NaN if unknown. focal_sigma: relative. position_sigma_m: east and north each.
    takeoff_above_sea_m: where the aerial vehicle took off, NaN if unknown. given: the fields that are known; None:
    those that differ from their defaults.
    """

    name: str
    size_px: tuple[int, int]
    focal_px: tuple[float, float]
    centre_px: tuple[float, float]
    place: tuple[float, float] = (0.0, 0.0)
    geographic: bool = False
    heading_rad: float = 0.0
    pitch_rad: float = 0.0
    roll_rad: float = 0.0
    height_m: float = float("nan")
    k1: float = 0.0
    k2: float = 0.0
    focal_sigma: float = 0.01
    height_sigma_m: float = 0.05
    pitch_sigma_rad: float = float(np.radians(0.5))
    heading_sigma_rad: float = float(np.radians(2.0))
    position_sigma_m: float = 1.43
    takeoff_above_sea_m: float = float("nan")
    given: frozenset[str] | None = None

    def knows(self, name: str) -> bool:
        """Whether the value of a field is known, and no default."""
        if self.given is not None:
            return name in self.given
        value, default = getattr(self, name), type(self).__dataclass_fields__[name].default
        if isinstance(value, float):  # a heading of 0 that was given is another object than the default
            return value == value and value is not default
        return bool(value != default)


@dataclass(frozen=True)
class Poses(Table):
    """Poses of a camera, one row per picture or sighting: place (N, 2), heading_rad and pitch_rad (N,) as in Camera."""

    place: np.ndarray
    heading_rad: np.ndarray
    pitch_rad: np.ndarray


@dataclass(frozen=True)
class PoseTable:
    """A camera's poses from a CSV, sorted. at: (N,) frames, or seconds if timed.

    values: arrays (N,) by column: heading_deg, pitch_deg, longitude_deg and latitude_deg or east_m and north_m; the
    camera file's values hold for columns that are not there.
    """

    path: str
    at: np.ndarray
    timed: bool
    values: dict[str, np.ndarray]


@dataclass(frozen=True)
class Sightings(Table):
    """People seen by ground cameras, one row per person and picture, in local metres.

    east_north_m: (N, 2), NaN if the distance is unknown. distance_m: (N,) over ground. bearing_rad: (N,) clockwise
    from north. by: (N,) source of the distance: both, height, feet, or bearing (none).
    The error has three parts: own_m2 (N, 2, 2), the covariance of independent errors; body_m (N, 2), the effect of one
    sigma of body height, common to all sightings of a person; camera_m (N, 2, 6), the effect of one sigma of the
    camera's east, north, heading, pitch, height and focal length, common to all sightings by a camera.
    """

    east_north_m: np.ndarray
    distance_m: np.ndarray
    bearing_rad: np.ndarray
    by: np.ndarray
    own_m2: np.ndarray
    body_m: np.ndarray
    camera_m: np.ndarray

    def __len__(self) -> int:
        return len(self.distance_m)

    @property
    def covariance_m2(self) -> np.ndarray:
        """(N, 2, 2) of all errors together."""
        camera = self.camera_m @ self.camera_m.swapaxes(1, 2)
        return self.own_m2 + self.body_m[:, :, None] * self.body_m[:, None, :] + camera


@dataclass(frozen=True)
class Landmarks(Table):
    """Reports of landmarks (ground vehicles that report their position), one row per report, sorted by frame.

    frame: (N,) float64 from 1, fractional between two pictures. landmark: (N,) int64, index into names.
    image_px: (N, 2) u, v from the first pixel's centre, or NaN. place: (N, 2) longitude and latitude in degrees if
    geographic, else local metres east and north; NaN in a dropout. sigma_m: (N,) per axis, or NaN.
    planned: (N,) bool, a planned waypoint instead of a report. line: (N,) int64, in the file.
    """

    names: tuple[str, ...]
    frame: np.ndarray
    landmark: np.ndarray
    image_px: np.ndarray
    place: np.ndarray
    sigma_m: np.ndarray
    planned: np.ndarray
    line: np.ndarray
    geographic: bool = True
    path: str = ""

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class LandmarkObservations(Table):
    """The landmarks of one frame, one row each; NaN where unseen or unknown.

    landmark: (n,) int64, index into the names. image_px: (n, 2). east_north_m: (n, 2) local metres.
    sigma_m, pixel_sigma: (n,) standard deviations per axis. up_m: (n,) height of the seen point above the local plane.
    """

    landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    image_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    sigma_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    pixel_sigma: np.ndarray = field(default_factory=lambda: np.zeros(0))
    up_m: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __len__(self) -> int:
        return len(self.landmark)


@dataclass(frozen=True)
class Colours:
    """Colours of the landmarks: inclusive ranges of hue, saturation and value.

    low, high: (K, 3) int64, hue 0 to 180, others 0 to 255 as in OpenCV; if the low hue exceeds the high one, the range
    wraps around 0.
    """

    names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class CameraPose:
    """Position and orientation of a camera.

    place_m: (3,) east, north, up in local metres. axes: (3, 3), columns right, down and forward of the camera in east,
    north, up. focal: focal length relative to the Camera's.
    """

    place_m: np.ndarray
    axes: np.ndarray
    focal: float = 1.0

    @property
    def angles_rad(self) -> tuple[float, float, float]:
        """Heading in [0, 2 pi), pitch and roll as in Camera; straight up or down the roll is 0."""
        right, down, forward = np.asarray(self.axes, float).T
        level = float(np.hypot(forward[0], forward[1]))
        pitch = float(np.arctan2(-forward[2], level))
        if level < 1e-9:
            upper = -down if forward[2] < 0 else down
            return float(np.mod(np.arctan2(upper[0], upper[1]), 2 * np.pi)), pitch, 0.0
        heading = float(np.mod(np.arctan2(forward[0], forward[1]), 2 * np.pi))
        return heading, pitch, float(np.arctan2(-right[2], -down[2]))


@dataclass(frozen=True)
class Fix:
    """The georeference of one frame, with its uncertainty.

    time_s: since the clip's first frame, of the moment that the picture shows; NaN: that of the frame's number.
    by: its source: pose, homography, paper, telemetry (no usable landmark), or "" (none: see cause).
    pose, covariance (7, 7): rotation about east, north, up in rad; east, north, up in m; log of the focal length.
    image_from_ground: (3, 3) from local metres to undistorted pixels (paper: distorted), if there is no pose.
    matrix_covariance: (8, 8) of its first eight elements (h33 = 1) in metres from about_m, the landmarks' centre, for
    numerical precision. landmark: (n,) those seen; state of each: used, reassigned or excluded.
    chi2, freedom: consistency of the landmarks with the prediction; NaN and 0 without one.
    changes: what was repaired or excluded, and why. cause: why there is no or only a weak result.
    """

    frame: int
    by: str
    pose: CameraPose | None = None
    covariance: np.ndarray | None = None
    image_from_ground: np.ndarray | None = None
    matrix_covariance: np.ndarray | None = None
    about_m: tuple[float, float] = (0.0, 0.0)
    landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    state: tuple[str, ...] = ()
    chi2: float = float("nan")
    freedom: int = 0
    changes: tuple[str, ...] = ()
    cause: str = ""
    time_s: float = float("nan")

    @property
    def is_used(self) -> tuple[bool, ...]:
        """Whether each landmark seen was used."""
        return tuple(state in ("used", "reassigned") for state in self.state)


@dataclass(frozen=True)
class Elevation:
    """Terrain heights on a grid in local metres.

    up_m: (R, C) above the local plane, rows to the north, columns to the east; NaN where unknown. corner_m: east and
    north of the first cell. step_m: cell size. base_m: the raster's height where up is 0.
    """

    up_m: np.ndarray
    corner_m: tuple[float, float]
    step_m: float
    base_m: float = 0.0


@dataclass(frozen=True)
class Positions(Table):
    """Positions of targets on the ground, one row per sighting, sorted by frame.

    frame: (N,) int64 from 1. target: (N,) int64, the identity, else the row within the frame, from 1.
    east_north_m: (N, 2) local metres. covariance_m2: (N, 2, 2), NaN where unknown. score: (N,) in [0, 1].
    origin_deg: WGS84 longitude and latitude of east = north = 0. lonlat_deg: (N, 2). Both None without an origin.
    label, class_id: (N,) as in Detections.
    """

    frame: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    target: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    covariance_m2: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 2)))
    score: np.ndarray = field(default_factory=lambda: np.zeros(0))
    origin_deg: tuple[float, float] | None = None
    lonlat_deg: np.ndarray | None = None
    label: np.ndarray = field(default_factory=lambda: np.zeros(0, object))
    class_id: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))

    def __post_init__(self) -> None:
        complete_table(self, len(self.frame), label="", class_id=-1)

    def __len__(self) -> int:
        return len(self.frame)


@dataclass(frozen=True)
class Ortho:
    """An orthophoto: image (H, W, 3) uint8 BGR; east_north_from_pixel (2, 3), local metres of (u, v, 1)."""

    image: np.ndarray
    east_north_from_pixel: np.ndarray


@dataclass(frozen=True)
class GroundLocations:
    """The people of one frame located from ground cameras.

    positions: fused over cameras. members: (P, V) index of each camera's sighting among those located; -1: none.
    sightings: all, one row per box; vehicle (N,), from 0, is the camera; target, cut, score (N,) and box_px (N, 4) come
    from its table.
    """

    frame: int
    positions: Positions
    members: np.ndarray
    sightings: Sightings
    vehicle: np.ndarray
    target: np.ndarray
    cut: np.ndarray
    score: np.ndarray
    box_px: np.ndarray


@dataclass(frozen=True)
class AerialLocations:
    """The targets of one frame located from the air.

    positions: located targets, with absolute covariance. row: (P,) their rows among the frame's targets.
    relative_m2: (P, 2, 2) covariance relative to the landmarks, without the error common to their receivers.
    velocity_m_s: (P, 2) east, north, NaN if unknown. box_px: (N, 4) of all targets. marks: the landmarks as used.
    adjustments, seconds: as in Scene.
    """

    frame: int
    time_s: float
    positions: Positions
    row: np.ndarray
    relative_m2: np.ndarray
    velocity_m_s: np.ndarray
    box_px: np.ndarray
    fix: Fix
    marks: LandmarkObservations
    adjustments: tuple[Adjustment, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Confirmation:
    """The UGVs' verdict on the blobs of one frame, one row per blob.

    row: (N,) int64 in the blobs' table. kind: human, not_human or unseen, by all observations so far.
    probability: (N,) of being human. seen_by: vehicles with an observation in this frame. people: (N,) int64, the most
    people that a vehicle recognized at it in this frame. nearest_m, nearest_sigmas: (N,) to the nearest person, or NaN.
    best: (N,) highest probability of a person at it, or NaN.
    """

    frame: int
    row: np.ndarray
    kind: tuple[str, ...]
    probability: np.ndarray
    seen_by: tuple[tuple[str, ...], ...]
    people: np.ndarray
    nearest_m: np.ndarray
    nearest_sigmas: np.ndarray
    best: np.ndarray


@dataclass(frozen=True)
class GroundCrowds(Table):
    """The crowds of one frame by the people that ground vehicles see, one row a crowd that was looked at.

    target: (N,) int64 as in Positions. east_north_m: (N, 2) the people's centroid, local metres. velocity_m_s: (N, 2)
    east, north, NaN if unknown. people: (N,) int64, the most that one picture shows. seen_by: (N,) str, the vehicles,
    separated by semicolons. steers: (N,) bool, the air has lost the crowd, so that this steers.
    """

    target: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    velocity_m_s: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    people: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    seen_by: np.ndarray = field(default_factory=lambda: np.zeros(0, object))
    steers: np.ndarray = field(default_factory=lambda: np.zeros(0, bool))

    def __post_init__(self) -> None:
        if len(self.steers) == 0 < len(self.target):
            object.__setattr__(self, "steers", np.zeros(len(self.target), bool))

    def __len__(self) -> int:
        return len(self.target)
