"""Where the camera is: the likeliest pose, given telemetry and landmarks, all with their errors.

Unknown are a small rotation about east, north and up (so that straight down is a view like any other), the place, the
log of the focal length, and the places of the landmarks themselves: their receivers err too, and a landmark then
weighs as much as it is known. What is expected of all of them comes as an information matrix, which may know nothing
of some. Levenberg and Marquardt's steps find the least sum of squares; its inverse curvature is the covariance.
"""

from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.geo.projection import axes_of, normalize, project_with_slopes, rays
from torchvision_dddas.geometry import about_up, slope_of_turn, turn_of, turned
from torchvision_dddas.types import Bool, Camera, CameraPose, Flight, Float, LandmarkObservations

# The element of a pose that turns the heading.
HEADING = 2
# Least standard deviation of a landmark's place: below, the curvature could not be inverted.
EXACT_M = 1e-3

STEPS = 30
# Squared length of the last step, in standard deviations.
ENOUGH = 1e-5


# A step that reduces the sum of squares by a smaller share is the last, too.
NO_BETTER = 1e-5
# Steps of the places alone after each of all, where the telemetry does not hold the pose: pixels are so much finer
# than places that the sum of squares lies in a bent valley, and straight steps along it would be short.
SETTLING = 1


@dataclass(frozen=True)
class Prior:
    """What is expected of a pose before any landmark is seen.

    information: (7, 7), in the order of Fix, inverse of its covariance; a row of zeros where nothing is known.
    """

    pose: CameraPose
    information: np.ndarray

    @property
    def known(self) -> Bool[np.ndarray, "7"]:
        """Which of the seven have a prior."""
        return np.diag(self.information) > 0


@dataclass(frozen=True)
class Expected:
    """What is expected of a pose and of n landmarks before they are seen in a picture.

    reference: what telemetry says. mean: (7 + 2n,) what to add to it and to the landmarks' reports.
    information: (7 + 2n, 7 + 2n) of those sums. known: (7,) of which of the pose something is known.
    """

    reference: CameraPose
    mean: np.ndarray
    information: np.ndarray
    known: np.ndarray


@dataclass(frozen=True)
class Solution:
    """The most likely pose. places: (n, 2) of the landmarks. covariance: (7 + 2n, 7 + 2n) of pose and places.

    correction: (7 + 2n,) what was added to what telemetry and the landmarks report, with correction_covariance.
    cost: the least sum of squares, in standard deviations; chi-square of `freedom` degrees where all is as expected.
    """

    pose: CameraPose
    places: np.ndarray
    covariance: np.ndarray
    correction: np.ndarray
    correction_covariance: np.ndarray
    cost: float
    freedom: int


def pose_prior(
    flight: Flight | None,
    camera: Camera,
    parameters: AerialParameters,
    ground_up_m: float = 0.0,
    focal_known: bool = True,
) -> Prior | None:
    """The prior of the pose by telemetry; None without place, height and angles.

    flight: its place in local metres. ground_up_m: height of the ground below, that the altitude is measured from.
    focal_known: the camera's focal length is given, not guessed from a field of view.
    """
    if flight is None:
        return None
    place = np.array([*flight.place, flight.altitude_m + ground_up_m], float)
    angles = np.array([flight.heading_rad, flight.pitch_rad, flight.roll_rad], float)
    if not (np.isfinite(place).any() or np.isfinite(angles).any()):
        return None
    sigma = np.full(7, np.inf)
    # Without a pitch the tilt is no more than a guess.
    tilt = parameters.tilt_sigma_deg if np.isfinite(angles[1]) else parameters.tilt_guess_sigma_deg
    sigma[:2] = np.radians(tilt)
    sigma[2] = np.radians(parameters.heading_sigma_deg) if np.isfinite(angles[0]) else np.inf
    sigma[3:5] = np.where(np.isfinite(place[:2]), parameters.position_sigma_m, np.inf)
    if np.isfinite(place[2]):
        sigma[5] = np.hypot(parameters.altitude_sigma * flight.altitude_m, parameters.altitude_sigma_m)
    focal, sigma[6] = _focal_of(flight.hfov_rad, camera, parameters, focal_known)
    angles = np.where(np.isfinite(angles), angles, [0.0, np.radians(parameters.pitch_deg), 0.0])
    pose = CameraPose(np.where(np.isfinite(place), place, 0.0), axes_of(*angles), focal)
    return Prior(pose, np.diag(1 / np.maximum(sigma, 1e-6) ** 2))


def focal_prior(camera: Camera, parameters: AerialParameters, focal_known: bool = True) -> Prior:
    """The prior without telemetry: the focal length alone."""
    focal, sigma = _focal_of(float("nan"), camera, parameters, focal_known)
    pose = CameraPose(np.zeros(3), axes_of(0.0, np.radians(parameters.pitch_deg), 0.0), focal)
    return Prior(pose, np.diag([0.0] * 6 + [1 / max(sigma, 1e-6) ** 2]))


def independent_expectation(prior: Prior, sigma_m: Float[np.ndarray, "n"]) -> Expected:
    """The expectation of a single picture: pose and landmarks are independent."""
    n = len(sigma_m)
    information = np.zeros((7 + 2 * n, 7 + 2 * n))
    information[:7, :7] = prior.information
    diagonal = np.arange(7, 7 + 2 * n)
    information[diagonal, diagonal] = 1 / np.maximum(np.repeat(sigma_m, 2), EXACT_M) ** 2
    return Expected(prior.pose, np.zeros(7 + 2 * n), information, prior.known)


def fit_pose(
    marks: LandmarkObservations,
    camera: Camera,
    expected: Expected,
    start: CameraPose | None = None,
    used: Bool[np.ndarray, "n"] | None = None,
) -> Solution | None:
    """The likeliest pose and landmarks' places; None where the start has a landmark that the camera cannot show.

    marks: none may lack its pixel or its place. start: where to begin; the expected pose without one. used: the
    landmarks whose pixels count; all without it.
    """
    n = len(marks)
    problem = _Problem(marks, camera, expected, np.ones(n, bool) if used is None else used)
    if start is None:
        start = move_pose(expected.reference, expected.mean[:7])
    state = problem.at(start, marks.east_north_m + expected.mean[7:].reshape(n, 2))
    if state is None:
        return None
    damping = 1e-6
    for _ in range(STEPS):
        curvature, downhill = state.curvature, state.downhill
        steeper = curvature.copy()
        steeper[np.diag_indices(len(steeper))] *= 1 + damping
        try:
            step = np.linalg.solve(steeper, downhill)
        except np.linalg.LinAlgError:
            damping = max(10 * damping, 1e-6)
            continue
        gain = float(step @ downhill)
        tried = problem.at(move_pose(state.pose, step[:7]), state.places + step[7:].reshape(n, 2))
        for _ in range(0 if expected.known.all() else SETTLING):
            tried = problem.settled(tried)
        if tried is not None and tried.cost <= state.cost + 1e-9:
            # A bad fit need not be as precise.
            gain = min(gain, (state.cost - tried.cost) / (NO_BETTER * (1 + tried.cost)) * ENOUGH)
            state, damping = tried, damping / 10
        else:
            damping = max(10 * damping, 1e-3)
        if gain < ENOUGH:
            break
    try:
        covariance = np.linalg.inv(state.curvature)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(covariance).all() or (np.diag(covariance) < 0).any():
        return None
    freedom = 2 * int(problem.used.sum()) + int(expected.known.sum()) - 7
    by_turn = slope_of_turn(state.correction[:3])
    corrected = covariance.copy()
    corrected[:3] = by_turn @ corrected[:3]
    corrected[:, :3] = corrected[:, :3] @ by_turn.T
    return Solution(state.pose, state.places, covariance, state.correction, corrected, state.cost, freedom)


@dataclass(frozen=True)
class Slopes:
    """The sum of squares about a pose and landmarks' places, to first order in a step of the 7 + 2n of them.

    missing: (2m,) px, u and v in turn of the m landmarks used: where the picture has them, less where they should be.
    slopes: (2m, 7 + 2n) how the latter grow. correction: (7 + 2n,) what pose and places have beyond what telemetry and
    landmarks report; by_turn: (3, 3) how its first three grow with a small rotation, the others with their own step.
    """

    missing: np.ndarray
    slopes: np.ndarray
    correction: np.ndarray
    by_turn: np.ndarray


def linearize_pose(
    marks: LandmarkObservations,
    camera: Camera,
    expected: Expected,
    pose: CameraPose,
    places: Float[np.ndarray, "n 2"],
    used: Bool[np.ndarray, "n"] | None = None,
) -> Slopes | None:
    """What `fit_pose` knows there; None where the camera cannot show a landmark."""
    return _Problem(marks, camera, expected, np.ones(len(marks), bool) if used is None else used).slopes(pose, places)


def move_pose(pose: CameraPose, step: Float[np.ndarray, "7"]) -> CameraPose:
    """A pose after a step, in the order of Fix."""
    return replace(
        pose,
        axes=turned(step[:3]) @ pose.axes,
        place_m=pose.place_m + step[3:6],
        focal=float(pose.focal * np.exp(np.clip(step[6], -1, 1))),
    )


@dataclass(frozen=True)
class _State:
    """A guess, and how the sum of squares slopes there: half its negative gradient and half its curvature."""

    pose: CameraPose
    places: np.ndarray
    cost: float
    downhill: np.ndarray
    curvature: np.ndarray
    correction: np.ndarray


class _Problem:
    """The sum of squares: what is expected of pose and places, and where the picture shows the landmarks."""

    def __init__(self, marks: LandmarkObservations, camera: Camera, expected: Expected, used: np.ndarray) -> None:
        self.marks, self.camera, self.expected, self.used = marks, camera, expected, used
        self.rows = np.arange(2 * int(used.sum()))[:, None]
        self.columns = 7 + 2 * np.repeat(np.flatnonzero(used), 2)[:, None] + [0, 1]
        self.image = marks.image_px[used].ravel()
        self.weight = 1 / np.repeat(marks.pixel_sigma[used], 2) ** 2
        self.free_heading = not expected.known[HEADING]

    def settled(self, state: _State | None) -> _State | None:
        """The same pose, with the places a step nearer to the likeliest that go with it."""
        if state is None or len(self.used) == 0:
            return state
        try:
            step = np.linalg.solve(state.curvature[7:, 7:], state.downhill[7:])
        except np.linalg.LinAlgError:
            # An absurd pose has landmarks so near its horizon that nothing else counts.
            return state
        nearer = self.at(state.pose, state.places + step.reshape(-1, 2))
        return nearer if nearer is not None and nearer.cost < state.cost else state

    def slopes(self, pose: CameraPose, places: np.ndarray) -> Slopes | None:
        points = np.column_stack([places, self.marks.up_m])[self.used]
        seen, by_pose, by_point = project_with_slopes(points, pose, self.camera)
        if not np.isfinite(seen).all():
            return None
        reference = self.expected.reference
        turn = pose.axes @ reference.axes.T
        if self.free_heading:
            # Where no heading is known the tilt is all that is expected, whichever way the camera looks.
            turn = turn @ about_up(turn).T
        turn_rad = turn_of(turn)
        correction = np.concatenate(
            [
                turn_rad,
                pose.place_m - reference.place_m,
                [np.log(pose.focal / reference.focal)],
                (places - self.marks.east_north_m).ravel(),
            ]
        )
        slopes = np.zeros((len(self.rows), len(self.expected.mean)))
        slopes[:, :7] = by_pose.reshape(-1, 7)
        slopes[self.rows, self.columns] = by_point[:, :, :2].reshape(-1, 2)
        return Slopes(self.image - seen.ravel(), slopes, correction, slope_of_turn(turn_rad))

    def at(self, pose: CameraPose, places: np.ndarray) -> _State | None:
        here = self.slopes(pose, places)
        if here is None:
            return None
        missing, slopes, by_turn = here.missing, here.slopes, here.by_turn
        information, apart = self.expected.information, here.correction - self.expected.mean
        pull = information @ apart
        cost = float(apart @ pull + missing @ (self.weight * missing))
        bent = information.copy()
        bent[:3] = by_turn.T @ bent[:3]
        bent[:, :3] = bent[:, :3] @ by_turn
        pull[:3] = by_turn.T @ pull[:3]
        weighed = slopes.T * self.weight
        return _State(pose, places, cost, weighed @ missing - pull, weighed @ slopes + bent, here.correction)


def _focal_of(hfov_rad: float, camera: Camera, parameters: AerialParameters, known: bool) -> tuple[float, float]:
    """The focal length as a share of the camera's, and its standard deviation."""
    if np.isfinite(hfov_rad) and 0 < hfov_rad < np.pi:
        return float(camera.size_px[0] / 2 / np.tan(hfov_rad / 2) / camera.focal_px[0]), parameters.focal_sigma
    return 1.0, camera.focal_sigma if known else parameters.focal_guess_sigma


# Headings that are tried where nothing tells one.
HEADINGS = 8


def find_pose(
    marks: LandmarkObservations, camera: Camera, expected: Expected, used: Bool[np.ndarray, "n"] | None = None
) -> Solution | None:
    """The most likely of the poses found from all available starts; None without any.

    used: the landmarks whose pixels count; all without it.
    """
    used = np.ones(len(marks), bool) if used is None else used
    known = expected.known
    if known.all():
        first = fit_pose(marks, camera, expected, used=used)
        if first is not None:
            return first
    seen = marks[used]
    starts = [] if known.all() else _turned_about_up(seen, camera, expected)
    if len(seen) >= 4 and not (starts and known[:2].all() and known[5]):
        starts += of_homography(_plain(seen, camera), camera, seen.east_north_m, seen.up_m)
    if not starts and known[[0, 1, 3, 4, 5]].all():
        starts = _all_headings(expected)
    found = [one for start in starts if (one := fit_pose(marks, camera, expected, start, used)) is not None]
    return min(found, key=lambda one: one.cost) if found else None


def _turned_about_up(marks: LandmarkObservations, camera: Camera, expected: Expected) -> list[CameraPose]:
    """With a known tilt the pixels lie on the ground but for turn, size and place, which the landmarks tell."""
    known, pose = expected.known, move_pose(expected.reference, expected.mean[:7])
    if not known[:2].all() or len(marks) == 0:
        return []
    way = rays(marks.image_px, pose, camera)
    if not (way[:, 2] < -1e-3 * np.linalg.norm(way, axis=1)).all():
        return []
    east_north = marks.east_north_m
    height = pose.place_m[2] - marks.up_m if known[5] else np.ones(len(marks))
    seen = (way[:, :2] * (-height / way[:, 2])[:, None]) @ [1, 1j]
    there = east_north @ [1, 1j]
    seen_apart, there_apart = seen - seen.mean(), there - there.mean()
    size = float((np.abs(seen_apart) ** 2).sum())
    if size < 1e-12 and not (known[HEADING] and known[5]):
        return []
    across = complex(seen_apart.conj() @ there_apart) / max(size, 1e-12)
    if not known[5] and known[HEADING]:
        grown = max(across.real, 1e-6)
    else:
        grown = 1.0 if known[5] else abs(across)
    turn = 0.0 if known[HEADING] else float(np.angle(across))
    middle = there.mean() - grown * np.exp(1j * turn) * seen.mean()
    place = pose.place_m.copy()
    if not known[5]:
        place[2] = grown + float(marks.up_m.mean())
    place[:2] = np.where(known[3:5], place[:2], [middle.real, middle.imag])
    axes = turned(np.array([0.0, 0.0, turn])) @ pose.axes
    return [CameraPose(place, axes, pose.focal)]


def _all_headings(expected: Expected) -> list[CameraPose]:
    """Starts in all directions, where only the heading is unknown."""
    pose = move_pose(expected.reference, expected.mean[:7])
    turns = np.linspace(0, 2 * np.pi, HEADINGS, endpoint=False)
    return [replace(pose, axes=turned(np.array([0.0, 0.0, turn])) @ pose.axes) for turn in turns]


def of_homography(flat_from_ground: np.ndarray, camera: Camera, east_north_m: np.ndarray, up_m: np.ndarray) -> list:
    """Poses that see the ground as a homography says, and as its mirror does that is hard to tell from afar.

    flat_from_ground: (3, 3) from local metres to metres right and down a metre of depth.
    """
    middle = east_north_m.mean(axis=0)
    shift = np.eye(3)
    shift[:2, 2] = middle
    matrix = flat_from_ground @ shift
    if not np.isfinite(matrix).all():
        return []
    scale = np.sqrt(np.linalg.norm(matrix[:, 0]) * np.linalg.norm(matrix[:, 1]))
    if not scale > 0:
        return []
    matrix = matrix / scale
    # The ground's middle is before the camera.
    matrix = matrix if matrix[2, 2] > 0 else -matrix
    two, _, other = np.linalg.svd(matrix[:, :2], full_matrices=False)
    east_north = two @ other
    first = np.column_stack([east_north, np.cross(east_north[:, 0], east_north[:, 1])])  # camera axes from the world's
    poses = [_seen_so(first, matrix[:, 2], middle, float(up_m.mean()))]
    # The mirror: the ground's normal reflected at the line of sight to its middle.
    sight = matrix[:, 2] / np.linalg.norm(matrix[:, 2])
    normal = first[:, 2]
    mirrored = 2 * (sight @ normal) * sight - normal
    axis = np.cross(normal, mirrored)
    sine = np.linalg.norm(axis)
    if sine > 1e-6:
        turn = turned(axis / sine * np.arctan2(sine, normal @ mirrored))
        poses.append(_seen_so(turn @ first, matrix[:, 2], middle, float(up_m.mean())))
    # A pose below the ground is wrong.
    return [pose for pose in poses if pose.place_m[2] > 0]


def _seen_so(camera_from_world: np.ndarray, middle_seen: np.ndarray, middle: np.ndarray, up_m: float) -> CameraPose:
    place = np.array([*middle, up_m]) - camera_from_world.T @ middle_seen
    return CameraPose(place, camera_from_world.T)


def _plain(marks: LandmarkObservations, camera: Camera) -> np.ndarray:
    """(3, 3) homography from local metres to metres right and down a metre of depth, unweighed: a start."""
    ground, flat = marks.east_north_m, normalize(marks.image_px, 1.0, camera)
    middle, size = ground.mean(axis=0), max(float(np.abs(ground - ground.mean(axis=0)).max()), 1e-9)
    x, y = ((ground - middle) / size).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    u, v = flat.T
    rows = np.concatenate(
        [
            np.stack([x, y, one, zero, zero, zero, -u * x, -u * y, -u], axis=1),
            np.stack([zero, zero, zero, x, y, one, -v * x, -v * y, -v], axis=1),
        ]
    )
    matrix = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    return matrix @ np.array([[1 / size, 0, -middle[0] / size], [0, 1 / size, -middle[1] / size], [0, 0, 1]])
