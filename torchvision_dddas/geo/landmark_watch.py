"""Find landmarks in the pictures of a clip by their colours or by a table, and remove them from the targets.

Then group crowds: targets that are close together on the ground and move alike become one target. Appendix A treats
each crowd as one target of the aerial camera. The distance within a crowd is given in metres here, not in pixels of a
closing kernel, so that it is the same at every altitude.
"""

import time
from collections import Counter
from dataclasses import dataclass, replace

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.aerial_locator import AerialLocator, FrameFix
from torchvision_dddas.geo.colours import mask_colours
from torchvision_dddas.geo.landmark_tracking import LandmarkTracker, TrackedLandmarks
from torchvision_dddas.geo.plane_homography import LEAST
from torchvision_dddas.geometry import connected_parts, distort_pixels, inside, middles_of, project, transfer
from torchvision_dddas.types import (
    Bool,
    Colours,
    Detections,
    Fix,
    Float,
    Int,
    LandmarkObservations,
    Landmarks,
    Scene,
    most_common,
)

# A vehicle and its shadow reach this far from its colour, in vehicle lengths.
_REACH = 0.75
# The rest of a blob beside a vehicle is a target if it has at least this area: a person with a shadow.
_LEAST_M2 = 0.4
# The rest of a vehicle's own blob must be this many times larger, because it is usually the vehicle's shadow.
_VEHICLE_REST = 4
# A blob's centre this many standard deviations from the expected place is replaced by a colour at half the distance.
_ASTRAY_SIGMAS = 3.0


@dataclass(frozen=True)
class WatchedScene:
    """A scene without the landmarks, its fix, and how each landmark was found: motion, colour or table."""

    scene: Scene
    fixed: FrameFix
    sighted_by: tuple[str, ...]


def without_pixels(landmarks: Landmarks) -> Landmarks:
    """A copy whose image places are unknown (NaN), so that the landmarks are searched by colour."""
    return replace(landmarks, image_px=np.full_like(landmarks.image_px, np.nan))


def check_colours(landmarks: Landmarks, colours: Colours | None, helped: bool) -> None:
    """Raise InputError if the landmarks and colours cannot locate any picture.

    helped: whether telemetry gives the place of the camera.
    """
    if colours is None:
        if not np.isfinite(landmarks.image_px).all(axis=1).any():
            raise InputError(
                f"landmarks {landmarks.path} give no pixels (u_px,v_px); give --colours FILE with the colours of the "
                "landmarks, as `dddas colours` writes it"
            )
        return
    if strange := [name for name in colours.names if name not in landmarks.names]:
        raise InputError(
            f"the colours name {', '.join(strange)}, but the landmarks {landmarks.path} are "
            f"{', '.join(landmarks.names)}; use the same names in both"
        )
    if len(colours) < LEAST and not helped:
        raise InputError(
            f"locating needs {LEAST} landmarks; colours are given for {len(colours)}: {LEAST - len(colours)} missing. "
            "Give --telemetry, or more landmarks"
        )


class LandmarkWatch:
    """Locates the scenes of a clip in order, and removes landmarks from their targets."""

    def __init__(self, locator: AerialLocator, colours: Colours | None) -> None:
        """colours: None if the table of landmarks gives their pixels."""
        self.locator, self._colours = locator, colours
        self._fix: Fix | None = None
        if colours is not None:
            names = locator.site.landmarks.names
            # Index of the colour of each landmark, -1 for none.
            self._colour_of = np.full(len(names), -1)
            self._colour_of[[names.index(name) for name in colours.names]] = np.arange(len(colours))
            self._tracker = LandmarkTracker(len(colours), locator.settings.landmarks)

    def restarted(self) -> "LandmarkWatch":
        """Return this watch in its state before the first scene."""
        return LandmarkWatch(self.locator.restarted(), self._colours)

    def update(self, scene: Scene) -> WatchedScene:
        """Locate the next scene, and return it without its landmarks."""
        start = time.perf_counter()
        marks = self.locator.landmarks_at(scene.frame.number)
        if self._colours is not None:
            marks, scene, by = self._find(scene, marks, self._colours)
        else:
            by = np.full(len(marks), "table")
            # The smallest box around a landmark belongs to it.
            box_px, shown = scene.detections.box_px, np.isfinite(marks.image_px).all(axis=1)
            area = np.where(inside(marks.image_px[shown], box_px), box_px[:, 2] * box_px[:, 3], np.inf)
            own = np.zeros(len(box_px), bool)
            own[[row.argmin() for row in area if np.isfinite(row).any()]] = True
            scene = without_detections(scene, own)
        spent = time.perf_counter() - start
        fixed = self.locator.fix_frame(scene.frame.number, marks, time_s=scene.frame.time_s)
        self._fix = fixed.fix
        found_by = dict(zip(marks.landmark.tolist(), by.tolist(), strict=True))
        return WatchedScene(
            scene,
            replace(fixed, seconds={"landmarks": spent, **fixed.seconds}),
            tuple(found_by[which] for which in fixed.marks.landmark.tolist()),
        )

    def _find(
        self, scene: Scene, marks: LandmarkObservations, colours: Colours
    ) -> tuple[LandmarkObservations, Scene, np.ndarray]:
        """Return the landmarks with their pixels, the scene without them, and how each was found."""
        image, step = scene.frame.image, scene.camera_motion
        if image.ndim == 2:
            raise InputError(
                "the clip is grey: landmarks cannot be identified by colour; give u_px,v_px in the landmarks"
            )
        colour = self._colour_of[marks.landmark]
        rows = np.flatnonzero(colour >= 0)
        colour = colour[rows]
        expected, length = np.full((len(colours), 2), np.nan), np.full(len(colours), np.nan)
        should_px, px_per_m = self._expected(marks, step)
        expected[colour] = should_px[rows]
        length[colour] = self.locator.settings.landmarks.length_m * px_per_m[rows]
        masks = mask_colours(image, colours.low, colours.high)
        seen = self._tracker.update(scene.frame.number, masks, scene.detections, scene.mask, step, expected, length)
        pixels, by = np.full((len(marks), 2), np.nan), np.full(len(marks), "", "<U6")
        pixels[rows], by[rows] = seen.image_px[colour], np.array(seen.by, "<U6")[colour]
        # Often only a part of a slow vehicle moves visibly, and the centre of that part is not the vehicle's centre.
        # The place of the colour is used if it is clearly nearer to the expected place of the landmark.
        worn = np.full((len(marks), 2), np.nan)
        worn[rows] = seen.colour_px[colour]
        off, colour_off = (np.linalg.norm(at - should_px, axis=1) for at in (pixels, worn))
        astray = (by == "motion") & (off > _ASTRAY_SIGMAS * marks.pixel_sigma) & (colour_off < 0.5 * off)
        pixels[astray], by[astray] = worn[astray], "colour"
        # Blobs include shadows, so their pixels are moved to the vehicle's feet. Colours stay at height_m.
        height, moving, up_m = self.locator.settings.landmarks.height_m, by == "motion", marks.up_m.copy()
        if height and moving.any():
            feet = None if self._fix is None else self.locator.feet_px(self._fix, pixels[moving], height)
            up_m[moving] -= height / 2 if feet is None else height
            if feet is not None:
                pixels[moving] = feet
        return replace(marks, up_m=up_m, image_px=pixels), self._cut(scene, seen, length), by

    def _cut(self, scene: Scene, seen: TrackedLandmarks, length_px: np.ndarray) -> Scene:
        """Return the scene without the landmarks' own blobs, and without their part of shared blobs."""
        settings = self.locator.settings
        if scene.mask.shape != scene.frame.image.shape[:2] or not len(scene.detections):
            return without_detections(scene, seen.rows)
        least = np.inf
        if np.isfinite(length_px).any():
            metre = np.nanmedian(length_px) / settings.landmarks.length_m
            least = max(settings.small.min_area_px, _LEAST_M2 * metre**2)
        radius_px = _REACH * length_px
        found, mask = cut_out_landmarks(scene.detections, scene.mask, seen.rows, seen.colour_px, radius_px, least)
        return replace(scene, detections=found, mask=mask)

    def _expected(self, marks: LandmarkObservations, step: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """Predict the pixels (n, 2) of the landmarks from the fix of the frame before, and (n,) pixels a metre.

        Both are NaN if unknown.
        """
        fix, camera = self._fix, self.locator.camera
        beside = np.concatenate([marks.east_north_m + metre for metre in ((0, 0), (1, 0), (0, 1))])
        if fix is not None and step is not None and fix.pose is not None:
            before = project(np.c_[beside, np.tile(marks.up_m, 3)], fix.pose, camera)
        elif fix is not None and step is not None and fix.image_from_ground is not None:
            before = transfer(fix.image_from_ground, beside)
            before = before if fix.by == "paper" else distort_pixels(before, camera)
        else:
            return np.full((len(marks), 2), np.nan), np.full(len(marks), np.nan)
        here, east, north = np.split(transfer(step, before), 3)
        return here, np.maximum(*(np.linalg.norm(there - here, axis=1) for there in (east, north)))


def without_detections(scene: Scene, rows: Bool[np.ndarray, " N"]) -> Scene:
    """Return a scene without the detections in `rows`."""
    if not rows.any():
        return scene
    value = np.zeros(len(rows) + 1, np.uint16)
    value[1:][~rows] = np.arange(1, (~rows).sum() + 1)
    return replace(scene, detections=scene.detections[~rows], mask=value[scene.mask])


def cut_out_landmarks(
    found: Detections,
    mask: np.ndarray,
    vehicles: Bool[np.ndarray, " N"],
    middle_px: Float[np.ndarray, "K 2"],
    radius_px: Float[np.ndarray, " K"],
    least_px: float,
) -> tuple[Detections, np.ndarray]:
    """Remove the discs around vehicles' middles from the detections, and return them with their (H, W) mask.

    vehicles: whether each detection is a landmark. Of these, only parts outside the discs stay, if they are large
    enough; nothing stays if a middle or radius is unknown (NaN). Parts smaller than least_px are dropped, those of
    landmarks if smaller than four times least_px. A target that no disc touches is unchanged.
    """
    known = np.isfinite(middle_px).all(axis=1) & np.isfinite(radius_px)
    outside = mask.copy()
    for (u, v), radius in zip(middle_px[known], radius_px[known], strict=True):
        cv2.circle(outside, (round(float(u)), round(float(v))), max(round(float(radius)), 1), 0, cv2.FILLED)
    rows, boxes, areas = [], [], []
    numbered = np.zeros_like(mask)
    for row, (x, y, width, height) in enumerate(found.box_px.astype(int).tolist()):
        # Boxes of blobs lie within the picture. A vehicle's whole blob is removed if its disc is unknown.
        left, top = max(x, 0), max(y, 0)
        window = np.s_[top : y + height, left : x + width]
        rest, whole = outside[window] == row + 1, mask[window] == row + 1
        if rest.sum() < whole.sum():
            least = max(least_px * (_VEHICLE_REST if vehicles[row] else 1), 1)
            parts = connected_parts(rest, (left, top, width, height), least)
            areas += [float(part.sum()) for _, part in parts]
        else:
            parts = [] if vehicles[row] else [((x, y, width, height), whole)]
            areas += [float(found.area_px[row])] * len(parts)
        for box, part in parts:
            rows.append(row)
            boxes.append(box)
            numbered[max(box[1], 0) : box[1] + box[3], max(box[0], 0) : box[0] + box[2]][part] = len(rows)
    kept = found[np.array(rows, np.int64)]
    unknown = np.full((len(rows), 2), np.nan)
    box_px = np.array(boxes, float).reshape(-1, 4)
    return replace(kept, box_px=box_px, area_px=np.array(areas, float), middle_px=unknown), numbered


def group_crowds(watched: WatchedScene, locator: AerialLocator, rate_hz: float) -> WatchedScene:
    """Return the scene with each crowd as one target; unchanged if crowds are off or the fix is unknown.

    rate_hz: frames a second; speed_px of the detections is in pixels a frame.
    """
    parameters, scene = locator.settings.crowds, watched.scene
    if not parameters.join_m or not len(scene.detections):
        return watched
    found = replace(scene.detections, middle_px=middles_of(scene.detections.box_px, scene.mask, scene.core))
    fix = watched.fixed.fix
    ahead = np.stack([np.cos(found.heading_rad), np.sin(found.heading_rad)], axis=1) * found.speed_px[:, None]
    place, onward = (locator.ground_places(fix, pixels) for pixels in (found.middle_px, found.middle_px + ahead))
    velocity, radius = (onward - place) * rate_hz, locator.ground_radii(fix, found.box_px)
    marks, length_m = locator.landmarks_at(scene.frame.number), locator.settings.landmarks.length_m
    # A detection no larger than a vehicle, at a place that a vehicle reports, is part of the vehicle or its shadow,
    # whether or not its colour is seen.
    away = np.linalg.norm(place[:, None] - marks.east_north_m[None], axis=-1)
    beside = (away <= length_m + 2 * marks.sigma_m).any(axis=1) & (radius <= length_m / 2)
    scene = without_detections(replace(scene, detections=found), beside)
    crowd = group_targets(place[~beside], radius[~beside], velocity[~beside], parameters.join_m, parameters.speed_m_s)
    detections, mask = merge_detections(scene.detections, scene.mask, crowd)
    return replace(watched, scene=replace(scene, detections=detections, mask=mask))


def group_targets(
    place_m: Float[np.ndarray, "N 2"],
    radius_m: Float[np.ndarray, " N"],
    velocity_m_s: Float[np.ndarray, "N 2"],
    join_m: float,
    speed_m_s: float,
) -> Int[np.ndarray, " N"]:
    """Return the crowd of each target, numbered from 0 in the order of the first targets.

    Two targets are in one crowd if the gap between their rims is at most join_m and their velocities differ by at most
    speed_m_s; the relation is transitive. A target of unknown place is alone. An unknown velocity matches every other.
    """
    count = len(place_m)
    apart = np.linalg.norm(place_m[:, None] - place_m[None], axis=-1) - radius_m[:, None] - radius_m[None]
    away = np.linalg.norm(velocity_m_s[:, None] - velocity_m_s[None], axis=-1)
    # Comparisons with NaN are false: an unknown place is near no other, and an unknown velocity differs from no other.
    near = (apart <= join_m) & ~(away > speed_m_s) | np.eye(count, dtype=bool)
    leader = np.arange(count)
    while True:
        lower = np.where(near, leader, count).min(axis=1, initial=count)
        if np.array_equal(lower, leader):
            break
        leader = lower
    return np.unique(leader, return_inverse=True)[1].astype(np.int64)


def merge_detections(
    found: Detections, mask: np.ndarray, crowd: Int[np.ndarray, " N"]
) -> tuple[Detections, np.ndarray]:
    """Return the crowds as detections, and the (H, W) mask with their numbers. crowd: as from `group_targets`.

    The velocity of a crowd is the mean of its targets' velocities, weighted by area; its middle is the mean of their
    foreground, and its class is the most frequent class.
    """
    size = int(crowd.max(initial=-1)) + 1
    area = np.maximum(found.area_px, 1e-9)

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(crowd, values, size)

    low, high, score = np.full((size, 2), np.inf), np.full((size, 2), -np.inf), np.zeros(size)
    np.minimum.at(low, crowd, found.box_px[:, :2])
    np.maximum.at(high, crowd, found.box_px[:, :2] + found.box_px[:, 2:])
    np.maximum.at(score, crowd, found.score)
    with np.errstate(invalid="ignore", divide="ignore"):
        velocity = found.speed_px * np.exp(1j * found.heading_rad)
        known = np.isfinite(velocity)
        weight, velocity = np.where(known, area, 0.0), np.where(known, velocity, 0.0)
        across, down = total(weight * velocity.real) / total(weight), total(weight * velocity.imag) / total(weight)
        middle = np.stack([total(area * found.middle_px[:, k]) / total(area) for k in range(2)], axis=1)
    speed = np.hypot(across, down)
    heading = np.where(speed > 0, np.arctan2(down, across), np.nan)
    box_px = np.c_[low, high - low].reshape(-1, 4)
    number = np.r_[0, crowd + 1].astype(mask.dtype)
    classes = [Counter[tuple[str, int]]() for _ in range(size)]
    for k, label, class_id in zip(crowd.tolist(), found.label.tolist(), found.class_id.tolist(), strict=True):
        classes[k][label, class_id] += 1
    common = [most_common(one) for one in classes]
    label, class_id = np.array([one for one, _ in common], object), np.array([one for _, one in common], np.int64)
    merged = Detections(box_px, score, total(found.area_px), heading, speed, found.kind, middle, label, class_id)
    return merged, number[mask]
