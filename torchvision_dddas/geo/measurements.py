"""The sightings of one platform at one moment, as measurements of places that share the errors of the platform."""

from dataclasses import dataclass, replace

import numpy as np

from torchvision_dddas.geometry import ground_with_slopes, project
from torchvision_dddas.types import AerialLocations, Camera, CameraPose, Sightings

_PINHOLE = Camera("", (2, 2), (1.0, 1.0), (0.0, 0.0))
_ORDER = np.array([3, 4, 2, 0, 1, 5, 6])  # order of a Fix's errors here: position and heading first
_LEAST_M = 0.05  # smallest standard deviation of the new error in a measurement


@dataclass(frozen=True)
class Measurement:
    """The sightings of one platform at one moment. number, score, label: (N,); numbers below 1 are not identities.

    pose, root: for an aerial camera, its pose in the common metres and a root of the covariance of its errors.
    """

    time_s: float
    frame: int
    platform: str
    seen: Sightings
    number: np.ndarray
    score: np.ndarray
    label: np.ndarray
    pose: CameraPose | None = None
    root: np.ndarray | None = None

    def seen_near(self, rows: np.ndarray, expected_m: np.ndarray) -> Sightings:
        """Return rows of the sightings, with their common errors evaluated at the expected places (M, 2).

        The expected places are first shifted by the mean difference to the sightings. At the measured places, the
        effects of heading and tilt would correlate with the new error of the measurement, and a filter with ten
        measurements a second would find false motions.
        """
        seen = self.seen[rows]
        if self.pose is None or self.root is None:
            return seen
        place = expected_m + (seen.east_north_m - expected_m).mean(axis=0)
        return replace(seen, camera_m=_effects(self.pose, place, self.root))


def aerial_sightings(located: AerialLocations) -> tuple[Sightings, CameraPose | None, np.ndarray | None]:
    """Return the sightings of an aerial camera, common errors as on level ground, and pose and root if known."""
    positions, fix, n = located.positions, located.fix, len(located.positions)
    common = np.nan_to_num((positions.covariance_m2 - located.relative_m2).mean(axis=0)) if n else np.zeros((2, 2))
    pose = root = None
    if fix.pose is not None and fix.covariance is not None:
        pose, errors = CameraPose(fix.pose.place_m, fix.pose.axes), fix.covariance[np.ix_(_ORDER, _ORDER)].copy()
        errors[:2, :2] += common
        root = _root(errors)
        camera = _effects(pose, positions.east_north_m, root)
        own = positions.covariance_m2 - camera @ camera.swapaxes(1, 2)
    else:
        camera = np.concatenate([np.broadcast_to(_root(common), (n, 2, 2)), np.zeros((n, 2, 1))], axis=2)
        own = located.relative_m2
    known = np.isfinite(own).all(axis=(1, 2))
    values, axes = np.linalg.eigh(np.where(known[:, None, None], own, np.eye(2)))
    own = (axes * np.maximum(values, _LEAST_M**2)[:, None, :]) @ axes.swapaxes(1, 2)
    own[~known] = np.nan
    unknown = np.full(n, np.nan)
    by = np.full(n, fix.by, object)
    return Sightings(positions.east_north_m, unknown, unknown, by, own, np.zeros((n, 2)), camera), pose, root


def _effects(pose: CameraPose, place: np.ndarray, root: np.ndarray) -> np.ndarray:
    """Return the (N, 2, 7) effects of one sigma of each error of a pose on places on level ground."""
    pixels = project(np.c_[place, np.zeros(len(place))], pose, _PINHOLE)
    return ground_with_slopes(pose, _PINHOLE, pixels)[1][:, :, _ORDER] @ root


def _root(covariance: np.ndarray) -> np.ndarray:
    """Return a lower triangular root, also of a matrix that is not positive definite because of rounding."""
    return np.linalg.cholesky(covariance + 1e-12 * np.eye(len(covariance)))
