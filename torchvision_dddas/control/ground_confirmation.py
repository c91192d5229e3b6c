"""Pictures from ground vehicles: people found in them confirm which of the aerial camera's targets are human."""

import math
from dataclasses import replace

import numpy as np

from torchvision_dddas import geometry
from torchvision_dddas.config import GroundParameters, Settings
from torchvision_dddas.geo.ranging import range_people
from torchvision_dddas.people.confirmation import Beliefs, GroundObservation, field_of_view, observe_ground, summarize
from torchvision_dddas.people.detector import WindowScorer, detect_people
from torchvision_dddas.types import AerialLocations, Camera, Confirmation, GroundPicture, Poses

# Nobody runs faster.
_RUNNING_M_S = 4.0
# Bounds of body heights and of the camera's heading, in standard deviations.
_SIGMAS = 2.0
# Targets are within one of where they are said to be: most of it is that of the middle within the outline, and the
# whole outline is searched, with so much about it.
_MARGIN_M = 0.5
# The ground between rises or falls as steeply, and the camera nods as far.
_SLOPE_RAD = math.radians(5)
# Half the width of a body's box over its height: a region holds whole boxes.
_HALF_WIDE = 0.17


class GroundConfirmation:
    """What is believed of each target, as pictures from the ground come in."""

    def __init__(self, settings: Settings, scorer: WindowScorer) -> None:
        self._settings, self._scorer = settings, scorer
        self._beliefs = Beliefs(settings.confirm)
        self._waiting: list[GroundPicture] = []

    def take(self, pictures: list[GroundPicture]) -> None:
        """Pictures of the frames to come, as targets are located some frames later."""
        self._waiting += pictures

    def confirm(self, located: AerialLocations, extent_m: np.ndarray) -> Confirmation:
        """The confirmation of the targets of a frame, by the pictures taken at it and before.

        extent_m: (P,) radius of each located target: its people mount about its middle.
        """
        looks = [(p.vehicle, self._look(p, located, extent_m)) for p in self._waiting if p.frame == located.frame]
        self._waiting = [picture for picture in self._waiting if picture.frame > located.frame]
        targets = located.positions.target.tolist()
        self._beliefs.add(targets, looks)
        return summarize(located.frame, slice(0, len(targets)), targets, self._beliefs, looks)

    def _look(self, picture: GroundPicture, located: AerialLocations, extent_m: np.ndarray) -> GroundObservation:
        settings, camera, positions = self._settings, picture.camera, located.positions
        target_m, covariance, heading = positions.east_north_m, positions.covariance_m2, camera.heading_rad
        place = np.array([camera.place], float)
        if positions.origin_deg is not None:
            place = geometry.east_north(place, positions.origin_deg)
        # Locations from the air give where to search, and how large people are there.
        regions = expected_regions(target_m, covariance, extent_m, camera, place[0], heading, settings.ground)
        (people,) = detect_people([picture.image], self._scorer, settings.people, [regions])
        n = len(people)
        here = np.repeat(place, n, axis=0)
        poses = Poses(here, np.full(n, heading), np.full(n, camera.pitch_rad))
        seen = range_people(people.box_px, people.cut, camera, poses, here, settings.ground)
        known = seen.by != "bearing"
        view = field_of_view(camera, place[0], heading, settings.people, settings.ground)
        # People of a crowd stand within it, not at its middle: half its radius is about their standard deviation.
        spread = covariance + (extent_m[:, None, None] / 2) ** 2 * np.eye(2)
        person_m, person_m2 = seen.east_north_m[known], seen.covariance_m2[known]
        scores = people.score[known]
        found = observe_ground(target_m, spread, person_m, person_m2, scores, [view], settings.confirm)
        return drop_fast_targets(found, located.velocity_m_s)


def drop_fast_targets(seen: GroundObservation, velocity_m_s: np.ndarray) -> GroundObservation:
    """The look without the people at targets faster than people, (N, 2): they stand beside its way."""
    fast = np.linalg.norm(velocity_m_s, axis=1) > _RUNNING_M_S  # False where unknown
    return replace(seen, looked=seen.looked & ~(fast & (seen.people > 0)))


def expected_regions(
    place_m: np.ndarray,
    covariance_m2: np.ndarray,
    radius_m: np.ndarray,
    camera: Camera,
    camera_m: np.ndarray,
    heading_rad: float,
    parameters: GroundParameters,
) -> tuple[np.ndarray, np.ndarray]:
    """(R, 4) boxes in the picture within which bodies of the targets in view lie, and (R, 2) heights of these, in px.

    place_m (N, 2), covariance_m2 (N, 2, 2), radius_m (N,): of the targets. camera_m (2,): where the camera stands, by
    the same origin. In the form that `people.pyramid.within` takes; a target outside the picture has no region.
    """
    regions: list[list[float]] = []
    heights: list[tuple[float, float]] = []
    width, (focal_u, focal_v), (middle_u, middle_v) = camera.size_px[0], camera.focal_px, camera.centre_px
    unsure = np.sqrt(np.maximum(np.linalg.eigvalsh(covariance_m2)[:, -1], 0) + camera.position_sigma_m**2)
    tall = parameters.body_height_m + _SIGMAS * parameters.body_height_sigma_m * np.array([-1.0, 1.0])
    eye = camera.height_m if math.isfinite(camera.height_m) else float(tall[1])
    nearest_m = focal_v * tall[0] / camera.size_px[1]  # nobody is whole in the picture from nearer
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
        # Along the axis, over the part of the target that is in view.
        far = (away + reach) * math.cos(min(max(0.0, low), high))
        near = max((away - reach) * math.cos(max(abs(low), abs(high))), nearest_m)
        if far <= near:
            continue
        # A head above the eye's height is highest when near, one below it when far.
        top = horizon - focal_v * (_SLOPE_RAD + max((tall[1] - eye) / near, 0.0))
        bottom = horizon + focal_v * (_SLOPE_RAD + eye / near)
        heights.append((focal_v * tall[0] / far, focal_v * tall[1] / near))
        beside = _HALF_WIDE * heights[-1][1]
        regions.append([left - beside, top, right - left + 2 * beside, bottom - top])
    return np.array(regions, float).reshape(-1, 4), np.array(heights, float).reshape(-1, 2)
