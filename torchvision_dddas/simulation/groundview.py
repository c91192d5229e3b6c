"""What the camera of a ground vehicle sees: sky, ground, what stands on it, people, cars and the other vehicles."""

from typing import TYPE_CHECKING, NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation.backdrop import HAZE, VISIBILITY_M, Backdrop
from torchvision_dddas.simulation.billboards import NEAR_M, draw_box, draw_plant, plants
from torchvision_dddas.simulation.bodies import Body, Canvas, draw
from torchvision_dddas.simulation.camera import View, axes, view_of
from torchvision_dddas.simulation.figures import Dress, Parts, draw_parts, dress, outlines, person
from torchvision_dddas.simulation.moment import Moment
from torchvision_dddas.simulation.scenario import Scenario
from torchvision_dddas.types import Bodies, Camera, CameraPose, GroundPicture

if TYPE_CHECKING:
    from torchvision_dddas.simulation.world import World

SHAKE_RAD = float(np.radians(0.3))
"""Standard deviation of the camera's pitch and roll about level."""

HEADING_SIGMA_RAD = float(np.radians(2.0))
_LEAST_SIGMA_M = 0.02
_SHADE = 0.55  # of the light that is left in a shadow
_LEAST_PX = 1.5  # what is lower in the picture is not drawn


class Sight(NamedTuple):
    """A picture and its truth. image: (H, W, 3) uint8 BGR. mask: (H, W) uint16, the number of the body seen there.

    number: (N,) of the people before the camera. box_px: (N, 4) x, y, width, height of each whole, hidden or not, and
    beyond the picture. visible: (N,) share of it that the picture shows. view: from where.
    """

    image: np.ndarray
    mask: np.ndarray
    number: np.ndarray
    box_px: np.ndarray
    visible: np.ndarray
    view: View


class GroundCamera:
    """The cameras of the ground vehicles of a scenario, all alike."""

    def __init__(self, world: "World", scenario: Scenario) -> None:
        self._world, self._scenario = world, scenario
        team = scenario.team
        focal = team.width_px / 2 / np.tan(np.radians(team.hfov_deg) / 2)
        self.size_px = team.width_px, team.height_px
        self.focal_px = float(focal), float(focal)
        self.centre_px = (team.width_px - 1) / 2, (team.height_px - 1) / 2
        self._backdrop = Backdrop(world, scenario.seed)
        self._plants = plants(scenario.seed)
        self._dress: dict[int, Dress] = {}

    def take(self, moment: Moment, vehicle: int) -> GroundPicture | None:
        """What a vehicle (its row in the team, from 0) sees, with the place and heading that it reports.

        None where the vehicle is silent: nobody would know from where the picture was taken.
        """
        said = moment.said_lonlat_deg[vehicle]
        if not np.isfinite(said).all():
            return None
        name = f"ugv{vehicle + 1}"
        camera = Camera(
            name,
            self.size_px,
            self.focal_px,
            self.centre_px,
            (float(said[0]), float(said[1])),
            geographic=True,
            heading_rad=float(np.mod(moment.said_heading_rad[vehicle], 2 * np.pi)),
            height_m=self._scenario.team.camera_m,
            heading_sigma_rad=HEADING_SIGMA_RAD,
            position_sigma_m=max(self._scenario.gps.error95_m / 2.4477, _LEAST_SIGMA_M),
        )
        return GroundPicture(name, moment.number, self.look(moment, vehicle).image, camera)

    def look(self, moment: Moment, vehicle: int) -> Sight:
        """What a vehicle sees, with the truth: whose body is where in the picture, and how much of each it shows."""
        bodies, own = moment.bodies, np.flatnonzero(moment.bodies.kind == "ugv")[vehicle]
        rng = np.random.default_rng([self._scenario.seed, 63, vehicle, moment.number])
        pitch, roll = rng.normal(0, SHAKE_RAD, 2)
        place = bodies.place_m[own] + np.array([0, 0, self._scenario.team.camera_m])
        pose = CameraPose(place, axes(float(moment.heading_rad[vehicle]), pitch, roll))
        view = view_of(pose, Camera("", self.size_px, self.focal_px, self.centre_px))
        seen = self._backdrop.seen(view, self.size_px)
        self._shade(bodies, own, view, seen.image)
        canvas = Canvas(np.clip(seen.image, 0, 255).astype(np.uint8))
        people = self._draw(bodies, own, view, canvas)
        image = _exposed(canvas.picture, rng)
        number, boxes, whole = people
        shown = np.array([np.count_nonzero(canvas.mask == n) for n in number], float)
        return Sight(image, canvas.mask, number, boxes, np.minimum(shown / np.maximum(whole, 1), 1), view)

    def _ahead(self, view: View, east_north_m: np.ndarray, reach_m: np.ndarray | float) -> np.ndarray:
        """(N,) whether something so far about a place may be in the picture."""
        offset = east_north_m - view.position_m[:2]
        forward, right = view.image_from_world[2, :2], view.image_from_world[0, :2]
        depth = offset @ forward
        aside = offset @ (right - self.centre_px[0] * forward) / self.focal_px[0]
        half = self.size_px[0] / 2 / self.focal_px[0]
        return (depth > NEAR_M) & (np.abs(aside) < half * depth + 1.2 * reach_m)

    def _draw(self, bodies: Bodies, own: int, view: View, canvas: Canvas) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """All that stands, far things first. The number, whole box and whole area of each person before the camera."""
        things, eye = self._world.things, view.position_m
        far = np.hypot(*(things.east_north_m - eye[:2]).T)
        least_m = _LEAST_PX / self.focal_px[1]
        rows = np.flatnonzero(
            self._ahead(view, things.east_north_m, things.radius_m) & (things.height_m > least_m * far)
        )
        away = np.hypot(*(bodies.place_m[:, :2] - eye[:2]).T)
        movers = self._ahead(view, bodies.place_m[:, :2], np.where(bodies.kind == "person", 0.6, 2.5))
        movers &= least_m * away < 1.0
        movers[own] = False
        moving = np.flatnonzero(movers)
        foot = self._world.up_m(things.east_north_m[rows]) if len(rows) else np.zeros(0)
        order = [(far[k], False, n, k) for n, k in enumerate(rows)] + [(away[k], True, 0, k) for k in moving]
        found = []
        for distance, moves, n, k in sorted(order, reverse=True):
            clear = float(np.exp(-distance / VISIBILITY_M))
            if not moves:
                self._draw_thing(int(k), float(foot[n]), float(distance), view, canvas, clear)
            elif bodies.kind[k] == "person":
                parts = self._limbs(bodies, int(k), clear)
                draw_parts(parts, view, canvas, int(bodies.number[k]), self._world.to_sun)
                found.append((int(bodies.number[k]), *_whole(parts, view)))
            else:
                self._draw_vehicle(bodies, int(k), view, canvas, clear)
        found.sort()
        return (
            np.array([row[0] for row in found], np.int64),
            np.array([row[1] for row in found], float).reshape(-1, 4),
            np.array([row[2] for row in found], float),
        )

    def _limbs(self, bodies: Bodies, k: int, clear: float = 1.0) -> Parts:
        number = int(bodies.number[k])
        if number not in self._dress:
            self._dress[number] = dress(bodies.colour[k], self._scenario.seed, number)
        speed = float(np.linalg.norm(bodies.velocity_m_s[k]))
        parts = person(
            bodies.place_m[k],
            float(bodies.facing_rad[k]),
            float(bodies.height_m[k]),
            speed,
            float(bodies.phase[k]),
            self._dress[number],
        )
        return parts._replace(colour=parts.colour * clear + HAZE * (1 - clear))

    def _draw_thing(self, k: int, foot_m: float, far_m: float, view: View, canvas: Canvas, clear: float) -> None:
        things = self._world.things
        colour = things.colour[k] * clear + HAZE * (1 - clear)
        east, north = things.east_north_m[k]
        if things.kind[k] == "building":
            along = np.array([np.sin(things.heading_rad[k]), np.cos(things.heading_rad[k])])
            across = np.array([along[1], -along[0]])
            corners = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) * things.half_m[k]
            outline = things.east_north_m[k] + corners @ np.stack([along, across])
            # Counter-clockwise, seen from above.
            outline = outline[::-1]
            draw_box(
                outline, foot_m - 0.5, foot_m + float(things.height_m[k]), colour, view, canvas, self._world.to_sun
            )
            return
        low, high = view.project(np.array([[east, north, foot_m], [east, north, foot_m + things.height_m[k]]]))
        half = float(things.radius_m[k]) * view.pixels_per_metre(np.array([east, north, foot_m]))
        shapes = self._plants[str(things.kind[k])]
        plant = shapes[k % len(shapes)]
        box = float(low[0]) - half, float(high[1]), float(low[0]) + half, float(low[1]) + 0.02 * half
        draw_plant(plant, canvas, box, colour)

    def _draw_vehicle(self, bodies: Bodies, k: int, view: View, canvas: Canvas, clear: float) -> None:
        place, value = bodies.place_m[k], int(bodies.number[k])
        if bodies.kind[k] == "car":
            depth = view.image_from_world[2] @ np.append(place, 1.0)
            if depth < 3.5:
                return
            # A car stands on its own ground: the view is sunk by as much.
            shift = np.eye(4)
            shift[2, 3] = place[2]
            lowered = View(view.image_from_world @ shift, view.position_m - [0, 0, place[2]])
            facing = float(np.pi / 2 - bodies.facing_rad[k])
            colour = tuple(float(c) for c in bodies.colour[k] * clear + HAZE * (1 - clear))
            draw(Body("car", place[:2], np.zeros(2), colour, facing), 0.0, lowered, canvas, value)
            return
        sun = self._world.to_sun
        ahead = np.array([np.sin(bodies.facing_rad[k]), np.cos(bodies.facing_rad[k])])
        left = np.array([-ahead[1], ahead[0]])

        def box(half_long: float, half_wide: float, low: float, high: float, colour: np.ndarray, aside: float) -> None:
            corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * (half_long, half_wide)
            outline = place[:2] + aside * left + corners @ np.stack([ahead, left])
            draw_box(outline, place[2] + low, place[2] + high, colour * clear + HAZE * (1 - clear), view, canvas, sun)

        dark = np.array([40.0, 40, 42])
        near = np.sign(float((view.position_m - place)[:2] @ left)) or 1.0
        plate = bodies.plate[k] if np.isfinite(bodies.plate[k]).all() and not bodies.hidden[k] else dark * 2
        box(0.7, 0.1, 0.0, 0.42, dark, -0.4 * near)
        box(0.62, 0.34, 0.16, 0.6, np.asarray(bodies.colour[k], float), 0.0)
        box(0.7, 0.1, 0.0, 0.42, dark, 0.4 * near)
        box(0.06, 0.06, 0.6, 1.15, dark * 1.6, 0.0)
        box(0.5, 0.5, 1.15, 1.2, plate, 0.0)

    def _shade(self, bodies: Bodies, own: int, view: View, image: np.ndarray) -> None:
        """The shadows that moving bodies cast on the ground."""
        sun = self._world.to_sun
        reach = -sun[:2] / max(float(sun[2]), 0.15)
        layer = np.zeros(image.shape[:2], np.uint8)
        for k in np.flatnonzero(self._ahead(view, bodies.place_m[:, :2], 3.0)):
            place = bodies.place_m[k]
            if k == own or np.hypot(*(place - view.position_m)[:2]) > 120:
                continue
            if bodies.kind[k] == "person":
                parts = self._limbs(bodies, int(k))
                ends = np.stack([parts.start_m, parts.end_m], axis=1)
                radius = np.stack([parts.start_radius_m, parts.end_radius_m], axis=1)
                around = np.array(
                    [[1, 0], [0.7, 0.7], [0, 1], [-0.7, 0.7], [-1, 0], [-0.7, -0.7], [0, -1], [0.7, -0.7]]
                )
                flat = ends[..., :2] + (ends[..., 2:] - place[2]) * reach
                points = flat[:, :, None] + radius[:, :, None, None] * around
                groups = points.reshape(len(points), -1, 2)
            else:
                half = (2.1, 0.85, 1.3) if bodies.kind[k] == "car" else (0.7, 0.5, 0.8)
                ahead = np.array([np.sin(bodies.facing_rad[k]), np.cos(bodies.facing_rad[k])])
                corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * half[:2]
                foot = place[:2] + corners @ np.stack([ahead, [-ahead[1], ahead[0]]])
                groups = np.concatenate([foot, foot + half[2] * reach])[None]
            for group in groups:
                outline = cv2.convexHull(group.astype(np.float32))[:, 0]
                on_ground = np.c_[outline, np.full(len(outline), place[2])]
                depth = on_ground @ view.image_from_world[2, :3] + view.image_from_world[2, 3]
                if (depth > NEAR_M).all():
                    px = np.clip(view.project(on_ground), -3e4, 3e4)
                    cv2.fillConvexPoly(layer, np.round(px * 16).astype(np.int32), 255, cv2.LINE_AA, 4)
        if layer.any():
            soft = cv2.GaussianBlur(layer, (0, 0), 0.8)
            image *= 1 - (1 - _SHADE) / 255 * soft[..., None].astype(np.float32)


def _whole(parts: Parts, view: View) -> tuple[list[float], float]:
    """Box x, y, width, height and area, px, of a person of whom nothing is hidden."""
    px = outlines(parts, view)
    low, high = px.min(axis=(0, 1)), px.max(axis=(0, 1))
    # Counted on a small picture of its own: limbs cover one another.
    scale = 64 / max(float((high - low).max()), 1e-6)
    small = np.zeros((66, 66), np.uint8)
    for outline in px:
        cv2.fillConvexPoly(small, np.round((outline - low) * scale * 16).astype(np.int32), 1, cv2.LINE_8, 4)
    return [*(low + 0.5).tolist(), *(high - low).tolist()], float(np.count_nonzero(small)) / scale**2


def _exposed(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    image = cv2.GaussianBlur(picture, (0, 0), 0.7).astype(np.float32)
    image += rng.standard_normal(image.shape, np.float32) * np.sqrt(1.4 + 0.12 * image)
    return np.clip(np.round(image), 0, 255).astype(np.uint8)
