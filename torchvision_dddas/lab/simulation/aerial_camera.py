"""Render the pictures of the UAV's camera in a simulated world, with the truth of every pixel."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.lab.simulation.aerial_ground import PixelPlaces, Terrain
from torchvision_dddas.lab.simulation.aerial_looks import WARM_LEVELS, cool_ground, draw_own_shadow, draw_water
from torchvision_dddas.lab.simulation.agents import Moment
from torchvision_dddas.lab.simulation.body_shapes import Wardrobe, limb_capsules, vehicle_faces
from torchvision_dddas.lab.simulation.cameras import LEAST_PX, Shutter, motion_blur, streak_kernel
from torchvision_dddas.lab.simulation.ground_backdrop import HAZE
from torchvision_dddas.lab.simulation.ground_objects import BITS
from torchvision_dddas.lab.simulation.scenario import CameraParameters, Scenario
from torchvision_dddas.lab.simulation.sensors import Sensor
from torchvision_dddas.lab.simulation.world import SHADE_BGR, World, equal_runs, shadow_above_ground
from torchvision_dddas.types import Camera

_REACH_M = 5.0  # greatest distance of a body's parts and its shadow from its place
_TALLEST_M = 2.5
_STEPS, _SIZES_PX = (8, 4, 2), (14, 50)  # factors that enlarge canvases, and the body sizes at which they change
_WIDEST_PX = 400  # the shadows of a wider target are drawn on one canvas per body
_CODES = 254 / _TALLEST_M  # heights are stored as levels from 1 to 255
_HIDDEN_M = 0.35  # an object hides a limb if the object is higher by at least this much
_SIGHTS = 12  # points on a line of sight at which the code tests whether a hill hides the body
_SHADE_CELLS = 1000  # cells along the longest side of the shade map, at most

_SKYLIGHT = 0.45  # brightness of a face in shade
_PLAIN_PX_M = 12.0  # below this many pixels per metre ("plain" pictures), a limb has one tone
_THICK_M = 0.055  # thinner limbs cast no shadow in plain pictures
_THIN_M = 0.04  # thinner limbs are left out of plain pictures and of all shadows

Part = tuple[slice, slice]


class AerialCamera:
    """The UAV's camera above a world. A picture depends only on the seed and its moment, not on earlier pictures."""

    def __init__(self, world: World, scenario: Scenario) -> None:
        parameters = scenario.camera
        size = parameters.width_px, parameters.height_px
        focal = size[0] / 2 / np.tan(np.radians(parameters.hfov_deg) / 2)
        self.camera = Camera("uav", size, (focal, focal), ((size[0] - 1) / 2, (size[1] - 1) / 2))
        self._world, self._exposure_s = world, parameters.exposure_s
        self._shutter = Shutter(self.camera, parameters.readout_s, parameters.vibration_px, scenario.seed)
        self._terrain = Terrain(world, self._shutter)
        self._painter = _Painter(world, self._shutter, parameters, scenario.seed)
        self._scenario = scenario
        self._sensor = Sensor(parameters, size, scenario.seed)

    def take(self, moment: Moment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return the picture (H, W, 3) uint8 BGR and masks (H, W) uint16 of targets and bodies; 0 is background."""
        # Drawing bodies and ground take equally long and are independent. Each picture gets its own thread: it costs
        # little, and no thread stays behind in a process that forks.
        with ThreadPoolExecutor(1) as other:
            drawing = other.submit(self._painter.draw, moment)
            places = self._terrain.places(moment)
            picture = self._ground(places, moment)
            drawn = drawing.result()
        targets, bodies = self._painter.paint(moment, drawn, picture, places.rise_m)
        if places.haze is not None:
            air = np.empty_like(picture)
            air[:] = HAZE.astype(np.uint8)
            picture = np.asarray(cv2.blendLinear(picture, air, 1 - places.haze, places.haze))
        if self._exposure_s > 0:
            # Motion of the ground in the picture during the exposure, on a 3 x 3 grid from corner to corner.
            height, width = places.east_m.shape
            at = np.ix_([0, height // 2, height - 1], [0, width // 2, width - 1])
            place = np.stack([places.east_m[at], places.north_m[at]], axis=-1).reshape(-1, 2).astype(float)
            way = self._shutter.ways(moment, np.c_[place, self._world.up_m(place)], self._exposure_s)
            picture = motion_blur(picture, way.reshape(3, 3, 2).astype(np.float32))
        return self._sensor.expose(picture, moment.number, moment.time_s), targets, bodies

    def _ground(self, places: PixelPlaces, moment: Moment) -> np.ndarray:
        """Return (H, W, 3) uint8: the ground and the objects that stand on it, without people and vehicles."""
        picture, scenario = self._terrain.picture(places), self._scenario
        if scenario.world.shore_m:
            draw_water(picture, places, scenario.world.shore_m, moment.time_s)
        if scenario.camera.thermal:
            return cool_ground(picture)
        if scenario.uav.size_m:
            place = moment.pose.place_m
            high = float(place[2] - self._world.up_m(place[None, :2])[0])
            draw_own_shadow(picture, places, place, high, self._world.to_sun, scenario.uav.size_m)
        return picture


class _Outlines(NamedTuple):
    """Convex outlines in drawing order, one row each.

    body: (M,) int, the body's row in the moment's bodies; the outlines of a body are consecutive. points_px: (M, C, 2).
    colour: (M, 3) BGR. up_m: (M,) height above the ground.
    """

    body: np.ndarray
    points_px: np.ndarray
    colour: np.ndarray
    up_m: np.ndarray


class _Sheet(NamedTuple):
    """A canvas enlarged `step` times, (h * step, w * step, ...), and the part of the picture that it covers."""

    body: int
    at: Part
    canvas: np.ndarray
    step: int

    def averaged(self) -> np.ndarray:
        """Return the canvas at the picture's own size."""
        size = self.canvas.shape[1] // self.step, self.canvas.shape[0] // self.step
        return np.asarray(cv2.resize(self.canvas, size, interpolation=cv2.INTER_AREA))


_Drawn = tuple[list[_Sheet], list[_Sheet], dict[int, np.ndarray]]


class _Painter:
    """Paints people and vehicles with their shadows into a picture, and labels their pixels."""

    def __init__(self, world: World, shutter: Shutter, parameters: CameraParameters, seed: int) -> None:
        self._world, self._shutter, self._exposure_s = world, shutter, parameters.exposure_s
        self._is_thermal = parameters.thermal
        self._shapes = _Shapes(world, shutter, seed)
        step = max(-(-max(world.surface.shape) // _SHADE_CELLS), 1)
        cells = tuple(-(-n // step) for n in world.surface.shape[::-1])
        surface = cv2.resize(world.surface, cells, interpolation=cv2.INTER_AREA)
        self._cell_m = world.side_m / cells[0]
        middles = (np.arange(cells[0]) + 0.5) * self._cell_m - world.side_m / 2
        east, north = np.meshgrid(middles, -middles)
        ground = world.up_m(np.c_[east.ravel(), north.ravel()]).reshape(surface.shape)
        # For each cell, the height up to which nearby objects shade it.
        self._shade_m = shadow_above_ground(np.asarray(surface + ground, np.float32), self._cell_m, world.to_sun)

    def draw(self, moment: Moment) -> _Drawn:
        """Draw the bodies that may be visible on canvases (h, w, 4: BGR and height), and their shadows (h, w).

        Also return {body: motion (2,) px during the exposure} for bodies that move visibly.
        """
        bodies, shape = moment.bodies, self._shutter.camera.size_px[::-1]
        rows, scale = self._in_view(moment)
        if not len(rows):
            return [], [], {}
        shaded = self._shaded(bodies.place_m[rows, :2].astype(np.float32))
        solids, shade_body, shade_px = self._shapes.outlines(moment, rows, float(scale.max()), shaded)
        in_sun = np.ones(len(bodies), bool)
        in_sun[rows] = shaded < 0.5
        kept = in_sun[shade_body] & (not self._is_thermal)
        # Each body has its own enlarged canvas. The factor is larger for smaller bodies.
        low, high = _boxes(solids.body, solids.points_px, shape)
        steps = np.array(_STEPS)[np.searchsorted(_SIZES_PX, (high - low).max(axis=1))]
        code = np.clip(1 + solids.up_m * _CODES, 1, 255)
        if self._is_thermal:
            solids = solids._replace(colour=np.array([[WARM_LEVELS[str(bodies.kind[k])]] * 3 for k in solids.body]))
        colours = np.c_[np.clip(solids.colour, 0, 255), code].tolist()
        sheets = _fill(solids.body, solids.points_px, low, high, steps, colours)
        shades = _draw_shades(shade_body[kept], shade_px[kept], bodies.target, shape)
        step = np.c_[bodies.velocity_m_s[rows], np.zeros(len(rows))] * self._exposure_s / 2
        places = np.concatenate([bodies.place_m[rows] - step, bodies.place_m[rows] + step])
        ends, _ = self._shutter.project(moment, places)
        way = ends[len(rows) :] - ends[: len(rows)]
        visible = np.hypot(way[:, 0], way[:, 1]) > LEAST_PX
        return sheets, shades, dict(zip(rows[visible].tolist(), way[visible], strict=True))

    def paint(
        self, moment: Moment, drawn: _Drawn, picture: np.ndarray, rise_m: np.ndarray | None
    ) -> tuple[np.ndarray, np.ndarray]:
        """Paint the drawn bodies into a picture (H, W, 3) uint8. Return masks (H, W) of their targets and numbers.

        rise_m: (H, W) height above ground of the visible standing object; it hides the bodies behind it.
        """
        bodies, (sheets, shades, ways_px) = moment.bodies, drawn
        targets, numbers = (np.zeros(picture.shape[:2], np.uint16) for _ in range(2))
        _shade(picture, shades, rise_m)
        for sheet in sheets:
            body, at, canvas, step = sheet
            if rise_m is not None and (rise := rise_m[at]).any():
                code = np.clip(1 + (rise - _HIDDEN_M) * _CODES, 0, 256).astype(np.uint16)
                canvas[canvas[..., 3] < np.repeat(np.repeat(code, step, axis=0), step, axis=1)] = 0
            covered = cv2.threshold(cv2.extractChannel(canvas, 3), 0, 255, cv2.THRESH_BINARY)[1]
            cover = sheet._replace(canvas=covered).averaged()
            paint = np.ascontiguousarray(sheet.averaged()[..., :3])
            mine = cover >= 128
            np.copyto(targets[at], bodies.target[body], where=mine, casting="unsafe")
            np.copyto(numbers[at], bodies.number[body], where=mine, casting="unsafe")
            if body in ways_px:
                at, cover, paint = _streak(at, cover, paint, ways_px[body], targets.shape)
            clear = cv2.cvtColor(255 - cover, cv2.COLOR_GRAY2BGR)
            picture[at] = cv2.add(cv2.multiply(picture[at], clear, scale=1 / 255), paint)
        return targets, numbers

    def _in_view(self, moment: Moment) -> tuple[np.ndarray, np.ndarray]:
        """Return the rows of the bodies that may be visible, far ones first, and the pixels per metre at each."""
        bodies, pose = moment.bodies, moment.pose
        size = np.array(self._shutter.camera.size_px)
        middle_px, depth = self._shutter.project(moment, bodies.place_m)
        scale = self._shutter.camera.focal_px[0] * pose.focal / np.maximum(depth, 1.0)
        inside = (depth > 1.0) & (np.abs(middle_px - size / 2) < size / 2 + _REACH_M * scale[:, None]).all(axis=1)
        rows = np.flatnonzero(inside)
        head = bodies.place_m[rows] + np.array([0, 0, 1.5])
        share = np.linspace(0.02, 0.9, _SIGHTS)[:, None, None] ** 2
        sight = head + share * (pose.place_m - head)
        up = self._world.up_m(sight[..., :2].reshape(-1, 2)).reshape(_SIGHTS, len(rows))
        rows = rows[(sight[..., 2] > up).all(axis=0)]
        rows = rows[np.argsort(-np.linalg.norm(bodies.place_m[rows] - pose.place_m, axis=1), kind="stable")]
        return rows, scale[rows]

    def _shaded(self, place: np.ndarray) -> np.ndarray:
        """Return (N,) the share of each body at places (N, 2) float32 that lies in the shade of nearby objects."""
        half = self._world.side_m / 2
        u, v = (place[:, 0] + half) / self._cell_m - 0.5, (half - place[:, 1]) / self._cell_m - 0.5
        above = np.zeros(len(place), np.float32)
        for at in np.array_split(np.arange(len(place)), -(-len(place) // 30_000)):
            above[at] = cv2.remap(self._shade_m, u[at], v[at], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)[:, 0]
        return np.clip(above / 1.6, 0, 1)


def _draw_shades(body: np.ndarray, points_px: np.ndarray, target: np.ndarray, shape: tuple[int, ...]) -> list[_Sheet]:
    """Draw the shadows of each target on one canvas. target: (N,) the target of each body."""
    if not len(body):
        return []
    each = _boxes(body, points_px, shape)
    step = _STEPS[int(np.searchsorted(_SIZES_PX, float(np.median((each[1] - each[0]).max(axis=1)))))]
    order = np.argsort(target[body], kind="stable")
    joined, joined_px = target[body][order], points_px[order]
    low, high = _boxes(joined, joined_px, shape)
    if (high - low).max() > _WIDEST_PX:
        joined, joined_px, (low, high) = body, points_px, each
    return _fill(joined, joined_px, low, high, np.full(len(low), step), None)


def _boxes(body: np.ndarray, points_px: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Return (B, 2) first column and row of each body, and (B, 2) the column and row after its last pixel."""
    first, limit = np.array([begin for begin, _ in equal_runs(body)]), np.array(shape[1::-1])
    low = np.floor(np.minimum.reduceat(points_px.min(axis=1), first)).astype(int) - 1
    high = np.ceil(np.maximum.reduceat(points_px.max(axis=1), first)).astype(int) + 2
    return np.maximum(low, 0), np.minimum(high, limit)


def _fill(
    body: np.ndarray,
    points_px: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    steps: np.ndarray,
    colours: list[list[float]] | None,
) -> list[_Sheet]:
    """Fill the outlines of each body on its canvas: four channels of colours, or 255 on one channel without colours."""
    runs = list(equal_runs(body))
    each = np.diff([*(begin for begin, _ in runs), len(body)])
    start, step_of = low.repeat(each, axis=0)[:, None], steps.repeat(each)[:, None, None]
    fixed = np.round(((points_px - start + 0.5) * step_of - 0.5) * 2**BITS)
    corners = list(np.clip(fixed, -(2**26), 2**26).astype(np.int32))
    sheets = []
    for k in np.flatnonzero((high > low).all(axis=1)).tolist():
        (x, y), (right, foot), step = low[k].tolist(), high[k].tolist(), int(steps[k])
        canvas = np.zeros(((foot - y) * step, (right - x) * step, *(() if colours is None else (4,))), np.uint8)
        for row in range(*runs[k]):
            cv2.fillConvexPoly(canvas, corners[row], 255 if colours is None else colours[row], cv2.LINE_8, BITS)
        sheets.append(_Sheet(int(body[runs[k][0]]), (slice(y, foot), slice(x, right)), canvas, step))
    return sheets


def _shade(picture: np.ndarray, shades: list[_Sheet], rise_m: np.ndarray | None) -> None:
    """Darken a picture where shadows lie. Overlapping shadows are no darker than one shadow."""
    layer = np.zeros(picture.shape[:2], np.uint8)
    for sheet in shades:
        cover = sheet.averaged()
        if rise_m is not None:
            cover[rise_m[sheet.at] > _HIDDEN_M] = 0
        layer[sheet.at] = cv2.max(np.ascontiguousarray(layer[sheet.at]), cover)
    share = 1 - np.arange(256)[:, None] / 255 * (1 - SHADE_BGR)
    keep = np.round(255 * share).astype(np.uint8).reshape(1, 256, 3)
    for sheet in shades:
        # Clear the layer after use, so that pixels in two overlapping boxes are not darkened twice.
        dark = cv2.LUT(cv2.cvtColor(layer[sheet.at], cv2.COLOR_GRAY2BGR), keep)
        picture[sheet.at] = cv2.multiply(picture[sheet.at], dark, scale=1 / 255)
        layer[sheet.at] = 0


def _streak(
    at: Part, cover: np.ndarray, paint: np.ndarray, way_px: np.ndarray, shape: tuple[int, ...]
) -> tuple[Part, np.ndarray, np.ndarray]:
    """Blur a body's cover and paint along its motion way_px (2,). The returned part is enlarged to hold the blur."""
    kernel = streak_kernel(way_px)
    reach = kernel.shape[0] // 2
    part = [(min(reach, one.start), min(reach, size - one.stop)) for one, size in zip(at, shape, strict=True)]
    wide = cv2.copyMakeBorder(
        np.dstack([paint, cover]), *part[0], *part[1], borderType=cv2.BORDER_CONSTANT, value=(0, 0, 0, 0)
    )
    wide = cv2.filter2D(wide, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    rows, columns = (slice(one.start - before, one.stop + after) for one, (before, after) in zip(at, part, strict=True))
    return (rows, columns), np.ascontiguousarray(wide[..., 3]), np.ascontiguousarray(wide[..., :3])


class _Shapes:
    """Computes the outlines of bodies, from limbs or faces lit by the sun."""

    def __init__(self, world: World, shutter: Shutter, seed: int) -> None:
        self._world, self._shutter, self._wardrobe = world, shutter, Wardrobe(seed)

    def outlines(
        self, moment: Moment, rows: np.ndarray, scale_px_m: float, shaded: np.ndarray
    ) -> tuple[_Outlines, np.ndarray, np.ndarray]:
        """Return the outlines of bodies in the order of rows (N,), and body and points_px of their ground shadows.

        scale_px_m: pixels per metre at the nearest body. shaded: (N,) share of each body in the shade of objects.
        """
        bodies, is_plain = moment.bodies, scale_px_m < _PLAIN_PX_M
        rank = np.zeros(len(bodies), np.int64)
        rank[rows] = np.arange(len(rows))
        dim = np.ones((len(bodies), 3))
        dim[rows] = 1 - shaded[:, None] * (1 - SHADE_BGR)
        is_person = bodies.kind[rows] == "person"
        limb_body, ends, radius, limb_colour = self._limbs(moment, rows[is_person], _THIN_M if is_plain else 0.0)
        face_body, corners, face_colour, seen = self._faces(moment, rows[~is_person])

        # Project the limbs' ends, the faces' corners, and the shadows of both in one call.
        solid = np.concatenate([ends.reshape(-1, 3), corners.reshape(-1, 3)])
        body = np.concatenate([limb_body.repeat(2), face_body.repeat(corners.shape[1])])
        cast = self._cast(solid, bodies.place_m[body, 2])
        velocity = np.c_[bodies.velocity_m_s, np.zeros(len(bodies))][body]
        px, depth = self._shutter.project(moment, np.concatenate([solid, cast]), np.tile(velocity, (2, 1)))
        px, depth = px.reshape(2, -1, 2), depth.reshape(2, -1)
        limbs = 2 * len(ends)
        ends_px = px[:, :limbs].reshape(2, len(ends), 2, 2)
        focal = self._shutter.camera.focal_px[0] * moment.pose.focal
        radius_px = radius * focal / depth[:, :limbs].reshape(2, len(ends), 2)
        corners_px = px[:, limbs:].reshape(2, *corners.shape[:2], 2)

        sun = self._world.to_sun @ moment.pose.axes
        facing = max(-float(sun[2]), 0.0)
        dark, bright = 0.5 + 0.2 * facing, 0.9 + 0.2 * facing
        up = (ends[..., 2] - bodies.place_m[limb_body, 2, None]).mean(axis=1)
        points = 5 if scale_px_m < 30 else 7
        whole = limb_capsules(ends_px[0], radius_px[0], points)
        if is_plain:
            people = limb_body, whole, limb_colour * (0.45 * dark + 0.55 * bright), up
        else:
            part = limb_capsules(ends_px[0] + radius_px[0, ..., None] * sun[:2] * 0.35, radius_px[0] * 0.72, points)
            both = np.stack([whole, part], axis=1).reshape(2 * len(whole), *whole.shape[1:])
            tones = np.stack([limb_colour * dark, limb_colour * bright], axis=1).reshape(-1, 3)
            people = limb_body.repeat(2), both, tones, up.repeat(2)
        middle_up = corners[..., 2].mean(axis=1) - bodies.place_m[face_body, 2]
        faces = face_body[seen], corners_px[0][seen], face_colour[seen], middle_up[seen]
        solids = _Outlines(*_join(rank, people, faces))
        thick = radius.max(axis=1) > (_THICK_M if is_plain else _THIN_M)
        limb_shade = limb_body[thick], limb_capsules(ends_px[1][thick], radius_px[1][thick], points)
        shade_body, shade_px = _join(rank, limb_shade, (face_body, corners_px[1]))
        return solids._replace(colour=solids.colour * dim[solids.body]), shade_body, shade_px

    def _limbs(
        self, moment: Moment, rows: np.ndarray, thin_m: float
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the limbs of people, far ones first: body (M,), ends (M, 2, 3), radii (M, 2), colour (M, 3)."""
        shape = self._wardrobe.figures(moment.bodies, rows)
        # Clothes that are not worn have a radius of NaN.
        person, limb = np.nonzero(np.isfinite(shape.radius_m).all(axis=2) & (shape.radius_m.max(axis=2) > thin_m))
        depth = (shape.ends_m[person, limb].mean(axis=1) - moment.pose.place_m) @ moment.pose.axes[:, 2]
        order = np.lexsort((-depth, person))
        person, limb = person[order], limb[order]
        return rows[person], shape.ends_m[person, limb], shape.radius_m[person, limb], shape.colour[person, limb]

    def _faces(self, moment: Moment, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Return the faces of vehicles in drawing order.

        Columns: body (M,), corners (M, C, 3), colour (M, 3), and bool (M,) whether the face looks at the camera.
        """
        bodies, pose, sun = moment.bodies, moment.pose, self._world.to_sun
        parts = [(np.zeros(0, np.int64), np.zeros((0, 1, 3)), np.zeros((0, 3)), np.zeros(0, bool))]
        for row in rows:
            faces = vehicle_faces(str(bodies.kind[row]))
            corners, normal, colour = faces.placed(bodies, row)
            light = np.where(faces.lit, _SKYLIGHT + (1.05 - _SKYLIGHT) * np.maximum(normal @ sun, 0) / sun[2], 1)
            colour, middle = colour * light[:, None], corners.mean(axis=1)
            order = np.arange(len(corners))
            if bodies.kind[row] != "car":
                # Far faces come first. The marker comes last because it lies on top.
                order = np.lexsort(((middle - pose.place_m) @ -pose.axes[:, 2], faces.plate))
            seen = np.einsum("fk,fk->f", normal, pose.place_m - middle) > 0
            parts.append((np.full(len(corners), row), corners[order], colour[order], seen[order]))
        body, corners, colour, seen = _concatenate(parts)
        return body, corners, colour, seen

    def _cast(self, points_m: np.ndarray, feet_up_m: np.ndarray) -> np.ndarray:
        """Return where the shadows of points (N, 3) fall on the ground, (N, 3)."""
        sun = self._world.to_sun
        place, up = points_m[:, :2], feet_up_m
        for _ in range(2):
            # Rising ground is met earlier, so repeat the step with the height that was found.
            place = points_m[:, :2] - (np.maximum(points_m[:, 2] - up, 0) / max(sun[2], 0.1))[:, None] * sun[:2]
            up = self._world.up_m(place)
        return np.c_[place, up]


def _join(rank: np.ndarray, *parts: tuple[np.ndarray, ...]) -> list[np.ndarray]:
    """Concatenate the columns of outlines (body, points, ...) and sort them by the rank of the body."""
    columns = _concatenate(parts)
    order = np.argsort(rank[columns[0]], kind="stable")
    return [column[order] for column in columns]


def _concatenate(parts: Sequence[tuple[np.ndarray, ...]]) -> list[np.ndarray]:
    """Concatenate the columns of outlines (body, points, ...). Outlines with fewer corners repeat their last corner."""
    most = max(part[1].shape[1] for part in parts)
    filled = [
        (body, np.pad(points, ((0, 0), (0, most - points.shape[1]), (0, 0)), mode="edge"), *others)
        for body, points, *others in parts
    ]
    return [np.concatenate(column) for column in zip(*filled, strict=True)]
