"""What the camera of a ground vehicle sees: sky, ground, what stands on it, people, cars and the other vehicles."""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation.agents import Moment
from torchvision_dddas.simulation.drawing import NEAR_M, Canvas, View, camera_axes, view_from_pose
from torchvision_dddas.simulation.ground_backdrop import HAZE, VISIBILITY_M, Backdrop, BackdropView
from torchvision_dddas.simulation.ground_objects import (
    draw_building,
    draw_plant,
    draw_plants,
    draw_vehicle,
)
from torchvision_dddas.simulation.people_shapes import Figures, Wardrobe, draw_figure, limb_shadows
from torchvision_dddas.simulation.scenario import CameraParameters, Scenario
from torchvision_dddas.simulation.sensor import Sensor
from torchvision_dddas.simulation.sensor_errors import SIGMAS_95
from torchvision_dddas.simulation.vehicle_shapes import car_faces, place_faces, rover_faces, ugv_faces
from torchvision_dddas.simulation.world import World
from torchvision_dddas.types import Bodies, Camera, CameraPose, GroundPicture

SHAKE_RAD = float(np.radians(0.3))  # standard deviation of the camera's pitch and roll about level

HEADING_SIGMA_RAD = float(np.radians(2.0))  # how well a vehicle knows the heading of its camera

_LEAST_SIGMA_M = 0.02
_SENSOR = CameraParameters(sharpness_px=0.7, shot_noise=0.12, read_noise=1.2, drift=0.03, quality=90)
_STREAM = 100  # of the sensors' noise, so that no vehicle shares it with the camera in the air
_SHADE = 0.5  # of the light that is left in a shadow
_SHADED_M = 120.0  # beyond, no shadow is drawn
_LEAST_PX = 2.0  # what is lower in the picture is not drawn
_SLACK_PX = 4.0  # rows by which the ground must be nearer than what it hides


class GroundTruthView(NamedTuple):
    """A picture and its truth. image: (H, W, 3) uint8 BGR. mask: (H, W) uint16, the number of the body seen there.

    number: (N,) of the people before the camera. box_px: (N, 4) x, y, width, height of each as if nothing hid it, also
    beyond the picture. visible: (N,) share of it that the picture shows. view: from where.
    """

    image: np.ndarray
    mask: np.ndarray
    number: np.ndarray
    box_px: np.ndarray
    visible: np.ndarray
    view: View


class GroundCamera:
    """The cameras of the ground vehicles of a scenario, all alike.

    A picture depends on the scenario's seed, the moment and the vehicle alone, not on which others were taken.
    """

    def __init__(self, world: World, scenario: Scenario) -> None:
        self._world, self._scenario = world, scenario
        team = scenario.team
        focal = team.width_px / 2 / np.tan(np.radians(team.hfov_deg) / 2)
        self.size_px = team.width_px, team.height_px
        self.focal_px = float(focal), float(focal)
        self.centre_px = (team.width_px - 1) / 2, (team.height_px - 1) / 2
        self._backdrop = Backdrop(world, scenario.seed)
        self._plants = draw_plants(scenario.seed)
        self._foot_m = world.up_m(world.things.east_north_m) if len(world.things) else np.zeros(0)
        self._wardrobe = Wardrobe(scenario.seed)
        self._sensors: dict[int, Sensor] = {}

    def take(self, moment: Moment, vehicle: int) -> GroundPicture | None:
        """What a vehicle (its row in the team, from 0) sees, with the place and heading that it reports.

        None where the vehicle is silent: nobody would know from where the picture was taken.
        """
        reported = moment.reported_lonlat_deg[vehicle]
        if not np.isfinite(reported).all():
            return None
        name = f"ugv{vehicle + 1}"
        camera = Camera(
            name,
            self.size_px,
            self.focal_px,
            self.centre_px,
            (float(reported[0]), float(reported[1])),
            geographic=True,
            heading_rad=float(np.mod(moment.reported_heading_rad[vehicle], 2 * np.pi)),
            height_m=self._scenario.team.camera_m,
            heading_sigma_rad=HEADING_SIGMA_RAD,
            position_sigma_m=max(self._scenario.gps.error95_m / SIGMAS_95, _LEAST_SIGMA_M),
        )
        image, _, _, _ = self._drawn(moment, vehicle)
        return GroundPicture(name, moment.number, image, camera)

    def look(self, moment: Moment, vehicle: int) -> GroundTruthView:
        """The picture that `take` takes, with the truth: whose body is where, and how much of each it shows."""
        image, mask, view, whole = self._drawn(moment, vehicle)
        number = np.array(sorted(whole), np.int64)
        boxes, shares = np.zeros((len(number), 4)), np.zeros(len(number))
        for row, n in enumerate(number.tolist()):
            boxes[row], area = _extent(whole[n])
            shares[row] = min(np.count_nonzero(mask == n) / max(area, 1), 1)
        return GroundTruthView(image, mask, number, boxes, shares, view)

    def view(self, moment: Moment, vehicle: int) -> View:
        """The true view of a vehicle's camera."""
        own = np.flatnonzero(moment.bodies.kind == "ugv")[vehicle]
        rng = np.random.default_rng([self._scenario.seed, 63, vehicle, moment.number])
        pitch, roll = rng.normal(0, SHAKE_RAD, 2)
        place = moment.bodies.place_m[own] + np.array([0, 0, self._scenario.team.camera_m])
        pose = CameraPose(place, camera_axes(float(moment.heading_rad[vehicle]), pitch, roll))
        return view_from_pose(pose, Camera("", self.size_px, self.focal_px, self.centre_px))

    def _drawn(self, moment: Moment, vehicle: int) -> tuple[np.ndarray, np.ndarray, View, dict[int, np.ndarray]]:
        """Picture, mask, view, and by number the outlines of each person's limbs."""
        view = self.view(moment, vehicle)
        # The ground is looked up while the bodies and their shadows are posed.
        with ThreadPoolExecutor(1) as other:
            canvas, whole = self._draw(
                moment.bodies, vehicle, view, other.submit(self._backdrop.seen, view, self.size_px)
            )
        if vehicle not in self._sensors:
            self._sensors[vehicle] = Sensor(_SENSOR, self.size_px, self._scenario.seed, _STREAM + vehicle)
        image = self._sensors[vehicle].expose(canvas.picture, moment.number, moment.time_s)
        return image, canvas.mask, view, whole

    def _draw(
        self, bodies: Bodies, vehicle: int, view: View, looking: Future[BackdropView]
    ) -> tuple[Canvas, dict[int, np.ndarray]]:
        things, eye = self._world.things, view.position_m
        far = np.hypot(*(things.east_north_m - eye[:2]).T)
        least = _LEAST_PX / self.focal_px[1]
        standing = np.flatnonzero(
            self._before(view, things.east_north_m, 1.2 * things.radius_m, least * far / things.height_m)
        )
        away = np.hypot(*(bodies.place_m[:, :2] - eye[:2]).T)
        reach = np.where(bodies.kind == "person", 3.0, 4.0)  # with the shadow
        moves = self._before(view, bodies.place_m[:, :2], reach, least * away / 1.0)
        moves[np.flatnonzero(bodies.kind == "ugv")[vehicle]] = False
        moving = np.flatnonzero(moves)
        people = moving[bodies.kind[moving] == "person"]
        limbs = self._wardrobe.figures_of(bodies, people)
        row_of = {int(k): row for row, k in enumerate(people)}
        shadows = self._shadows(bodies, moving, limbs, row_of, view, away)

        feet = np.concatenate([np.c_[things.east_north_m[standing], self._foot_m[standing]], bodies.place_m[moving]])
        distance = np.concatenate([far[standing], away[moving]])
        size = np.concatenate(
            [
                np.c_[things.radius_m[standing], things.height_m[standing]],
                np.where((bodies.kind[moving] == "person")[:, None], (1.0, 2.2), (3.0, 2.2)),
            ]
        )
        boxes = self._boxes(feet, size, view)
        backdrop, inverse_m = looking.result()
        canvas = Canvas(backdrop)
        _darken(backdrop, shadows)
        covered, gone = self._behind_ground(boxes, distance, inverse_m)
        whole: dict[int, np.ndarray] = {}
        for n in np.argsort(-distance).tolist():
            mover = n >= len(standing)
            if gone[n] and not mover:
                continue
            part, before = (slice(0), slice(0)), None
            if covered[n]:
                part = _inside(boxes[n], self.size_px)
                before = canvas.picture[part].copy(), canvas.mask[part].copy()
            haze = 1 - float(np.exp(-distance[n] / VISIBILITY_M))
            if not mover:
                self._draw_thing(int(standing[n]), boxes[n], view, canvas, haze)
            else:
                k = int(moving[n - len(standing)])
                value = int(bodies.number[k])
                if bodies.kind[k] == "person":
                    row = row_of[k]
                    colour = limbs.colour[row] + haze * (HAZE - limbs.colour[row])
                    one = limbs.ends_m[row], limbs.radius_m[row], colour
                    whole[value] = draw_figure(*one, view, canvas, value, self._world.to_sun)
                else:
                    faces = car_faces() if bodies.kind[k] == "car" else rover_faces()
                    draw_vehicle(faces, bodies, k, haze, view, canvas, self._world.to_sun)
            if before is not None:
                nearer = inverse_m[part] > 1 / distance[n] + self._slack
                for layer, old in zip((canvas.picture, canvas.mask), before, strict=True):
                    layer[part][nearer] = old[nearer]
        return canvas, whole

    @property
    def _slack(self) -> float:
        """By how much 1 / distance must differ before the ground hides something."""
        return _SLACK_PX / self.focal_px[1] / self._scenario.team.camera_m

    def _boxes(self, feet_m: np.ndarray, size_m: np.ndarray, view: View) -> np.ndarray:
        """(N, 4) left, top, right, bottom, px, of what stands at (N, 3); size_m: (N, 2) half its width, its height."""
        matrix = view.image_from_world
        ends = [feet_m, feet_m + size_m[:, 1:] * (0.0, 0.0, 1.0)]
        foot, top = (end @ matrix[:, :3].T + matrix[:, 3] for end in ends)
        depth = np.maximum(foot[:, 2], NEAR_M)
        half = size_m[:, 0] * self.focal_px[0] / depth
        u, low = foot[:, 0] / depth, foot[:, 1] / depth
        return np.stack([u - half, top[:, 1] / np.maximum(top[:, 2], NEAR_M), u + half, low], axis=1)

    def _before(self, view: View, east_north_m: np.ndarray, reach_m: np.ndarray, small: np.ndarray) -> np.ndarray:
        """(N,) bool, whether objects with a reach reach_m may be in the picture; those with small > 1 are not."""
        offset = east_north_m - view.position_m[:2]
        ahead = view.image_from_world[2, :2]
        right = view.image_from_world[0, :2] / self.focal_px[0] - ahead * (self.centre_px[0] / self.focal_px[0])
        depth = offset @ ahead
        half = self.size_px[0] / 2 / self.focal_px[0]
        return (depth > NEAR_M) & (np.abs(offset @ right) < half * depth + reach_m) & (small < 1)

    def _behind_ground(
        self, boxes_px: np.ndarray, distance_m: np.ndarray, inverse_m: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """(N,) bool each: whether hills hide the feet of something, and whether they hide its top as well."""
        height, width = inverse_m.shape
        u = np.clip(np.round(boxes_px[:, [0, 2]].mean(axis=1)), 0, width - 1).astype(np.int64)
        nearer = []
        for v in (boxes_px[:, 3], boxes_px[:, 1]):
            row = np.round(np.clip(v, -1, height)).astype(np.int64)
            ground = inverse_m[np.clip(row, 0, height - 1), u]
            nearer.append((row >= 0) & (row < height) & (ground > 1 / distance_m + self._slack))
        return nearer[0], nearer[0] & nearer[1]

    def _draw_thing(self, k: int, box_px: np.ndarray, view: View, canvas: Canvas, haze: float) -> None:
        things, sun = self._world.things, self._world.to_sun
        colour = things.colour[k] + haze * (HAZE - things.colour[k])
        if things.kind[k] == "building":
            draw_building(things, k, float(self._foot_m[k]), colour, view, canvas, sun)
            return
        shapes = self._plants[str(things.kind[k])]
        left, top, right, bottom = box_px.tolist()
        # Drawn with the sun on the right.
        ahead = view.image_from_world[2]
        turned = bool(ahead[1] * sun[0] < ahead[0] * sun[1])
        # Its foot is not a line on the ground: some of it is nearer.
        box = left, top, right, bottom + 0.02 * (right - left)
        draw_plant(shapes[k % len(shapes)], canvas, box, colour, turned)

    def _shadows(
        self,
        bodies: Bodies,
        moving: np.ndarray,
        limbs: Figures,
        row_of: dict[int, int],
        view: View,
        away_m: np.ndarray,
    ) -> np.ndarray:
        """(H, W) uint8, 255 where moving bodies cast shadows on the ground."""
        sun, layer = self._world.to_sun, np.zeros(self.size_px[::-1], np.uint8)
        for k in moving[away_m[moving] < _SHADED_M].tolist():
            up = float(bodies.place_m[k, 2])
            if bodies.kind[k] == "person":
                row = row_of[k]
                groups = limb_shadows(limbs.ends_m[row], limbs.radius_m[row], up, sun)
            else:
                faces = car_faces() if bodies.kind[k] == "car" else ugv_faces()
                corners, _ = place_faces(faces, bodies.place_m[k], float(bodies.facing_rad[k]))
                flat = corners[..., :2] - (corners[..., 2:] - up) * sun[:2] / max(float(sun[2]), 0.15)
                groups = np.concatenate([flat, np.full((*flat.shape[:2], 1), up)], axis=2)
            seen = groups @ view.image_from_world[:, :3].T + view.image_from_world[:, 3]
            if (seen[..., 2] < NEAR_M).any():
                continue
            px = np.clip(seen[..., :2] / seen[..., 2:], -3e4, 3e4)
            for outline in list(np.round(px * 16).astype(np.int32)):
                cv2.fillConvexPoly(layer, outline, 255, cv2.LINE_AA, 4)
        return layer


def _darken(image: np.ndarray, layer: np.ndarray) -> None:
    """Darken a picture where a layer (H, W) uint8 says that there is a shadow."""
    rows = np.flatnonzero(layer.any(axis=1))
    if len(rows):
        part = slice(max(int(rows[0]) - 3, 0), int(rows[-1]) + 4)
        soft = 255 - (1 - _SHADE) * cv2.GaussianBlur(layer[part], (0, 0), 0.9)
        image[part] = cv2.multiply(image[part], cv2.merge([soft.astype(np.uint8)] * 3), scale=1 / 255)


def _inside(box_px: np.ndarray, size_px: tuple[int, int]) -> tuple[slice, slice]:
    """Rows and columns of a picture that a box, a little widened, covers."""
    left, top, right, bottom = (int(x) for x in np.clip(box_px, -1e6, 1e6))
    width, height = size_px
    return (
        slice(min(max(top - 4, 0), height), min(max(bottom + 8, 0), height)),
        slice(min(max(left - 4, 0), width), min(max(right + 6, 0), width)),
    )


def _extent(outlines_px: np.ndarray) -> tuple[list[float], float]:
    """Box x, y, width, height and area, px, of limbs' outlines (L, 16, 2)."""
    low, high = outlines_px.min(axis=(0, 1)), outlines_px.max(axis=(0, 1))
    # Counted on a small picture of its own: limbs cover one another.
    scale = 96 / max(float((high - low).max()), 1e-6)
    small = np.zeros((98, 98), np.uint8)
    for outline in np.round((outlines_px - low) * scale * 16).astype(np.int32):
        cv2.fillConvexPoly(small, outline, 1, cv2.LINE_8, 4)
    return [*(low + 0.5).tolist(), *(high - low).tolist()], float(np.count_nonzero(small)) / scale**2
