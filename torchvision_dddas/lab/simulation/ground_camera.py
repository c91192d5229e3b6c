"""Render the camera of a ground vehicle: sky, ground, objects on it, people, cars and other vehicles."""

from concurrent.futures import Future, ThreadPoolExecutor

import cv2
import numpy as np

from torchvision_dddas.lab.simulation.agents import Moment
from torchvision_dddas.lab.simulation.body_shapes import Figures, Wardrobe, limb_capsules, vehicle_faces
from torchvision_dddas.lab.simulation.cameras import PinholeView, camera_axes, view_from_pose
from torchvision_dddas.lab.simulation.ground_backdrop import HAZE, VISIBILITY_M, Backdrop
from torchvision_dddas.lab.simulation.ground_objects import (
    BITS,
    NEAR_M,
    Canvas,
    draw_building,
    draw_figure,
    draw_plant,
    draw_plants,
    draw_vehicle,
    fixed_point,
)
from torchvision_dddas.lab.simulation.scenario import CameraParameters, Scenario
from torchvision_dddas.lab.simulation.sensors import SIGMAS_95, Sensor
from torchvision_dddas.lab.simulation.world import World
from torchvision_dddas.types import Bodies, Camera, CameraPose, GroundPicture

_SHAKE_RAD = float(np.radians(0.3))  # standard deviation of the camera's pitch and roll about level
_HEADING_SIGMA_RAD = float(np.radians(2.0))  # standard deviation of the reported heading of the camera
_LEAST_SIGMA_M = 0.02
_SENSOR = CameraParameters(sharpness_px=0.7, shot_noise=0.12, read_noise=1.2, drift=0.03, quality=90)
_STREAM = 100  # first stream of the sensors' noise, so that no vehicle shares the aerial camera's noise
_SHADE = 0.5  # share of the light that remains in a shadow
_SHADED_M = 120.0  # largest distance at which shadows are drawn
_LEAST_PX = 2.0  # objects with a smaller height in the picture are not drawn
_SLACK_PX = 4.0  # ground hides an object if it is nearer by more than this many rows


class GroundCamera:
    """The identical cameras of the ground vehicles of a scenario.

    A picture depends only on the scenario's seed, the moment and the vehicle, not on other pictures.
    """

    def __init__(self, world: World, scenario: Scenario) -> None:
        self._world, self._scenario, team = world, scenario, scenario.team
        self.focal_px = float(team.width_px / 2 / np.tan(np.radians(team.hfov_deg) / 2))
        self._size_px = team.width_px, team.height_px
        self._centre_px = (team.width_px - 1) / 2, (team.height_px - 1) / 2
        # Difference of 1 / distance above which the ground hides an object.
        self._slack = _SLACK_PX / self.focal_px / team.camera_m
        self._backdrop = Backdrop(world, scenario.seed)
        self._plants = draw_plants(scenario.seed)
        self._foot_m = world.up_m(world.things.east_north_m)
        self._wardrobe = Wardrobe(scenario.seed)
        self._sensors: dict[int, Sensor] = {}

    def take(self, moment: Moment, vehicle: int) -> GroundPicture | None:
        """Return the picture of a vehicle (its row in the team, from 0) with the reported place and heading.

        Return None while the vehicle is silent, because the picture would have no place.
        """
        reported = moment.reported_lonlat_deg[vehicle]
        if not np.isfinite(reported).all():
            return None
        camera = Camera(
            f"ugv{vehicle + 1}",
            self._size_px,
            (self.focal_px, self.focal_px),
            self._centre_px,
            (float(reported[0]), float(reported[1])),
            geographic=True,
            heading_rad=float(np.mod(moment.reported_heading_rad[vehicle], 2 * np.pi)),
            height_m=self._scenario.team.camera_m,
            heading_sigma_rad=_HEADING_SIGMA_RAD,
            position_sigma_m=max(self._scenario.gps.error95_m / SIGMAS_95, _LEAST_SIGMA_M),
        )
        return GroundPicture(camera.name, moment.number, self.look(moment, vehicle)[0], camera)

    def look(self, moment: Moment, vehicle: int) -> tuple[np.ndarray, np.ndarray, PinholeView, dict[int, np.ndarray]]:
        """Return the picture of `take`, (H, W, 3) uint8 BGR, with the truth.

        The truth is the mask (H, W) uint16 of the bodies' numbers, the true view, and {number: outlines (L, 16, 2), px}
        of the limbs of each person in front of the camera, including hidden parts.
        """
        view = self._view(moment, vehicle)
        # Draw the ground in a thread while the bodies and their shadows are posed.
        with ThreadPoolExecutor(1) as other:
            ground = other.submit(self._backdrop.seen, view, self._size_px)
            canvas, whole = self._draw(moment.bodies, vehicle, view, ground)
        if vehicle not in self._sensors:
            self._sensors[vehicle] = Sensor(_SENSOR, self._size_px, self._scenario.seed, _STREAM + vehicle)
        image = self._sensors[vehicle].expose(canvas.picture, moment.number, moment.time_s)
        return image, canvas.mask, view, whole

    def _view(self, moment: Moment, vehicle: int) -> PinholeView:
        """Return the true view of a vehicle's camera."""
        own = np.flatnonzero(moment.bodies.kind == "ugv")[vehicle]
        rng = np.random.default_rng([self._scenario.seed, 63, vehicle, moment.number])
        pitch, roll = rng.normal(0, _SHAKE_RAD, 2)
        place = moment.bodies.place_m[own] + np.array([0, 0, self._scenario.team.camera_m])
        pose = CameraPose(place, camera_axes(float(moment.heading_rad[vehicle]), pitch, roll))
        return view_from_pose(pose, Camera("", self._size_px, (self.focal_px, self.focal_px), self._centre_px))

    def _draw(
        self, bodies: Bodies, vehicle: int, view: PinholeView, ground: Future[tuple[np.ndarray, np.ndarray]]
    ) -> tuple[Canvas, dict[int, np.ndarray]]:
        things, eye, to_sun = self._world.things, view.position_m, self._world.to_sun
        far = np.hypot(*(things.east_north_m - eye[:2]).T)
        away = np.hypot(*(bodies.place_m[:, :2] - eye[:2]).T)
        least, is_person = _LEAST_PX / self.focal_px, bodies.kind == "person"
        small = least * far / things.height_m
        standing = np.flatnonzero(self._may_show(view, things.east_north_m, 1.2 * things.radius_m, small))
        reach = np.where(is_person, 3.0, 4.0)  # including the shadow
        moves = self._may_show(view, bodies.place_m[:, :2], reach, least * away)
        moves[np.flatnonzero(bodies.kind == "ugv")[vehicle]] = False
        moving = np.flatnonzero(moves)
        people = moving[is_person[moving]]
        limbs = self._wardrobe.figures(bodies, people)
        row_of = {int(k): row for row, k in enumerate(people)}
        shadows = self._shadows(bodies, moving[away[moving] < _SHADED_M], limbs, row_of, view)

        feet = np.concatenate([np.c_[things.east_north_m[standing], self._foot_m[standing]], bodies.place_m[moving]])
        distance = np.concatenate([far[standing], away[moving]])
        size = np.c_[things.radius_m[standing], things.height_m[standing]]
        size = np.concatenate([size, np.where(is_person[moving, None], (1.0, 2.2), (3.0, 2.2))])
        boxes = self._boxes(feet, size, view)
        backdrop, inverse_m = ground.result()
        canvas = Canvas(backdrop)
        _darken(backdrop, shadows)
        is_covered, is_gone = self._behind_ground(boxes, distance, inverse_m)
        whole: dict[int, np.ndarray] = {}
        for n in np.argsort(-distance).tolist():
            is_mover = n >= len(standing)
            if is_gone[n] and not is_mover:
                continue
            part, before = (slice(0), slice(0)), None
            if is_covered[n]:
                part = self._part(boxes[n])
                before = canvas.picture[part].copy(), canvas.mask[part].copy()
            haze = 1 - float(np.exp(-distance[n] / VISIBILITY_M))
            if not is_mover:
                self._draw_thing(int(standing[n]), boxes[n], view, canvas, haze)
            elif is_person[k := int(moving[n - len(standing)])]:
                row, value = row_of[k], int(bodies.number[k])
                colour = limbs.colour[row] + haze * (HAZE - limbs.colour[row])
                whole[value] = draw_figure(limbs.ends_m[row], limbs.radius_m[row], colour, view, canvas, value, to_sun)
            else:
                draw_vehicle(bodies, k, haze, view, canvas, to_sun)
            if before is not None:
                nearer = inverse_m[part] > 1 / distance[n] + self._slack
                for layer, old in zip((canvas.picture, canvas.mask), before, strict=True):
                    layer[part][nearer] = old[nearer]
        return canvas, whole

    def _boxes(self, feet_m: np.ndarray, size_m: np.ndarray, view: PinholeView) -> np.ndarray:
        """Return boxes (N, 4) left, top, right, bottom, px, of objects at (N, 3). size_m: (N, 2) half width, height."""
        foot, top = (view.homogeneous(feet_m + size_m[:, 1:] * (0.0, 0.0, share)) for share in (0.0, 1.0))
        depth = np.maximum(foot[:, 2], NEAR_M)
        half = size_m[:, 0] * self.focal_px / depth
        u, low = foot[:, 0] / depth, foot[:, 1] / depth
        return np.stack([u - half, top[:, 1] / np.maximum(top[:, 2], NEAR_M), u + half, low], axis=1)

    def _may_show(
        self, view: PinholeView, east_north_m: np.ndarray, reach_m: np.ndarray, small: np.ndarray
    ) -> np.ndarray:
        """Return (N,) bool, whether objects of radius reach_m may be visible. Objects with small >= 1 are not."""
        offset, matrix = east_north_m - view.position_m[:2], view.image_from_world
        ahead = matrix[2, :2]
        right = matrix[0, :2] / self.focal_px - ahead * (self._centre_px[0] / self.focal_px)
        depth = offset @ ahead
        half = self._size_px[0] / 2 / self.focal_px
        return (depth > NEAR_M) & (np.abs(offset @ right) < half * depth + reach_m) & (small < 1)

    def _behind_ground(
        self, boxes_px: np.ndarray, distance_m: np.ndarray, inverse_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return (N,) bool whether hills hide the feet of each object, and (N,) bool whether they hide its top too."""
        height, width = inverse_m.shape
        u = np.clip(np.round(boxes_px[:, [0, 2]].mean(axis=1)), 0, width - 1).astype(np.int64)
        nearer = []
        for v in (boxes_px[:, 3], boxes_px[:, 1]):
            row = np.round(np.clip(v, -1, height)).astype(np.int64)
            ground = inverse_m[np.clip(row, 0, height - 1), u]
            nearer.append((row >= 0) & (row < height) & (ground > 1 / distance_m + self._slack))
        return nearer[0], nearer[0] & nearer[1]

    def _part(self, box_px: np.ndarray) -> tuple[slice, slice]:
        """Return the rows and columns of the picture that a slightly widened box covers."""
        left, top, right, bottom = (int(x) for x in np.clip(box_px, -1e6, 1e6))
        rows = np.clip((top - 4, bottom + 8), 0, self._size_px[1]).tolist()
        columns = np.clip((left - 4, right + 6), 0, self._size_px[0]).tolist()
        return slice(*rows), slice(*columns)

    def _draw_thing(self, k: int, box_px: np.ndarray, view: PinholeView, canvas: Canvas, haze: float) -> None:
        things, sun = self._world.things, self._world.to_sun
        colour = things.colour[k] + haze * (HAZE - things.colour[k])
        if things.kind[k] == "building":
            draw_building(things, k, float(self._foot_m[k]), colour, view, canvas, sun)
            return
        shapes = self._plants[str(things.kind[k])]
        left, top, right, bottom = box_px.tolist()
        # The stored plants are lit from the right.
        ahead = view.image_from_world[2]
        is_turned = bool(ahead[1] * sun[0] < ahead[0] * sun[1])
        # Extend the foot downwards, because a part of the plant stands nearer than its middle.
        box = left, top, right, bottom + 0.02 * (right - left)
        draw_plant(shapes[k % len(shapes)], canvas, box, colour, is_turned)

    def _shadows(
        self, bodies: Bodies, rows: np.ndarray, limbs: Figures, row_of: dict[int, int], view: PinholeView
    ) -> np.ndarray:
        """Return (H, W) uint8, 255 where bodies cast shadows on the ground."""
        layer, sun = np.zeros(self._size_px[::-1], np.uint8), self._world.to_sun
        for k in rows.tolist():
            up, sink = float(bodies.place_m[k, 2]), max(float(sun[2]), 0.15)
            if (row := row_of.get(k)) is not None:
                worn = np.isfinite(limbs.radius_m[row]).all(axis=1)
                ends = limbs.ends_m[row][worn]
                flat = ends[..., :2] + (ends[..., 2:] - up) * (-sun[:2] / sink)
                flat = limb_capsules(flat, limbs.radius_m[row][worn])
            else:
                corners, _, _ = vehicle_faces(str(bodies.kind[k])).placed(bodies, k)
                flat = corners[..., :2] - (corners[..., 2:] - up) * sun[:2] / sink
            outlines = np.concatenate([flat, np.full((*flat.shape[:2], 1), up)], axis=2)
            if (view.homogeneous(outlines)[..., 2] >= NEAR_M).all():
                for outline in fixed_point(view.project(outlines)):
                    cv2.fillConvexPoly(layer, outline, 255, cv2.LINE_AA, BITS)
        return layer


def _darken(image: np.ndarray, layer: np.ndarray) -> None:
    """Darken a picture in place by a shadow layer (H, W) uint8."""
    rows = np.flatnonzero(layer.any(axis=1))
    if len(rows):
        part = slice(max(int(rows[0]) - 3, 0), int(rows[-1]) + 4)
        soft = 255 - (1 - _SHADE) * cv2.GaussianBlur(layer[part], (0, 0), 0.9)
        image[part] = cv2.multiply(image[part], cv2.merge([soft.astype(np.uint8)] * 3), scale=1 / 255)
