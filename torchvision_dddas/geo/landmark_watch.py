"""Landmarks in the pictures of a clip."""

import time
from dataclasses import dataclass, replace

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.geo.aerial_locator import AerialLocator, FrameFix
from torchvision_dddas.geo.colours import ColourFinder
from torchvision_dddas.geo.landmark_tracking import LandmarkTracker, TrackedLandmarks
from torchvision_dddas.geo.plane_homography import LEAST
from torchvision_dddas.geo.projection import distort_pixels, project
from torchvision_dddas.geometry import connected_parts, middles_of, transfer
from torchvision_dddas.types import Bool, Colours, Detections, Fix, Float, Int, LandmarkObservations, Landmarks, Scene

# A vehicle reaches this far from its colour, in its lengths: its corners, and its shadow.
_REACH = 0.75
# What is left of a blob beside a vehicle is a target from this area on: a person with a shadow.
_LEAST_M2 = 0.4
# What is left of a vehicle's own blob must be this many times larger: as a rule it is the vehicle's shadow.
_VEHICLE_REST = 4


@dataclass(frozen=True)
class WatchedScene:
    """A scene without the landmarks, its fix, and by what each landmark was found: motion, colour or table."""

    scene: Scene
    fixed: FrameFix
    sighted_by: tuple[str, ...]


def without_pixels(landmarks: Landmarks) -> Landmarks:
    """The landmarks without their pixels in the table, for search by colour."""
    return replace(landmarks, image_px=np.full_like(landmarks.image_px, np.nan))


def check_colours(landmarks: Landmarks, colours: Colours | None, helped: bool) -> None:
    """Raises InputError where the landmarks and colours cannot locate any picture.

    helped: whether telemetry says where the camera is.
    """
    if colours is None:
        if not np.isfinite(landmarks.image_px).all(axis=1).any():
            raise InputError(
                f"landmarks {landmarks.path} say no places in pictures (u_px,v_px); give --colours FILE, the colours "
                "that they wear, as `dddas colours` writes it"
            )
        return
    if strange := [name for name in colours.names if name not in landmarks.names]:
        raise InputError(
            f"the colours name {', '.join(strange)}, the landmarks {landmarks.path} {', '.join(landmarks.names)}; "
            "wanted the same names in both"
        )
    if len(colours) < LEAST and not helped:
        raise InputError(
            f"locating needs {LEAST} landmarks; colours are given for {len(colours)}: {LEAST - len(colours)} missing. "
            "Give --telemetry, or more landmarks"
        )


class LandmarkWatch:
    """Locates the scenes of a clip in order, and removes landmarks from their targets."""

    def __init__(self, locator: AerialLocator, colours: Colours | None, finder: ColourFinder | None) -> None:
        """colours, finder: None where the table of landmarks gives their pixels."""
        self.locator, self._colours, self._finder = locator, colours, finder
        names = locator.site.landmarks.names
        self._which = np.array([names.index(name) for name in colours.names], np.int64) if colours else np.zeros(0, int)
        self._tracker = LandmarkTracker(len(colours), locator.settings.landmarks) if colours else None
        self._fix: Fix | None = None

    def restarted(self) -> "LandmarkWatch":
        """The same watch as before its first scene."""
        return LandmarkWatch(self.locator.restarted(), self._colours, self._finder)

    def update(self, scene: Scene) -> WatchedScene:
        """The next scene, without its landmarks, and its fix."""
        start = time.perf_counter()
        frame = scene.frame.number
        marks = self.locator.landmarks_at(frame)
        if self._tracker is not None:
            marks, scene, by = self._found(scene, marks)
        else:
            by = ("table",) * len(marks)
            scene = without_detections(scene, _holding(scene.detections.box_px, marks.image_px))
        spent = time.perf_counter() - start
        fixed = self.locator.fix_frame(frame, marks)
        self._fix = fixed.fix
        used = dict(zip(marks.landmark.tolist(), by, strict=True))
        return WatchedScene(
            scene,
            replace(fixed, seconds={"landmarks": spent, **fixed.seconds}),
            tuple(used[which] for which in fixed.marks.landmark.tolist()),
        )

    def _found(self, scene: Scene, marks: LandmarkObservations) -> tuple[LandmarkObservations, Scene, tuple[str, ...]]:
        """The landmarks with their pixels, the scene without them, and by what each was found."""
        assert self._tracker is not None
        assert self._finder is not None
        assert self._colours is not None
        image = scene.frame.image
        if image.ndim == 2:
            raise InputError("the clip is grey: landmarks cannot be told by colour; give u_px,v_px in the landmarks")
        step = scene.camera_motion
        place = {which: k for k, which in enumerate(self._which.tolist())}
        expected, length = np.full((len(self._colours), 2), np.nan), np.full(len(self._colours), np.nan)
        pixels, scale = self._expected(marks, step)
        for row, which in enumerate(marks.landmark.tolist()):
            if which in place:
                expected[place[which]] = pixels[row]
                length[place[which]] = self.locator.settings.landmarks.length_m * scale[row]
        masks = self._finder(image, self._colours.low, self._colours.high)
        seen = self._tracker.update(scene.frame.number, masks, scene.detections, step, scene.mask, expected, length)
        pixels = np.full((len(marks), 2), np.nan)
        by = [""] * len(marks)
        for row, which in enumerate(marks.landmark.tolist()):
            if which in place:
                k = place[which]
                pixels[row], by[row] = seen.image_px[k], seen.by[k]
                if by[row] == "motion" and _astray(pixels[row], seen.colour_px[k], expected[k], marks.pixel_sigma[row]):
                    pixels[row], by[row] = seen.colour_px[k], "colour"
        marks = self._from_bodies(replace(marks, image_px=pixels), np.array([how == "motion" for how in by], bool))
        return marks, self._cut(scene, seen, length), tuple(by)

    def _from_bodies(self, marks: LandmarkObservations, moving: np.ndarray) -> LandmarkObservations:
        """Move pixels of blobs, which include shadows, to the vehicle's feet; colours stay at height_m."""
        height = self.locator.settings.landmarks.height_m
        if not height or not moving.any():
            return marks
        up_m, pixels = marks.up_m.copy(), marks.image_px.copy()
        feet = None if self._fix is None else self.locator.feet_px(pixels[moving], self._fix, height)
        up_m[moving] -= height / 2 if feet is None else height
        if feet is not None:
            pixels[moving] = feet
        return replace(marks, up_m=up_m, image_px=pixels)

    def _cut(self, scene: Scene, seen: TrackedLandmarks, length_px: np.ndarray) -> Scene:
        """The scene without the landmarks' own blobs, and without their part of shared ones."""
        parameters = self.locator.settings.landmarks
        if scene.mask.shape != scene.frame.image.shape[:2] or not len(scene.detections):
            return without_detections(scene, seen.rows)
        metre = np.nanmedian(length_px) / parameters.length_m if np.isfinite(length_px).any() else np.nan
        least = max(self.locator.settings.small.min_area_px, _LEAST_M2 * metre**2) if np.isfinite(metre) else np.inf
        found, mask = cut_out_landmarks(
            scene.detections, scene.mask, seen.rows, seen.colour_px, _REACH * length_px, least
        )
        return replace(scene, detections=found, mask=mask)

    def _expected(self, marks: LandmarkObservations, step: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
        """(n, 2) where the landmarks should be, by how the frame before lay on the ground, and (n,) pixels a metre.

        NaN where unknown.
        """
        fix, n = self._fix, len(marks)
        if fix is None or step is None or (fix.pose is None and fix.image_from_ground is None):
            return np.full((n, 2), np.nan), np.full(n, np.nan)
        beside = np.concatenate([marks.east_north_m + metre for metre in ((0, 0), (1, 0), (0, 1))])
        if fix.pose is not None:
            before = project(np.c_[beside, np.tile(marks.up_m, 3)], fix.pose, self.locator.camera)
        else:
            assert fix.image_from_ground is not None
            before = transfer(fix.image_from_ground, beside)
            before = before if fix.by == "paper" else distort_pixels(before, self.locator.camera)
        here, east, north = np.split(transfer(step, before), 3)
        return here, np.maximum(*(np.linalg.norm(there - here, axis=1) for there in (east, north)))


def _astray(
    blob_px: np.ndarray, colour_px: np.ndarray, expected_px: np.ndarray, sigma_px: float, least_sigmas: float = 3.0
) -> bool:
    """Whether a landmark's colour is clearly nearer to where the landmark is expected than the centre of its blob.

    Of a vehicle that is slow in the picture often a part alone is seen to move, and its centre is not the vehicle's.
    """
    blob, colour = (float(np.linalg.norm(at - expected_px)) for at in (blob_px, colour_px))
    return blob > least_sigmas * sigma_px and colour < 0.5 * blob


def _holding(box_px: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """(N,) bool, whether a box is the smallest that holds one of the points."""
    held = np.zeros(len(box_px), bool)
    for point in points_px[np.isfinite(points_px).all(axis=1)]:
        inside = ((point >= box_px[:, :2] - 0.5) & (point <= box_px[:, :2] + box_px[:, 2:] - 0.5)).all(axis=1)
        if inside.any():
            held[np.where(inside, box_px[:, 2] * box_px[:, 3], np.inf).argmin()] = True
    return held


def without_detections(scene: Scene, rows: np.ndarray) -> Scene:
    """A scene without some of its detections. rows: (N,) bool."""
    if not rows.any():
        return scene
    kept = ~rows
    value = np.zeros(len(rows) + 1, np.uint16)
    value[1:][kept] = np.arange(1, kept.sum() + 1)
    return replace(scene, detections=scene.detections[kept], mask=value[scene.mask])


def cut_out_landmarks(
    found: Detections,
    mask: np.ndarray,
    vehicles: Bool[np.ndarray, " N"],
    middle_px: Float[np.ndarray, "K 2"],
    radius_px: Float[np.ndarray, " K"],
    least_px: float,
) -> tuple[Detections, np.ndarray]:
    """The detections without the discs about vehicles' middles, and the (H, W) mask of them.

    vehicles: which of them are landmarks: of these stays what is left outside the discs, if it is large enough; where a
    middle or radius is unknown (NaN), nothing. Parts smaller than least_px go, of landmarks those four times as large.
    A target that no disc touches stays as it is.
    """
    known = np.isfinite(middle_px).all(axis=1) & np.isfinite(radius_px)
    outside = mask.copy()
    for (u, v), radius in zip(middle_px[known], radius_px[known], strict=True):
        cv2.circle(outside, (round(float(u)), round(float(v))), max(round(float(radius)), 1), 0, cv2.FILLED)
    rows, boxes, areas = [], [], []
    numbered = np.zeros_like(mask)
    for row in range(len(found)):
        x, y, width, height = (int(side) for side in found.box_px[row])
        # Boxes of blobs lie within the picture; a vehicle that no disc is known for goes whole.
        window = np.s_[max(y, 0) : y + height, max(x, 0) : x + width]
        left, whole = outside[window] == row + 1, mask[window] == row + 1
        touched = left.sum() < whole.sum()
        if vehicles[row] and not touched:
            continue
        # What a vehicle's own blob leaves outside is as a rule its shadow.
        least = max(least_px * (_VEHICLE_REST if vehicles[row] else 1), 1)
        parts = connected_parts(left, (max(x, 0), max(y, 0), width, height), least) if touched else []
        if not touched:
            parts = [((x, y, width, height), whole)]
        for box, part in parts:
            rows.append(row)
            boxes.append(box)
            areas.append(float(part.sum()) if touched else float(found.area_px[row]))
            there = numbered[max(box[1], 0) : box[1] + box[3], max(box[0], 0) : box[0] + box[2]]
            there[part] = len(rows)
    kept = np.array(rows, np.int64)
    left_over = Detections(
        np.array(boxes, float).reshape(-1, 4),
        found.score[kept],
        np.array(areas, float),
        found.heading_rad[kept],
        found.speed_px[kept],
        found.kind,
    )
    return left_over, numbered


def group_crowds(watched: WatchedScene, locator: AerialLocator, rate_hz: float) -> WatchedScene:
    """The scene with each crowd as one target; unchanged where crowds are switched off or the fix is unknown.

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
    # What is no larger than a vehicle and lies where one reports to be is part of it or its shadow, whether or not its
    # colour is seen.
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
    """The crowd of each target, numbered from 0 in the order of the first targets.

    Two targets are in one crowd if the gap between their rims is at most join_m and their velocities differ by at most
    speed_m_s; the relation is transitive. A target of unknown place is alone. An unknown velocity differs from none.
    """
    count = len(place_m)
    apart = np.linalg.norm(place_m[:, None] - place_m[None], axis=-1) - radius_m[:, None] - radius_m[None]
    away = np.linalg.norm(velocity_m_s[:, None] - velocity_m_s[None], axis=-1)
    # NaN compares as false: an unknown place is near none, an unknown velocity differs from none.
    near = (apart <= join_m) & ~(away > speed_m_s) | np.eye(count, dtype=bool)
    leader = np.arange(count)
    while True:
        lower = np.array([leader[row].min() for row in near], np.int64)
        if (lower == leader).all():
            return np.unique(leader, return_inverse=True)[1].astype(np.int64)
        leader = lower


def merge_detections(
    found: Detections, mask: np.ndarray, crowd: Int[np.ndarray, " N"]
) -> tuple[Detections, np.ndarray]:
    """The crowds as detections, and the (H, W) mask with their numbers. crowd: as by `group_targets`.

    The velocity of a crowd is the mean of its parts', weighed by area; its middle is the mean of their foreground.
    """
    size = int(crowd.max(initial=-1)) + 1
    area = np.maximum(found.area_px, 1e-9)

    def total(values: np.ndarray) -> np.ndarray:
        return np.bincount(crowd, values, size)

    low, high = np.full((size, 2), np.inf), np.full((size, 2), -np.inf)
    np.minimum.at(low, crowd, found.box_px[:, :2])
    np.maximum.at(high, crowd, found.box_px[:, :2] + found.box_px[:, 2:])
    score = np.zeros(size)
    np.maximum.at(score, crowd, found.score)
    known = np.isfinite(found.speed_px) & np.isfinite(found.heading_rad)
    weight = np.where(known, area, 0.0)
    speed, heading = np.where(known, found.speed_px, 0.0), np.where(known, found.heading_rad, 0.0)
    with np.errstate(invalid="ignore", divide="ignore"):
        across = total(weight * speed * np.cos(heading)) / total(weight)
        down = total(weight * speed * np.sin(heading)) / total(weight)
        middle = np.stack([total(area * found.middle_px[:, k]) / total(area) for k in range(2)], axis=1)
    number = np.zeros(len(crowd) + 1, mask.dtype)
    number[1:] = crowd + 1
    crowds = Detections(
        np.c_[low, high - low].reshape(-1, 4),
        score,
        total(found.area_px),
        np.where(np.hypot(across, down) > 0, np.arctan2(down, across), np.nan),
        np.hypot(across, down),
        found.kind,
        middle,
    )
    return crowds, number[mask]
