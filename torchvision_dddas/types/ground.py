"""Cameras, poses, landmarks, and positions on the ground."""

from dataclasses import dataclass, field

import numpy as np

from torchvision_dddas.types.frames import Adjustment
from torchvision_dddas.types.record import Record
from torchvision_dddas.types.table import Table, complete_table


@dataclass(frozen=True)
class Camera(Record):
    """A camera above the ground, with standard deviations (sigma).

    size_px: (width, height). focal_px: along u and v. centre_px: u, v of the optical axis. k1, k2, k3: OpenCV's
    radial distortion; p1, p2: its tangential distortion. place: longitude and latitude in degrees if
    geographic, else local metres east and north.
    heading_rad: clockwise from true north. pitch_rad: below the horizon. roll_rad: clockwise, seen from behind.
    height_m: above ground, NaN if unknown. focal_sigma: relative. position_sigma_m: east and north each.
    elevation_m: height above the sea of the ground below a camera on it, NaN if unknown.
    takeoff_above_sea_m: height above the sea of the take-off point, NaN if unknown. given: the fields that are known;
    None: the fields that differ from their defaults.

    >>> camera = td.Camera("uav", (640, 480), (600.0, 600.0), (319.5, 239.5), pitch_rad=np.pi / 2)
    >>> camera.knows("pitch_rad"), camera.knows("height_m")
    (True, False)
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
    p1: float = 0.0
    p2: float = 0.0
    k3: float = 0.0
    focal_sigma: float = 0.01
    height_sigma_m: float = 0.05
    pitch_sigma_rad: float = float(np.radians(0.5))
    heading_sigma_rad: float = float(np.radians(2.0))
    position_sigma_m: float = 1.43
    takeoff_above_sea_m: float = float("nan")
    elevation_m: float = float("nan")
    given: frozenset[str] | None = None

    @property
    def distortion(self) -> tuple[float, float, float, float, float]:
        """The coefficients k1, k2, p1, p2, k3, in OpenCV's order; all are 0 for a lens without distortion."""
        return self.k1, self.k2, self.p1, self.p2, self.k3

    def knows(self, name: str) -> bool:
        """Return whether the value of a field is known rather than a default."""
        if self.given is not None:
            return name in self.given
        value, default = getattr(self, name), type(self).__dataclass_fields__[name].default
        if isinstance(value, float):  # a heading that was given as 0 is not the default object
            return value == value and value is not default
        return bool(value != default)


@dataclass(frozen=True)
class Poses(Table):
    """Poses of a camera, one row per picture or sighting: place (N, 2), heading_rad and pitch_rad (N,) as in Camera.

    >>> td.Poses(np.zeros((2, 2)), heading_rad=np.array([0.0, 0.1]), pitch_rad=np.zeros(2))
    Poses(2 rows, place: 0, heading_rad: 0 to 0.1, pitch_rad: 0)
    """

    place: np.ndarray
    heading_rad: np.ndarray
    pitch_rad: np.ndarray


@dataclass(frozen=True)
class PoseTable(Record):
    """A camera's poses from a CSV, sorted. at: (N,) frames, or seconds if timed.

    values: arrays (N,) by column: heading_deg, pitch_deg, longitude_deg and latitude_deg or east_m and north_m; the
    values of the camera's file replace missing columns.

    >>> poses = td.PoseTable("poses.csv", np.array([1, 2]), timed=False, values={"heading_deg": np.array([0.0, 5.0])})
    >>> poses.values["heading_deg"]
    array([0., 5.])
    """

    path: str
    at: np.ndarray
    timed: bool
    values: dict[str, np.ndarray]


@dataclass(frozen=True)
class Sightings(Table):
    """People seen by ground cameras, one row per person and picture, in local metres.

    east_north_m: (N, 2), NaN if the distance is unknown. distance_m: (N,) over the ground. bearing_rad: (N,) clockwise
    from north. by: (N,) source of the distance: both, height, feet, or bearing (none).
    The error has three parts: own_m2 (N, 2, 2), the covariance of independent errors; body_m (N, 2), the effect of one
    sigma of body height, common to all sightings of a person; camera_m (N, 2, 6), the effect of one sigma of the
    camera's east, north, heading, pitch, height and focal length, common to all sightings by a camera.

    >>> one, by, body, camera = np.ones(1), np.array(["both"]), np.zeros((1, 2)), np.zeros((1, 2, 6))
    >>> seen = td.Sightings(np.array([[3.0, 4]]), 5 * one, one, by, np.eye(2)[None], body, camera)
    >>> seen.covariance_m2
    array([[[1., 0.],
            [0., 1.]]])
    """

    east_north_m: np.ndarray
    distance_m: np.ndarray
    bearing_rad: np.ndarray
    by: np.ndarray
    own_m2: np.ndarray
    body_m: np.ndarray
    camera_m: np.ndarray

    @property
    def covariance_m2(self) -> np.ndarray:
        """The covariance of all errors together, (N, 2, 2)."""
        camera = self.camera_m @ self.camera_m.swapaxes(1, 2)
        return self.own_m2 + self.body_m[:, :, None] * self.body_m[:, None, :] + camera


@dataclass(frozen=True)
class Landmarks(Table):
    """Reports of landmarks (ground vehicles that report their position), one row per report, sorted by frame.

    frame: (N,) float64 from 1, fractional between two pictures. landmark: (N,) int64, index into names.
    image_px: (N, 2) u, v from the first pixel's centre, or NaN. place: (N, 2) longitude and latitude in degrees if
    geographic, else local metres east and north; NaN in a dropout. sigma_m: (N,) per axis, or NaN.
    planned: (N,) bool, a planned waypoint instead of a report. line: (N,) int64, the row's line in the file.
    elevation_m, above_ellipsoid_m: (N,) heights of the ground at the place, above the sea and above WGS 84, or NaN.

    >>> frame, number, line = np.array([1.0, 1]), np.array([0, 1]), np.array([2, 3])
    >>> place, unseen = np.array([[0.0, 0], [10, 0]]), np.full((2, 2), np.nan)
    >>> options = {"sigma_m": np.ones(2), "planned": np.zeros(2, bool), "geographic": False}
    >>> marks = td.Landmarks(("a", "b"), frame, number, unseen, place, line=line, **options)
    >>> marks[marks.landmark == 1].place
    array([[10.,  0.]])
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
    elevation_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    above_ellipsoid_m: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        complete_table(self, len(self.frame), elevation_m=np.nan, above_ellipsoid_m=np.nan)


@dataclass(frozen=True)
class LandmarkObservations(Table):
    """The landmarks of one frame, one row each; NaN if unseen or unknown.

    landmark: (n,) int64, index into the names. image_px: (n, 2). east_north_m: (n, 2) local metres.
    sigma_m, pixel_sigma: (n,) standard deviations per axis. up_m: (n,) height of the seen point above the local plane.

    >>> seen = td.LandmarkObservations(np.array([2]), np.array([[320.0, 240]]), np.array([[3.0, 4]]))
    >>> len(seen), seen.image_px
    (1, array([[320., 240.]]))
    """

    landmark: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int64))
    image_px: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    east_north_m: np.ndarray = field(default_factory=lambda: np.zeros((0, 2)))
    sigma_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    pixel_sigma: np.ndarray = field(default_factory=lambda: np.zeros(0))
    up_m: np.ndarray = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Colours(Record):
    """Colours of the landmarks: inclusive ranges of hue, saturation and value.

    low, high: (K, 3) int64, hue 0 to 180, others 0 to 255 as in OpenCV; if the low hue exceeds the high one, the range
    wraps around 0.

    >>> low, high = np.array([[170, 80, 80], [100, 80, 80]]), np.array([[10, 255, 255], [130, 255, 255]])
    >>> td.Colours(("red", "blue"), low, high)
    Colours(2 rows, names=('red', 'blue'), low: 80 to 170, high: 10 to 255)
    """

    names: tuple[str, ...]
    low: np.ndarray
    high: np.ndarray

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True)
class CameraPose(Record):
    """Position and orientation of a camera.

    place_m: (3,) east, north, up in local metres. axes: (3, 3), columns right, down and forward of the camera in east,
    north, up. focal: focal length relative to the Camera's.

    >>> east = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    >>> heading, pitch, roll = td.CameraPose(np.array([0.0, 0.0, 50.0]), east).angles_rad
    >>> float(np.degrees(heading))
    90.0
    """

    place_m: np.ndarray
    axes: np.ndarray
    focal: float = 1.0

    @property
    def angles_rad(self) -> tuple[float, float, float]:
        """Heading in [0, 2 pi), pitch and roll as in Camera. If the camera looks straight up or down, the roll is 0."""
        right, down, forward = np.asarray(self.axes, float).T
        level = float(np.hypot(forward[0], forward[1]))
        pitch = float(np.arctan2(-forward[2], level))
        if level < 1e-9:
            upper = -down if forward[2] < 0 else down
            return float(np.mod(np.arctan2(upper[0], upper[1]), 2 * np.pi)), pitch, 0.0
        heading = float(np.mod(np.arctan2(forward[0], forward[1]), 2 * np.pi))
        return heading, pitch, float(np.arctan2(-right[2], -down[2]))


@dataclass(frozen=True)
class Fix(Record):
    """The georeference of one frame, with its uncertainty.

    time_s: capture time since the clip's first frame; NaN: the time that follows from the frame's number.
    by: its source: pose, homography, paper, telemetry (no usable landmark), or "" (none: see cause).
    pose, covariance (7, 7): rotation about east, north, up in rad; east, north, up in m; log of the focal length.
    image_from_ground: (3, 3) from local metres to undistorted pixels (paper: distorted), if there is no pose.
    matrix_covariance: (8, 8) of its first eight elements (h33 = 1) in metres from about_m, the landmarks' centre, for
    numerical precision. landmark: (n,) the landmarks that were seen. state: used, reassigned or excluded, for each.
    chi2, freedom: consistency of the landmarks with the prediction; NaN and 0 without one.
    changes: repairs and exclusions, with their reasons. cause: why there is no result, or only a weak one.

    >>> td.Fix(5, "", cause="no landmark is seen")
    Fix(frame=5, cause='no landmark is seen')
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
        """Whether each landmark that was seen was also used."""
        return tuple(state in ("used", "reassigned") for state in self.state)


@dataclass(frozen=True)
class Elevation(Record):
    """Terrain heights on a grid in local metres.

    up_m: (R, C) above the local plane, rows to the north, columns to the east; NaN if unknown. corner_m: east and north
    of the first cell. step_m: cell size. base_m: the raster's height where up is 0.

    >>> td.Elevation(np.zeros((3, 4)), corner_m=(-50.0, -50.0), step_m=25.0, base_m=210.0)
    Elevation(up_m: 3x4 0, corner_m=(-50.0, -50.0), step_m=25, base_m=210)
    """

    up_m: np.ndarray
    corner_m: tuple[float, float]
    step_m: float
    base_m: float = 0.0


@dataclass(frozen=True)
class Positions(Table):
    """Positions of targets on the ground, one row per sighting, sorted by frame.

    frame: (N,) int64 from 1. target: (N,) int64, the identity, else the row within the frame, from 1.
    east_north_m: (N, 2) local metres. covariance_m2: (N, 2, 2), NaN if unknown. score: (N,) in [0, 1].
    origin_deg: WGS84 longitude and latitude of east = north = 0. lonlat_deg: (N, 2). Both None without an origin.
    label, class_id: (N,) as in Detections. above_sea_m, above_ellipsoid_m: (N,) of the ground, NaN if unknown.

    >>> east_north_m, covariance_m2 = np.array([[3.0, 4], [0, 2]]), np.tile(np.eye(2), (2, 1, 1))
    >>> places = td.Positions(np.array([1, 1]), np.array([7, 9]), east_north_m, covariance_m2, np.ones(2))
    >>> list(places.to_columns())[:4]
    ['frame', 'target', 'east_m', 'north_m']
    >>> places[places.target == 9].east_north_m
    array([[0., 2.]])
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
    above_sea_m: np.ndarray = field(default_factory=lambda: np.zeros(0))
    above_ellipsoid_m: np.ndarray = field(default_factory=lambda: np.zeros(0))

    def __post_init__(self) -> None:
        unknown = {"label": "", "class_id": -1, "above_sea_m": np.nan, "above_ellipsoid_m": np.nan}
        complete_table(self, len(self.frame), **unknown)


@dataclass(frozen=True)
class Ortho(Record):
    """An orthophoto: image (H, W, 3) uint8 BGR; east_north_from_pixel (2, 3), local metres of (u, v, 1).

    >>> td.Ortho(np.zeros((200, 300, 3), np.uint8), np.array([[0.1, 0, -15], [0, -0.1, 10]]))
    Ortho(image: 200x300x3 0, east_north_from_pixel: 2x3 -15 to 10)
    """

    image: np.ndarray
    east_north_from_pixel: np.ndarray


@dataclass(frozen=True)
class GroundLocations(Record):
    """The people of one frame located from ground cameras.

    positions: fused over cameras. members: (P, V) index of each camera's sighting among the located sightings; -1:
    none. sightings: all sightings, one row per box; vehicle (N,), from 0, is the camera; target, cut, score (N,) and
    box_px (N, 4) come from its table.

    >>> camera = td.Camera("ugv1", (640, 480), (500.0, 500.0), (319.5, 239.5), height_m=1.2)
    >>> people = td.People(np.array([[310.0, 220, 20, 80]]), np.ones(1), np.ones(1), np.array([False]))
    >>> located = td.GroundLocator(camera).locate(people)
    >>> len(located.positions), located.members
    (1, array([[0]]))
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
class AerialLocations(Record):
    """The targets of one frame located from the air.

    positions: located targets, with absolute covariance. row: (P,) row of each position among the frame's targets.
    relative_m2: (P, 2, 2) covariance relative to the landmarks, without the error common to their receivers.
    velocity_m_s: (P, 2) east, north, NaN if unknown. box_px: (N, 4) of all targets. marks: the landmarks as used.
    adjustments, seconds: as in Scene. velocity_covariance: (P, 2, 2) of velocity_m_s in m²/s², or empty if unknown.

    >>> camera = td.Camera("uav", (640, 480), (600.0, 600.0), (319.5, 239.5))
    >>> none = np.zeros(2)
    >>> log = td.Telemetry([0.0, 1.0], [50.0, 50.0], none, np.zeros((2, 2)), False, none, none, none + np.pi / 2, none)
    >>> tracks = td.Tracks(1, np.array([7]), np.array([[370.0, 230, 20, 20]]), np.ones(1), np.zeros(1, int))
    >>> located = td.AerialLocator(camera, log).locate(tracks)
    >>> located.positions.target, located.positions.east_north_m.round()
    (array([7]), array([[5., 0.]]))
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
    velocity_covariance: np.ndarray = field(default_factory=lambda: np.zeros((0, 2, 2)))


@dataclass(frozen=True)
class FusedTargets(Table):
    """The targets that several platforms know together at one moment, one row per target.

    time_s: time by the common clock. frame: of the record that platform `by` measured then. target: (N,) int64.
    state: (N, 4) east, north in local metres about origin_deg, and their velocities in m/s. covariance: (N, 4, 4).
    seen_by: (N,) dict, the platforms that saw the target within a second, each with its own number of the target.
    classes: names, "" for unknown. probability: (N, C) of each class.

    >>> state, covariance = np.array([[10.0, 5, 3, 4]]), np.eye(4)[None]
    >>> targets = td.FusedTargets(12.0, 120, "uav", np.array([1]), state, covariance, np.array([{"uav": 7}]))
    >>> targets.speed_m_s
    (array([5.]), array([1.]))
    """

    time_s: float
    frame: int
    by: str
    target: np.ndarray
    state: np.ndarray
    covariance: np.ndarray
    seen_by: np.ndarray
    classes: tuple[str, ...] = ("",)
    probability: np.ndarray = field(default_factory=lambda: np.zeros((0, 1)))
    origin_deg: tuple[float, float] | None = None

    @property
    def speed_m_s(self) -> tuple[np.ndarray, np.ndarray]:
        """Speeds over the ground and their standard deviations, (N,) each, to first order."""
        velocity, spread = self.state[:, 2:], self.covariance[:, 2:, 2:]
        speed = np.hypot(*velocity.T)
        along = np.where(speed[:, None] > 0, velocity / np.maximum(speed, 1e-9)[:, None], (1.0, 0.0))
        return speed, np.sqrt(np.einsum("ni,nij,nj->n", along, spread, along))


@dataclass(frozen=True)
class Confirmation(Record):
    """The UGVs' verdict on the blobs of one frame, one row per blob.

    row: (N,) int64 in the blobs' table. kind: human, not_human or unseen, by all observations so far.
    probability: (N,) of being human. seen_by: vehicles with an observation in this frame. people: (N,) int64, largest
    number of people that a vehicle recognized at the blob in this frame. nearest_m, nearest_sigmas: (N,) distance to
    the nearest person, or NaN. best: (N,) highest probability of a person at the blob, or NaN.

    >>> one = np.ones(1)
    >>> seen = td.Confirmation(3, np.array([0]), ("human",), 0.97 * one, (("ugv1",),), np.array([2]), one, one, one)
    >>> seen.kind, seen.probability
    (('human',), array([0.97]))
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
    """The crowds of one frame as ground vehicles see them, one row per crowd that was looked at.

    target: (N,) int64 as in Positions. east_north_m: (N, 2) the people's centroid, local metres. velocity_m_s: (N, 2)
    east, north, NaN if unknown. people: (N,) int64, largest number of people in one picture. seen_by: (N,) str, the
    vehicles, separated by semicolons. steers: (N,) bool, whether it steers, because the air has lost the crowd.

    >>> crowds = td.GroundCrowds(np.array([4]), np.array([[10.0, 20]]), np.array([[1.0, 0]]), people=np.array([6]))
    >>> crowds.people, crowds.steers
    (array([6]), array([False]))
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
