"""What the UAV's camera films of a simulated world, and the truth of every pixel."""

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation.aerial_ground import PixelPlaces, Terrain
from torchvision_dddas.simulation.agents import Moment
from torchvision_dddas.simulation.body_outlines import Outlines, Shapes
from torchvision_dddas.simulation.ground_backdrop import HAZE
from torchvision_dddas.simulation.relief import SHADE_BGR, shadow_above_ground
from torchvision_dddas.simulation.scenario import Scenario
from torchvision_dddas.simulation.sensor import Sensor
from torchvision_dddas.simulation.shutter import LEAST_PX, Shutter, motion_blur, streak_kernel
from torchvision_dddas.simulation.world import World
from torchvision_dddas.types import Camera


class AerialCamera:
    """The UAV's camera above a world. A picture depends on the seed and its moment alone, not on those before it."""

    def __init__(self, world: World, scenario: Scenario) -> None:
        parameters = scenario.camera
        size = parameters.width_px, parameters.height_px
        focal = size[0] / 2 / np.tan(np.radians(parameters.hfov_deg) / 2)
        self.camera = Camera("uav", size, (focal, focal), ((size[0] - 1) / 2, (size[1] - 1) / 2))
        self._world, self._exposure_s = world, parameters.exposure_s
        self._shutter = Shutter(self.camera, parameters.readout_s, parameters.vibration_px, scenario.seed)
        self._terrain = Terrain(world, self._shutter)
        self._painter = Painter(world, self._shutter, parameters.exposure_s, scenario.seed)
        self._sensor = Sensor(parameters, size, scenario.seed)

    def take(self, moment: Moment) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The picture (H, W, 3) uint8 BGR, its targets (H, W) uint16 and its bodies (H, W) uint16; 0: neither."""
        # Both take about as long, and neither needs the other. A thread for each picture costs little, and none is left
        # behind in a process that forks.
        with ThreadPoolExecutor(1) as other:
            drawing = other.submit(self._painter.drawn, moment)
            lie = self._terrain.lie(moment)
            picture = self._terrain.texture(lie)
            drawn = drawing.result()
        targets, bodies = (np.zeros(picture.shape[:2], np.uint16) for _ in range(2))
        self._painter.paint(moment, drawn, picture, targets, bodies, lie.rise_m)
        if lie.haze is not None:
            air = np.empty_like(picture)
            air[:] = HAZE.astype(np.uint8)
            picture = np.asarray(cv2.blendLinear(picture, air, 1 - lie.haze, lie.haze))
        if self._exposure_s > 0:
            picture = motion_blur(picture, self._ways(moment, lie))
        return self._sensor.expose(picture, moment.number, moment.time_s), targets, bodies

    def _ways(self, moment: Moment, lie: PixelPlaces) -> np.ndarray:
        """(3, 3, 2) pixels that the ground moves in the picture while it is exposed, from corner to corner."""
        height, width = lie.east_m.shape
        row, column = np.meshgrid([0, height // 2, height - 1], [0, width // 2, width - 1], indexing="ij")
        place = np.stack([lie.east_m[row, column], lie.north_m[row, column]], axis=-1).reshape(-1, 2).astype(float)
        ground = np.c_[place, self._world.up_m(place)]
        return self._shutter.ways(moment, ground, self._exposure_s).reshape(3, 3, 2).astype(np.float32)


# Paint people and vehicles with their shadows into a picture from the air, and label their pixels.


_BITS = 4  # of sub-pixel accuracy that OpenCV draws with
_REACH_M = 5.0  # reach of a body with its shadow
_TALLEST_M = 2.5
_STEPS, _SIZES_PX = (8, 4, 2), (14, 50)  # enlargement of canvases for bodies up to these sizes
_WIDEST_PX = 400  # canvases of targets whose people are further apart would be large
_CODES = 254 / _TALLEST_M  # heights are drawn as levels from 1 to 255
_HIDDEN_M = 0.35  # an object hides a limb if it is higher by this
_SIGHTS = 12  # places on the line of sight at which a hill may hide a body
_SHADE_CELLS = 1000  # along the longest side of the map of what lies in shade


class Sheet(NamedTuple):
    """A canvas enlarged `step` times, (h * step, w * step, ...), and the part of the picture that it covers."""

    body: int
    at: tuple[slice, slice]
    canvas: np.ndarray
    step: int


class Drawn(NamedTuple):
    """Bodies (h, w, 4: BGR and height) and shadows (h, w), and the ways of bodies that move while they are exposed."""

    sheets: list[Sheet]
    shades: list[Sheet]
    ways_px: dict[int, np.ndarray]


class Painter:
    """Paints the bodies of a moment."""

    def __init__(self, world: World, shutter: Shutter, exposure_s: float, seed: int) -> None:
        self._world, self._shutter, self._exposure_s = world, shutter, exposure_s
        self._shapes = Shapes(world, shutter, seed)
        step = max(-(-max(world.surface.shape) // _SHADE_CELLS), 1)
        cells = tuple(-(-n // step) for n in world.surface.shape[::-1])
        surface = cv2.resize(world.surface, cells, interpolation=cv2.INTER_AREA)
        self._cell_m = world.side_m / cells[0]
        middles = (np.arange(cells[0]) + 0.5) * self._cell_m - world.side_m / 2
        east, north = np.meshgrid(middles, -middles)
        ground = world.up_m(np.c_[east.ravel(), north.ravel()]).reshape(surface.shape)
        # How high the shadow of what stands about reaches above each cell.
        self._shade_m = shadow_above_ground(np.asarray(surface + ground, np.float32), self._cell_m, world.to_sun)

    def drawn(self, moment: Moment) -> Drawn:
        """All bodies that a moment's picture may show, and their shadows, each on a canvas of its own."""
        bodies, shape = moment.bodies, self._shutter.camera.size_px[::-1]
        rows, scale = self._in_view(moment)
        if not len(rows):
            return Drawn([], [], {})
        shaded = self._shaded(moment, rows)
        solids, shadows = self._shapes.outlines(moment, rows, float(scale.max()), shaded)
        in_sun = np.ones(len(bodies), bool)
        in_sun[rows] = shaded < 0.5
        shadows = Outlines(*(column[in_sun[shadows.body]] for column in shadows))
        return Drawn(
            draw_sheets(solids, shape), draw_shades(shadows, bodies.target, shape), self._own_ways(moment, rows)
        )

    def paint(
        self,
        moment: Moment,
        drawn: Drawn,
        picture: np.ndarray,
        targets: np.ndarray,
        numbers: np.ndarray,
        rise_m: np.ndarray | None = None,
    ) -> None:
        """Paint the drawn bodies into a picture (H, W, 3) uint8, and their numbers into masks (H, W).

        rise_m: (H, W) height above ground of what stands and is seen; it hides what is behind it.
        """
        bodies = moment.bodies
        _shade(picture, drawn.shades, rise_m)
        for body, at, canvas, step in drawn.sheets:
            hide_behind(canvas, step, rise_m, at)
            cover = _averaged(_covered(cv2.extractChannel(canvas, 3)), step)
            paint = np.ascontiguousarray(_averaged(canvas, step)[..., :3])
            mine = cover >= 128
            np.copyto(targets[at], bodies.target[body], where=mine, casting="unsafe")
            np.copyto(numbers[at], bodies.number[body], where=mine, casting="unsafe")
            if body in drawn.ways_px:
                at, cover, paint = _drawn_out(at, cover, paint, drawn.ways_px[body], targets.shape)
            clear = cv2.cvtColor(255 - cover, cv2.COLOR_GRAY2BGR)
            picture[at] = cv2.add(cv2.multiply(picture[at], clear, scale=1 / 255), paint)

    def _own_ways(self, moment: Moment, rows: np.ndarray) -> dict[int, np.ndarray]:
        """Pixels that bodies move on their own during the exposure, of those that do so visibly."""
        bodies = moment.bodies
        step = np.c_[bodies.velocity_m_s[rows], np.zeros(len(rows))] * self._exposure_s / 2
        ends, _ = self._shutter.project(
            moment, np.concatenate([bodies.place_m[rows] - step, bodies.place_m[rows] + step])
        )
        way = ends[len(rows) :] - ends[: len(rows)]
        visible = np.hypot(way[:, 0], way[:, 1]) > LEAST_PX
        return dict(zip(rows[visible].tolist(), way[visible], strict=True))

    def _in_view(self, moment: Moment) -> tuple[np.ndarray, np.ndarray]:
        """The rows of the bodies that the picture may show, far ones first, and pixels for each metre there."""
        bodies, pose = moment.bodies, moment.pose
        if not len(bodies):
            return np.zeros(0, np.int64), np.zeros(0)
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

    def _shaded(self, moment: Moment, rows: np.ndarray) -> np.ndarray:
        """(N,) how much of bodies lies in the shade of what stands about."""
        place = moment.bodies.place_m[rows, :2].astype(np.float32)
        half = self._world.side_m / 2
        u, v = (place[:, 0] + half) / self._cell_m - 0.5, (half - place[:, 1]) / self._cell_m - 0.5
        above = np.zeros(len(rows), np.float32)
        for at in np.array_split(np.arange(len(rows)), -(-len(rows) // 30_000)):
            above[at] = cv2.remap(self._shade_m, u[at], v[at], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT)[:, 0]
        return np.clip(above / 1.6, 0, 1)


def draw_sheets(outlines: Outlines, shape: tuple[int, ...]) -> list[Sheet]:
    """The outlines of each body on a canvas of its own, enlarged: the smaller the body the more so."""
    if not len(outlines.body):
        return []
    low, high = _boxes(outlines, shape)
    steps = np.array(_STEPS)[np.searchsorted(_SIZES_PX, (high - low).max(axis=1))]
    code = np.clip(1 + outlines.up_m * _CODES, 1, 255)
    colours = np.c_[np.clip(outlines.colour, 0, 255), code].tolist()
    return _sheets(outlines, low, high, steps, colours)


def draw_shades(outlines: Outlines, target: np.ndarray, shape: tuple[int, ...]) -> list[Sheet]:
    """The shadows of all of a target on one canvas; target: (N,) of each body."""
    if not len(outlines.body):
        return []
    each = _boxes(outlines, shape)
    typical = float(np.median((each[1] - each[0]).max(axis=1)))
    step = _STEPS[int(np.searchsorted(_SIZES_PX, typical))]
    order = np.argsort(target[outlines.body], kind="stable")
    joined = outlines._replace(body=target[outlines.body][order], points_px=outlines.points_px[order])
    low, high = _boxes(joined, shape)
    if (high - low).max() > _WIDEST_PX:
        joined, (low, high) = outlines, each
    return _sheets(joined, low, high, np.full(len(low), step), [255] * len(joined.body))


def _boxes(outlines: Outlines, shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """(B, 2) column and row of the first pixel of each body, and of the one after its last."""
    first, limit = np.array([run[0] for run in outlines.runs]), np.array(shape[1::-1])
    low = np.floor(np.minimum.reduceat(outlines.points_px.min(axis=1), first)).astype(int) - 1
    high = np.ceil(np.maximum.reduceat(outlines.points_px.max(axis=1), first)).astype(int) + 2
    return np.maximum(low, 0), np.minimum(high, limit)


def _sheets(
    outlines: Outlines, low: np.ndarray, high: np.ndarray, steps: np.ndarray, colours: Sequence[float | list[float]]
) -> list[Sheet]:
    runs = outlines.runs
    each = np.diff([*(run[0] for run in runs), len(outlines.body)])
    start, step_of = low.repeat(each, axis=0)[:, None], steps.repeat(each)[:, None, None]
    fixed = np.round(((outlines.points_px - start + 0.5) * step_of - 0.5) * 2**_BITS)
    corners = list(np.clip(fixed, -(2**26), 2**26).astype(np.int32))
    found = []
    for k in np.flatnonzero((high > low).all(axis=1)).tolist():
        (x, y), (right, foot), step = low[k].tolist(), high[k].tolist(), int(steps[k])
        first, last = runs[k]
        layers = () if isinstance(colours[first], int) else (4,)
        canvas = np.zeros(((foot - y) * step, (right - x) * step, *layers), np.uint8)
        for row in range(first, last):
            cv2.fillConvexPoly(canvas, corners[row], colours[row], cv2.LINE_8, _BITS)
        found.append(Sheet(int(outlines.body[first]), (slice(y, foot), slice(x, right)), canvas, step))
    return found


def _shade(picture: np.ndarray, shades: list[Sheet], rise_m: np.ndarray | None) -> None:
    """Darken a picture where shadows lie; where two lie on each other it is as dark as under one."""
    layer = np.zeros(picture.shape[:2], np.uint8)
    for _, at, canvas, step in shades:
        cover = _averaged(canvas, step)
        if rise_m is not None:
            cover[rise_m[at] > _HIDDEN_M] = 0
        layer[at] = cv2.max(np.ascontiguousarray(layer[at]), cover)
    share = 1 - np.arange(256)[:, None] / 255 * (1 - SHADE_BGR)
    keep = np.round(255 * share).astype(np.uint8).reshape(1, 256, 3)
    for _, at, _, _ in shades:
        # Taken off the layer when done: where boxes overlap nothing is darkened twice.
        dark = cv2.LUT(cv2.cvtColor(layer[at], cv2.COLOR_GRAY2BGR), keep)
        picture[at] = cv2.multiply(picture[at], dark, scale=1 / 255)
        layer[at] = 0


def hide_behind(canvas: np.ndarray, step: int, rise_m: np.ndarray | None, at: tuple[slice, slice]) -> None:
    """Take away from a canvas what is behind something higher on the line of sight."""
    if rise_m is None:
        return
    rise = rise_m[at]
    if rise.any():
        code = np.clip(1 + (rise - _HIDDEN_M) * _CODES, 0, 256).astype(np.uint16)
        code = np.repeat(np.repeat(code, step, axis=0), step, axis=1)
        canvas[canvas[..., 3] < code] = 0


def _drawn_out(
    at: tuple[slice, slice], cover: np.ndarray, paint: np.ndarray, way_px: np.ndarray, shape: tuple[int, ...]
) -> tuple[tuple[slice, slice], np.ndarray, np.ndarray]:
    """What covers a part of a picture, drawn out along a way; the part grows by what the way needs."""
    kernel = streak_kernel(way_px)
    reach = kernel.shape[0] // 2
    part = [(min(reach, one.start), min(reach, size - one.stop)) for one, size in zip(at, shape[:2], strict=True)]
    wide = cv2.copyMakeBorder(
        np.dstack([paint, cover]), *part[0], *part[1], borderType=cv2.BORDER_CONSTANT, value=(0, 0, 0, 0)
    )
    wide = cv2.filter2D(wide, -1, kernel, borderType=cv2.BORDER_CONSTANT)
    grown = [slice(one.start - before, one.stop + after) for one, (before, after) in zip(at, part, strict=True)]
    return (grown[0], grown[1]), np.ascontiguousarray(wide[..., 3]), np.ascontiguousarray(wide[..., :3])


def _covered(canvas: np.ndarray) -> np.ndarray:
    """255 where anything is drawn on a canvas (h, w)."""
    return cv2.threshold(canvas, 0, 255, cv2.THRESH_BINARY)[1]


def _averaged(canvas: np.ndarray, step: int) -> np.ndarray:
    """An enlarged canvas at the picture's own size."""
    size = canvas.shape[1] // step, canvas.shape[0] // step
    return np.asarray(cv2.resize(canvas, size, interpolation=cv2.INTER_AREA))
