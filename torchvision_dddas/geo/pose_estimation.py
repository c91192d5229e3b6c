"""Estimate the likeliest pose of the camera from telemetry and landmarks, all with their errors.

The unknowns are a small rotation about east, north and up (so that straight down is a view like any other), the place,
the log of the focal length, and the places of the landmarks: their receivers err too, and each landmark is weighted by
its accuracy. The prior is an information matrix, in which some unknowns may have no information. Levenberg-Marquardt
steps minimize the sum of squares; the inverse of its curvature is the covariance.
"""

from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.geo.plane_homography import load_solver
from torchvision_dddas.geometry import (
    about_up,
    axes_of,
    normalize,
    project_with_slopes,
    rays,
    slope_of_turn,
    turn_of,
    turned,
)
from torchvision_dddas.types import Bool, Camera, CameraPose, Flight, Float, LandmarkObservations

# The smallest standard deviation of a landmark's place, m. With a smaller deviation the curvature matrix is singular.
EXACT_M = 1e-3
# Index of the heading in a pose, and the number of headings that are tried if none is known.
_HEADING, _HEADINGS = 2, 8
# Most steps; the squared length of the last step, in standard deviations; and the relative reduction of the sum of
# squares below which a step is the last.
_STEPS, _ENOUGH, _NO_BETTER = 30, 1e-5, 1e-5


@dataclass(frozen=True)
class Prior:
    """The expected pose before any landmark is seen.

    information: (7, 7), in the order of Fix, inverse of the pose's covariance; a row of zeros for an unknown parameter.
    """

    pose: CameraPose
    information: np.ndarray

    @property
    def known(self) -> Bool[np.ndarray, "7"]:
        """(7,) whether each parameter has a prior."""
        return np.diag(self.information) > 0


@dataclass(frozen=True)
class Expected:
    """The expected pose and places of n landmarks before they are seen in a picture.

    reference: the pose by telemetry. mean: (7 + 2n,) expected corrections of the reference and of the landmarks'
    reports. information: (7 + 2n, 7 + 2n) of the corrected values. known: (7,) which pose parameters have a prior.
    """

    reference: CameraPose
    mean: np.ndarray
    information: np.ndarray
    known: np.ndarray


@dataclass(frozen=True)
class Linearization:
    """The sum of squares about a pose and places (n, 2) of landmarks, as a function of a step of these 7 + 2n.

    missing: (2m,) px, observed minus expected pixels of the m landmarks used, u and v in turn. slopes: (2m, 7 + 2n)
    derivatives of the expected pixels. correction: (7 + 2n,) pose and places minus the values that telemetry and
    landmarks report; by_turn: (3, 3) derivative of its first three by a small rotation, the others grow with their own
    step. cost: the sum of squares, in standard deviations; downhill: (7 + 2n,) half its negative gradient; curvature:
    half its second derivatives.
    """

    pose: CameraPose
    places: np.ndarray
    missing: np.ndarray
    slopes: np.ndarray
    correction: np.ndarray
    by_turn: np.ndarray
    cost: float
    downhill: np.ndarray
    curvature: np.ndarray


@dataclass(frozen=True)
class PoseSolution(Linearization):
    """The most likely pose and places, at the least sum of squares.

    covariance: (7 + 2n, 7 + 2n) of pose and places; correction_covariance: the same for the correction. cost follows a
    chi-squared distribution with `freedom` degrees of freedom if all errors are as expected.
    """

    covariance: np.ndarray
    correction_covariance: np.ndarray
    freedom: int


def pose_prior(
    flight: Flight | None, camera: Camera, parameters: AerialParameters, focal_known: bool = True
) -> Prior | None:
    """Return the prior of the pose by telemetry; None without place, height and angles.

    flight: the telemetry in local metres. focal_known: the focal length is given, not guessed from a field of view.
    """
    if flight is None:
        return None
    place = np.array([*flight.place, flight.altitude_m], float)
    angles = np.array([flight.heading_rad, flight.pitch_rad, flight.roll_rad], float)
    if not (np.isfinite(place).any() or np.isfinite(angles).any()):
        return None
    sigma = np.full(7, np.inf)
    # Without a pitch the tilt is only a guess.
    tilt = parameters.tilt_sigma_deg if np.isfinite(angles[1]) else parameters.tilt_guess_sigma_deg
    sigma[:2] = _known_or(flight.tilt_sigma_rad, np.radians(tilt))
    if np.isfinite(angles[0]):
        sigma[2] = _known_or(flight.heading_sigma_rad, np.radians(parameters.heading_sigma_deg))
    position = _known_or(flight.position_sigma_m, parameters.position_sigma_m)
    sigma[3:5] = np.where(np.isfinite(place[:2]), position, np.inf)
    if np.isfinite(place[2]):
        usual = float(np.hypot(parameters.altitude_sigma * flight.altitude_m, parameters.altitude_sigma_m))
        sigma[5] = np.hypot(_known_or(flight.altitude_sigma_m, usual), parameters.datum_sigma_m)
    bare = focal_prior(camera, parameters, focal_known)
    focal, information = bare.pose.focal, bare.information
    if np.isfinite(flight.hfov_rad) and 0 < flight.hfov_rad < np.pi:
        focal = float(camera.size_px[0] / 2 / np.tan(flight.hfov_rad / 2) / camera.focal_px[0])
        sigma[6] = parameters.focal_sigma
        information = np.zeros((7, 7))
    angles = np.where(np.isfinite(angles), angles, [0.0, np.radians(parameters.pitch_deg), 0.0])
    pose = CameraPose(np.where(np.isfinite(place), place, 0.0), axes_of(*angles), focal)
    return Prior(pose, information + np.diag(1 / np.maximum(sigma, 1e-6) ** 2))


def _known_or(value: float, otherwise: float) -> float:
    return value if np.isfinite(value) else otherwise


def focal_prior(camera: Camera, parameters: AerialParameters, focal_known: bool = True) -> Prior:
    """Return the prior without telemetry: only the focal length is known."""
    sigma = camera.focal_sigma if focal_known else parameters.focal_guess_sigma
    pose = CameraPose(np.zeros(3), axes_of(0.0, np.radians(parameters.pitch_deg), 0.0))
    return Prior(pose, np.diag([0.0] * 6 + [1 / max(sigma, 1e-6) ** 2]))


def independent_expectation(prior: Prior, sigma_m: Float[np.ndarray, "n"]) -> Expected:
    """Return the expectation for a single picture: the errors of pose and landmarks are independent."""
    size = 7 + 2 * len(sigma_m)
    information = np.zeros((size, size))
    information[:7, :7] = prior.information
    diagonal = np.arange(7, size)
    information[diagonal, diagonal] = 1 / np.maximum(np.repeat(sigma_m, 2), EXACT_M) ** 2
    return Expected(prior.pose, np.zeros(size), information, prior.known)


def find_pose(
    marks: LandmarkObservations, camera: Camera, expected: Expected, used: Bool[np.ndarray, "n"] | None = None
) -> PoseSolution | None:
    """Return the most likely of the poses found from all available starts; None without any.

    marks: every landmark needs a pixel and a place. used: the landmarks whose pixels count; default: all.
    """
    used = np.ones(len(marks), bool) if used is None else used
    known, reported = expected.known, move_pose(expected.reference, expected.mean[:7])
    if known.all():
        first = _fit(marks, camera, expected, used, reported)
        if first is not None:
            return first
    seen = marks[used]
    starts = [] if known.all() else _turned_about_up(seen, camera, known, reported)
    if len(seen) >= 4 and not (starts and known[:2].all() and known[5]):
        starts += _by_homography(seen, camera)
    if not starts and known[[0, 1, 3, 4, 5]].all():
        turns = np.linspace(0, 2 * np.pi, _HEADINGS, endpoint=False)
        starts = [replace(reported, axes=turned(np.array([0.0, 0.0, turn])) @ reported.axes) for turn in turns]
    found = [one for start in starts if (one := _fit(marks, camera, expected, used, start)) is not None]
    return min(found, key=lambda one: one.cost, default=None)


def _fit(
    marks: LandmarkObservations, camera: Camera, expected: Expected, used: np.ndarray, start: CameraPose
) -> PoseSolution | None:
    """Return the likeliest pose and places from a start; None if the camera cannot show a landmark there."""
    n = len(marks)

    def at(pose: CameraPose, places: np.ndarray) -> Linearization | None:
        return linearize_pose(marks, camera, expected, pose, places, used)

    state = at(start, marks.east_north_m + expected.mean[7:].reshape(n, 2))
    if state is None:
        return None
    damping = 1e-6
    for _ in range(_STEPS):
        steeper = state.curvature.copy()
        steeper[np.diag_indices(len(steeper))] *= 1 + damping
        try:
            step = np.linalg.solve(steeper, state.downhill)
        except np.linalg.LinAlgError:
            damping = max(10 * damping, 1e-6)
            continue
        gain = float(step @ state.downhill)
        tried = at(move_pose(state.pose, step[:7]), state.places + step[7:].reshape(n, 2))
        if tried is not None and n and not expected.known.all():
            # Also move the places alone a step towards the optimum. If telemetry does not fix the pose, pixels are so
            # much more accurate than places that the sum of squares has a curved valley, and straight steps are short.
            try:
                nearer_m = np.linalg.solve(tried.curvature[7:, 7:], tried.downhill[7:]).reshape(n, 2)
            except np.linalg.LinAlgError:
                pass  # an absurd pose has landmarks close to its horizon, and they dominate everything else
            else:
                nearer = at(tried.pose, tried.places + nearer_m)
                tried = nearer if nearer is not None and nearer.cost < tried.cost else tried
        if tried is not None and tried.cost <= state.cost + 1e-9:
            # A bad fit needs less precision.
            gain = min(gain, (state.cost - tried.cost) / (_NO_BETTER * (1 + tried.cost)) * _ENOUGH)
            state, damping = tried, damping / 10
        else:
            damping = max(10 * damping, 1e-3)
        if gain < _ENOUGH:
            break
    try:
        covariance = np.linalg.inv(state.curvature)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(covariance).all() or (np.diag(covariance) < 0).any():
        return None
    freedom = 2 * int(used.sum()) + int(expected.known.sum()) - 7
    corrected = covariance.copy()
    corrected[:3] = state.by_turn @ corrected[:3]
    corrected[:, :3] = corrected[:, :3] @ state.by_turn.T
    return PoseSolution(**vars(state), covariance=covariance, correction_covariance=corrected, freedom=freedom)


def linearize_pose(
    marks: LandmarkObservations,
    camera: Camera,
    expected: Expected,
    pose: CameraPose,
    places: Float[np.ndarray, "n 2"],
    used: Bool[np.ndarray, "n"] | None = None,
) -> Linearization | None:
    """Linearize about a pose and landmarks' places; None if the camera cannot show a landmark there."""
    used = np.ones(len(marks), bool) if used is None else used
    seen, slopes = project_landmarks(marks, camera, pose, places, used)
    if not np.isfinite(seen).all():
        return None
    reference, information = expected.reference, expected.information
    turn = pose.axes @ reference.axes.T
    if not expected.known[_HEADING]:
        # Without a known heading only the tilt is expected, in any direction of view.
        turn = turn @ about_up(turn).T
    turn_rad = turn_of(turn)
    by_turn = slope_of_turn(turn_rad)
    moved_m, wider = pose.place_m - reference.place_m, [np.log(pose.focal / reference.focal)]
    correction = np.concatenate([turn_rad, moved_m, wider, (places - marks.east_north_m).ravel()])
    missing = marks.image_px[used].ravel() - seen
    weight = 1 / np.repeat(marks.pixel_sigma[used], 2) ** 2
    apart = correction - expected.mean
    pull = information @ apart
    cost = float(apart @ pull + missing @ (weight * missing))
    bent = information.copy()
    bent[:3] = by_turn.T @ bent[:3]
    bent[:, :3] = bent[:, :3] @ by_turn
    pull[:3] = by_turn.T @ pull[:3]
    weighted = slopes.T * weight
    downhill, curvature = weighted @ missing - pull, weighted @ slopes + bent
    return Linearization(pose, places, missing, slopes, correction, by_turn, cost, downhill, curvature)


def project_landmarks(
    marks: LandmarkObservations, camera: Camera, pose: CameraPose, places: np.ndarray, used: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return pixels (2m,) of the m landmarks used, u and v in turn, and slopes (2m, 7 + 2n) by pose and places."""
    points = np.column_stack([places, marks.up_m])[used]
    seen, by_pose, by_point = project_with_slopes(points, pose, camera)
    slopes = np.zeros((2 * len(points), 7 + 2 * len(used)))
    slopes[:, :7] = by_pose.reshape(-1, 7)
    columns = 7 + 2 * np.repeat(np.flatnonzero(used), 2)[:, None] + [0, 1]
    slopes[np.arange(2 * len(points))[:, None], columns] = by_point[:, :, :2].reshape(-1, 2)
    return seen.ravel(), slopes


def move_pose(pose: CameraPose, step: Float[np.ndarray, "7"]) -> CameraPose:
    """Return a pose after a step, in the order of Fix."""
    return replace(
        pose,
        axes=turned(step[:3]) @ pose.axes,
        place_m=pose.place_m + step[3:6],
        focal=float(pose.focal * np.exp(np.clip(step[6], -1, 1))),
    )


# Starts of the search.


def _turned_about_up(
    marks: LandmarkObservations, camera: Camera, known: np.ndarray, pose: CameraPose
) -> list[CameraPose]:
    """Turn, raise and shift a pose so that its pixels meet the landmarks; no pose if the tilt is unknown."""
    if not known[:2].all() or len(marks) == 0:
        return []
    way = rays(marks.image_px, pose, camera)
    if not (way[:, 2] < -1e-3 * np.linalg.norm(way, axis=1)).all():
        return []
    height = pose.place_m[2] - marks.up_m if known[5] else np.ones(len(marks))
    seen = (way[:, :2] * (-height / way[:, 2])[:, None]) @ [1, 1j]
    there = marks.east_north_m @ [1, 1j]
    seen_apart, there_apart = seen - seen.mean(), there - there.mean()
    size = float((np.abs(seen_apart) ** 2).sum())
    if size < 1e-12 and not (known[_HEADING] and known[5]):
        return []
    across = complex(seen_apart.conj() @ there_apart) / max(size, 1e-12)
    if known[5]:
        grown = 1.0
    else:
        grown = max(across.real, 1e-6) if known[_HEADING] else abs(across)
    turn = 0.0 if known[_HEADING] else float(np.angle(across))
    middle = there.mean() - grown * np.exp(1j * turn) * seen.mean()
    place = pose.place_m.copy()
    if not known[5]:
        place[2] = grown + float(marks.up_m.mean())
    place[:2] = np.where(known[3:5], place[:2], [middle.real, middle.imag])
    return [CameraPose(place, turned(np.array([0.0, 0.0, turn])) @ pose.axes, pose.focal)]


def _by_homography(marks: LandmarkObservations, camera: Camera) -> list[CameraPose]:
    """Return the poses that match an unweighted homography and its mirror, which are hard to distinguish from afar."""
    ground, flat = marks.east_north_m, normalize(marks.image_px, camera)
    middle = ground.mean(axis=0)
    # Map metres about the landmarks' middle to metres right and down per metre of depth, with the shipped graph.
    (matrix,), (is_valid,) = load_solver("onboard").solve((ground - middle)[None], flat[None], np.ones((1, len(flat))))
    if not is_valid or not np.isfinite(matrix).all():
        return []
    scale = np.sqrt(np.linalg.norm(matrix[:, 0]) * np.linalg.norm(matrix[:, 1]))
    if not scale > 0:
        return []
    matrix = matrix / scale
    # The middle of the ground must lie in front of the camera.
    matrix = matrix if matrix[2, 2] > 0 else -matrix
    sight = matrix[:, 2]
    two, _, other = np.linalg.svd(matrix[:, :2], full_matrices=False)
    east_north = two @ other
    normal = np.cross(east_north[:, 0], east_north[:, 1])
    cameras_from_world = [np.column_stack([east_north, normal])]
    # The mirror: reflect the ground's normal at the line of sight to the middle.
    mirrored = 2 * (sight @ normal) * sight / (sight @ sight) - normal
    axis = np.cross(normal, mirrored)
    sine = np.linalg.norm(axis)
    if sine > 1e-6:
        cameras_from_world.append(turned(axis / sine * np.arctan2(sine, normal @ mirrored)) @ cameras_from_world[0])
    above = np.array([*middle, float(marks.up_m.mean())])
    poses = [CameraPose(above - rotation.T @ sight, rotation.T) for rotation in cameras_from_world]
    # Drop poses below the ground.
    return [pose for pose in poses if pose.place_m[2] > 0]
