"""Estimate the errors of a vehicle's log from a flight whose pictures show points of known place.

The pixels of the points differ from the pixels that the logged poses predict. The difference is an offset common to all
pictures, plus an error of each picture that persists for a while as in `Georeferencer`, plus the noise of the points.
The standard deviations of the pictures' errors are maximum-likelihood estimates from all pixels together, under broad
priors around the settings. A point that contradicts the others is left out.
Source: variance components by maximum likelihood and Fisher's scoring (D. Harville, 1977).
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from torchvision_dddas.config import AerialParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.aerial_locator import AerialLocator
from torchvision_dddas.geo.georeferencer import ErrorPersistence, describe_unknown_pose
from torchvision_dddas.geo.pose_estimation import Prior, move_pose, pose_prior, project_landmarks
from torchvision_dddas.geometry import rays
from torchvision_dddas.types import Camera, LandmarkObservations

PARTS = ("tilt", "heading", "position", "height")
OFFSETS = ("heading", "pitch", "roll", "east", "north", "height", "focal length")
PART_OF_OFFSET = np.array([1, 0, 0, 2, 2, 3])
# The part of each of a pose's seven parameters, in the order of Fix; all pictures share one focal length (-1).
_PART = np.array([0, 0, 1, 2, 2, 3, -1])
# An offset's prior standard deviation is _BROAD times its part's. A standard deviation is known if its relative error
# is below _KNOWN, and an offset if its error is at most the share _KNOWN of the stated standard deviation.
_BROAD, _KNOWN = 3.0, 0.5
_LEAST_PICTURES = 6
# Most points, to limit the time; most steps; length of the last step, in sigmas; largest share of points left out.
_MOST, _STEPS, _SHORT, _WRONG = 300, 500, 0.05, 0.2
# Above this log ratio of estimated to stated standard deviation, points and log are from different flights.
_ABSURD = 3.5


@dataclass(frozen=True)
class Look:
    """A picture with points of known place: its frame and time, the logged pose with its stated errors, the points."""

    frame: int
    time_s: float
    prior: Prior
    marks: LandmarkObservations


@dataclass(frozen=True)
class FlightErrors:
    """The errors of a vehicle's log, as truth less log, in rad and m.

    offset, offset_sigma: (7,) of OFFSETS: heading clockwise, pitch below the horizon, roll clockwise, east, north,
    height, log of the focal length. sigma: (4,) standard deviations of PARTS between pictures. relative: (4,) relative
    standard errors of sigma. stated: (4,) sigma by the settings. shown: (4,) whether the flight determines a part.
    pictures, points: numbers that were used. wrong: frame and landmark of the points that were left out.
    """

    offset: np.ndarray
    offset_sigma: np.ndarray
    sigma: np.ndarray
    relative: np.ndarray
    stated: np.ndarray
    shown: np.ndarray
    pictures: int
    points: int
    wrong: tuple[tuple[int, int], ...]

    def settings(self, before: AerialParameters, without: Sequence[str] = ()) -> dict[str, float]:
        """Return the parameters that describe these errors, without the parts `without` and undetermined parts.

        An offset that has no parameter increases the standard deviation of its part, by its mean square.
        """
        squares = self.offset_sigma**2 + self.offset**2 * (np.arange(7) > 1)
        beside = np.array([squares[:6][part == PART_OF_OFFSET].mean() for part in range(4)])
        own = self.sigma * np.exp(self.relative**2)  # the root of the expected variance
        tilt, heading, position, _ = np.sqrt(own**2 + beside)
        grown, (right_deg, lower_deg) = own[3] / self.stated[3], np.degrees(self.offset[:2])
        parts = (
            {"pitch_offset_deg": before.pitch_offset_deg + lower_deg, "tilt_sigma_deg": math.degrees(tilt)},
            {
                "heading_offset_deg": before.heading_offset_deg + right_deg,
                "heading_sigma_deg": math.degrees(heading),
            },
            {"position_sigma_m": position},
            {name: grown * getattr(before, name) for name in ("altitude_sigma", "altitude_sigma_m")}
            | {"datum_sigma_m": math.sqrt(beside[3])},
        )
        told = [values for k, values in enumerate(parts) if self.shown[k] and PARTS[k] not in without]
        return {f"aerial.{name}": float(f"{value:.4g}") for values in told for name, value in values.items()}


def find_looks(locator: AerialLocator, times_s: Mapping[int, float] | None = None) -> list[Look]:
    """Return the pictures that show landmarks, with their logged poses. times_s: of each frame if the rate varies.

    Raise InputError if there are none.
    """
    landmarks, looks, cause = locator.site.landmarks, list[Look](), "no row has u_px,v_px"
    parameters = locator.settings.aerial.model_copy(update={"datum_sigma_m": 0.0})
    for frame in np.unique(np.round(landmarks.frame[np.isfinite(landmarks.image_px[:, 0])]).astype(int)).tolist():
        time_s, marks = (times_s or {}).get(frame, locator.time_s(frame)), locator.landmarks_at(frame)
        flight = locator.telemetry_at(time_s)
        prior = pose_prior(flight, locator.camera, parameters, locator.focal_known)
        cause = describe_unknown_pose(flight, prior) or "no point has a place"
        if prior is not None and prior.known.all() and len(marks):
            looks.append(Look(frame, time_s, prior, marks))
    if not looks:
        raise InputError(f"no picture of {landmarks.path} can be used: {cause}")
    return looks


def estimate_flight_errors(looks: Sequence[Look], camera: Camera, parameters: AerialParameters) -> FlightErrors:
    """Estimate the errors of a log. Raise InputError for fewer than six pictures, or a log far from the points.

    >>> errors = estimate_flight_errors(find_looks(locator), locator.camera, locator.settings.aerial)
    """
    if len(looks) < _LEAST_PICTURES:
        raise InputError(
            f"at least {_LEAST_PICTURES} pictures with points are needed, better 20, from several directions "
            f"and distances; got {len(looks)}"
        )
    looks = looks[:: math.ceil(sum(len(look.marks) for look in looks) / _MOST)]
    names = [(look.frame, int(mark)) for look in looks for mark in look.marks.landmark]
    usual = np.median([_sigma(look) for look in looks], axis=0)
    stated, spread = usual[[0, 2, 3, 5]], np.r_[_BROAD * usual[[2, 0, 1, 3, 4, 5]], usual[6]]
    expected = np.r_[_turned_by(looks, camera), np.zeros(6)]
    about, theta, used = expected, np.zeros(4), np.ones(len(names), bool)
    for _ in range(_STEPS):
        residual, by_offset, covariances = _linearize(looks, camera, about, parameters.correlation_s, used)
        if (behind := ~np.isfinite(residual[::2])).any():
            used[np.flatnonzero(used)[behind]] = False
        if used.mean() < 1 - _WRONG:
            break
        if behind.any():
            continue
        grown, gain = np.exp(2 * theta)[:, None, None] * covariances[1:], spread[:, None] ** 2 * by_offset.T
        inverse = np.linalg.inv(covariances[0] + by_offset @ gain + grown.sum(axis=0))
        pull, moved = inverse @ (residual + by_offset @ (about - expected)), inverse @ grown
        uphill = theta + np.trace(moved, axis1=1, axis2=2) - pull @ grown @ pull
        known = np.linalg.inv(np.eye(4) + 2 * np.einsum("aij,bji->ab", moved, moved))
        # Take half of Fisher's step: a whole step may oscillate around a standard deviation near 0.
        relative, step = np.sqrt(known.diagonal()), np.clip(-known @ uphill, -1, 1) / 2
        offset_sigma = np.sqrt(spread**2 - (gain @ inverse @ gain.T).diagonal())
        offset, theta = expected + gain @ pull, theta + step
        if (np.abs(step) > _SHORT * relative).any():
            continue
        if (worst := _worst(inverse, pull, parameters.gate_probability)) >= 0:
            used[np.flatnonzero(used)[worst]] = False
            continue
        # Linearize again only now, because wrong points would distort the slopes.
        if (np.abs(offset - about) > _SHORT * offset_sigma).any():
            about = offset
            continue
        vague = PART_OF_OFFSET[offset_sigma[:6] > _KNOWN * stated[PART_OF_OFFSET]]
        shown = ((relative < _KNOWN) | (np.abs(theta) > 2 * relative)) & ~np.isin(range(4), vague)
        if theta.max() > _ABSURD:
            break
        wrong = tuple(name for name, kept in zip(names, used, strict=True) if not kept)
        sigma, count = stated * np.exp(theta), int(used.sum())
        return FlightErrors(offset, offset_sigma, sigma, relative, stated, shown, len(looks), count, wrong)
    raise InputError(
        f"the points contradict the log: {len(used) - used.sum()} of {len(used)} were left out, and the rest does not "
        "agree; check the points, the clock (aerial.clock_offset_s) and the heading (aerial.heading_offset_deg)"
    )


def _sigma(look: Look) -> np.ndarray:
    return np.asarray(1 / np.sqrt(look.prior.information.diagonal()))


def _turned_by(looks: Sequence[Look], camera: Camera) -> float:
    """Return the mean clockwise angle, rad, from the logged direction of the points to their true direction."""
    turn = 0j
    for look in looks:
        way = rays(look.marks.image_px, look.prior.pose, camera)[:, :2] @ [1, 1j]
        there = (look.marks.east_north_m - look.prior.pose.place_m[:2]) @ [1, 1j]
        turn += np.nansum(way * there.conj() / np.maximum(np.abs(there), 1e-9))
    return float(np.angle(turn))


def _linearize(
    looks: Sequence[Look], camera: Camera, offset: np.ndarray, correlation_s: float, used: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return residuals (N,) px, slopes by the offset (N, 7), and covariances of point noise and of PARTS (5, N, N)."""
    from scipy.linalg import block_diag  # imported here because only this command needs it

    found = []
    for look in looks:
        marks, step, (heading, pitch, roll) = look.marks, np.eye(7), look.prior.pose.angles_rad
        # A pitch of more than 90 degrees down means that the camera looks back, upside down.
        heading += offset[0] + math.pi * (pitch > math.pi / 4 and abs(roll) > math.pi / 2)
        left, ahead = [-math.cos(heading), math.sin(heading), 0], [math.sin(heading), math.cos(heading), 0]
        step[:3, :3] = np.array([[0, 0, -1], left, ahead]).T
        # Turn the heading first: together with the others it would be turned about one slanting axis.
        pose = move_pose(move_pose(look.prior.pose, step[:, 0] * offset[0]), step[:, 1:] @ offset[1:])
        everyone = np.ones(len(marks), bool)
        seen, slopes = project_landmarks(marks, camera, pose, marks.east_north_m, everyone)
        noise = (slopes[:, 7:] * np.repeat(marks.sigma_m, 2) ** 2) @ slopes[:, 7:].T
        noise += np.diag(np.repeat(marks.pixel_sigma, 2) ** 2)
        by_pose, when = slopes[:, :7], np.full(len(seen), look.time_s)
        found.append((marks.image_px.ravel() - seen, by_pose @ step, by_pose * _sigma(look), when, noise))
    rows = np.repeat(used, 2)
    residual, by_offset, scaled, when = (np.concatenate(part)[rows] for part in list(zip(*found, strict=True))[:4])
    apart_s = np.abs(when[:, None] - when)
    lasting = ErrorPersistence().telemetry * np.exp(-apart_s / max(correlation_s, 1e-9))
    alike = np.where(apart_s == 0, 1.0, lasting)
    parts = [alike * (scaled[:, k == _PART] @ scaled[:, k == _PART].T) for k in range(len(PARTS))]
    return residual, by_offset, np.array([block_diag(*(one[4] for one in found))[np.ix_(rows, rows)], *parts])


def _worst(inverse: np.ndarray, pull: np.ndarray, gate: float) -> int:
    """Return the point with the largest residual given all others; -1 if chance explains every residual."""
    points = np.arange(len(pull)).reshape(-1, 2)
    own = np.linalg.inv(inverse[points[:, :, None], points[:, None, :]])
    squares = np.einsum("ni,nij,nj->n", pull[points], own, pull[points])
    worst = int(squares.argmax())
    return worst if squares[worst] > -2 * math.log((1 - gate) / len(points)) else -1
