"""Use people in pictures from ground vehicles to confirm which targets are human, and to locate crowds."""

import math
from dataclasses import replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import GroundParameters, Settings
from torchvision_dddas.control.confirmation import Beliefs, GroundObservation, field_of_view, observe_ground, summarize
from torchvision_dddas.control.ground_crowds import CrowdLooks
from torchvision_dddas.control.prediction import Prediction
from torchvision_dddas.geo import range_people
from torchvision_dddas.people import WindowScorer, detect_people
from torchvision_dddas.types import AerialLocations, Camera, Confirmation, GroundCrowds, GroundPicture, Poses

# Targets that move faster than this are not people.
_RUNNING_M_S = 4.0
# Range of body heights and of the camera's heading, in standard deviations.
_SIGMAS = 2.0
# Margin around a target's radius and one standard deviation of its position that is also searched.
_MARGIN_M = 0.5
# Tolerance for the slope of the ground and for the camera's pitch.
_SLOPE_RAD = math.radians(5)
# Half the width of a body's box divided by its height. Regions are wide enough for whole boxes.
_HALF_WIDE = 0.17
# Standard deviation of the predicted position of a target that was not located from the air.
_PREDICTED_M = 1.0


class GroundConfirmation:
    """Keeps the probability that each target is human, and the positions of its people, from ground pictures."""

    def __init__(self, settings: Settings, scorer: WindowScorer) -> None:
        self._settings, self._scorer = settings, scorer
        self._beliefs, self._looks = Beliefs(settings.confirm), CrowdLooks()
        self._waiting: list[GroundPicture] = []

    def take(self, pictures: list[GroundPicture]) -> None:
        """Store pictures until the targets of their frames are located, which is some frames later."""
        self._waiting += pictures

    def confirm(
        self, located: AerialLocations, extent_m: np.ndarray, missing: Prediction | None = None
    ) -> tuple[Confirmation, GroundCrowds]:
        """Return the confirmation of a frame's targets by all pictures so far, and the crowds seen at the frame.

        extent_m: (P,) radius of each located target, within which its people stand. missing: predicted targets that
        were not located in the frame. People are searched there too, but the absence of people is not evidence.
        """
        positions = located.positions
        targets, count = positions.target, len(positions)
        place, covariance, velocity = positions.east_north_m, positions.covariance_m2, located.velocity_m_s
        if missing is not None and len(missing):
            targets = np.concatenate([targets, missing.target])
            place = np.concatenate([place, missing.east_north_m])
            guess = np.tile(_PREDICTED_M**2 * np.eye(2), (len(missing), 1, 1))
            covariance = np.concatenate([covariance, guess])
            velocity = np.concatenate([velocity, missing.velocity_m_s])
            extent_m = np.concatenate([extent_m, missing.radius_m])
        looks = []
        for picture in self._waiting:
            if picture.frame == located.frame:
                seen, person_m = self._look(picture, positions.origin_deg, place, covariance, extent_m, velocity)
                self._looks.add(
                    located.time_s, picture.vehicle, np.where(seen.blob >= 0, targets[seen.blob], 0), person_m
                )
                looks.append((picture.vehicle, _of_first(count, seen)))
        self._waiting = [picture for picture in self._waiting if picture.frame > located.frame]
        names = positions.target.tolist()
        self._beliefs.add(names, looks)
        confirmed = summarize(located.frame, slice(0, count), names, self._beliefs, looks)
        return confirmed, self._looks.crowds(located.time_s)

    def _look(
        self,
        picture: GroundPicture,
        origin_deg: tuple[float, float] | None,
        target_m: np.ndarray,
        covariance: np.ndarray,
        extent_m: np.ndarray,
        velocity_m_s: np.ndarray,
    ) -> tuple[GroundObservation, np.ndarray]:
        """Return the observation of targets in a picture, and the (M, 2) positions of its people."""
        settings, camera = self._settings, picture.camera
        heading, place = camera.heading_rad, np.array([camera.place], float)
        if origin_deg is not None:
            place = geometry.east_north(place, origin_deg)
        # Locations from the air define the regions to search, and the size of people there.
        regions = expected_regions(target_m, covariance, extent_m, camera, place[0], heading, settings.ground)
        (people,) = detect_people([picture.image], self._scorer, settings.people, [regions])
        n = len(people)
        here = np.repeat(place, n, axis=0)
        poses = Poses(here, np.full(n, heading), np.full(n, camera.pitch_rad))
        seen = range_people(people.box_px, people.cut, camera, poses, here, settings.ground)
        known = seen.by != "bearing"
        view = field_of_view(camera, place[0], heading, settings.people, settings.ground)
        # The people of a crowd are spread over its radius, with a standard deviation of about half the radius.
        spread = covariance + (extent_m[:, None, None] / 2) ** 2 * np.eye(2)
        person_m, person_m2 = seen.east_north_m[known], seen.covariance_m2[known]
        scores = people.score[known]
        found = observe_ground(target_m, spread, person_m, person_m2, scores, [view], settings.confirm)
        return drop_fast_targets(found, velocity_m_s), person_m


def _of_first(count: int, seen: GroundObservation) -> GroundObservation:
    """Return the observation of the first `count` targets."""
    rows = {name: getattr(seen, name)[:count] for name in ("looked", "people", "nearest_m", "nearest_sigmas", "best")}
    return replace(seen, **rows)


def drop_fast_targets(seen: GroundObservation, velocity_m_s: np.ndarray) -> GroundObservation:
    """Drop the people at targets that move too fast to be people. velocity_m_s: (N, 2) of the targets."""
    fast = np.linalg.norm(velocity_m_s, axis=1) > _RUNNING_M_S  # False for an unknown velocity
    blob = np.where(np.isin(seen.blob, np.flatnonzero(fast)), -1, seen.blob)
    return replace(seen, looked=seen.looked & ~(fast & (seen.people > 0)), blob=blob)


def expected_regions(
    place_m: np.ndarray,
    covariance_m2: np.ndarray,
    radius_m: np.ndarray,
    camera: Camera,
    camera_m: np.ndarray,
    heading_rad: float,
    parameters: GroundParameters,
) -> tuple[np.ndarray, np.ndarray]:
    """Return (R, 4) boxes in the picture that contain the bodies of targets in view, and the (R, 2) body heights, px.

    place_m (N, 2), covariance_m2 (N, 2, 2), radius_m (N,): of the targets. camera_m (2,): position of the camera, with
    the same origin. The result is in the form of `people.pyramid.within`. A target outside the picture has no region.
    """
    regions: list[list[float]] = []
    heights: list[tuple[float, float]] = []
    width, (focal_u, focal_v), (middle_u, middle_v) = camera.size_px[0], camera.focal_px, camera.centre_px
    unsure = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_m2)[:, -1], 0) + camera.position_sigma_m**2)
    tall = parameters.body_height_m + _SIGMAS * parameters.body_height_sigma_m * np.array([-1.0, 1.0])
    eye = camera.height_m if math.isfinite(camera.height_m) else float(tall[1])
    nearest_m = focal_v * tall[0] / camera.size_px[1]  # a person nearer than this does not fit into the picture
    horizon = middle_v - focal_v * math.tan(camera.pitch_rad)
    for apart, reach in zip(place_m - camera_m, radius_m + unsure + _MARGIN_M, strict=True):
        away = float(np.hypot(*apart))
        if away < nearest_m:
            continue
        off = (math.atan2(apart[0], apart[1]) - heading_rad + math.pi) % (2 * math.pi) - math.pi
        half = math.asin(min(reach / max(away, 1e-9), 1.0)) + _SIGMAS * camera.heading_sigma_rad
        low, high = (min(max(off + side * half, -1.4), 1.4) for side in (-1, 1))
        left, right = (middle_u + focal_u * math.tan(angle) for angle in (low, high))
        if right < 0 or left > width or abs(off) - half > math.pi / 2:
            continue
        # Range of depths along the optical axis over the visible part of the target.
        far = (away + reach) * math.cos(min(max(0.0, low), high))
        near = max((away - reach) * math.cos(max(abs(low), abs(high))), nearest_m)
        if far <= near:
            continue
        # A head above the camera is highest in the picture if near; a head below the camera is highest if far.
        top = horizon - focal_v * (_SLOPE_RAD + max((tall[1] - eye) / near, 0.0))
        bottom = horizon + focal_v * (_SLOPE_RAD + eye / near)
        heights.append((focal_v * tall[0] / far, focal_v * tall[1] / near))
        beside = _HALF_WIDE * heights[-1][1]
        regions.append([left - beside, top, right - left + 2 * beside, bottom - top])
    return np.array(regions, float).reshape(-1, 4), np.array(heights, float).reshape(-1, 2)
