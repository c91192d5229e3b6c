"""Paints people and vehicles into a picture from the air, with their shadows, and tells which pixels are theirs."""

from typing import NamedTuple

import cv2
import numpy as np

from torchvision_dddas.simulation import vehicles, walkers
from torchvision_dddas.simulation.figures import dress
from torchvision_dddas.simulation.moment import Moment
from torchvision_dddas.simulation.shutter import Shutter
from torchvision_dddas.simulation.sunlight import SHADE_BGR
from torchvision_dddas.simulation.world import World

_BITS = 4  # of sub-pixel accuracy that OpenCV draws with
_REACH_M = 6.0  # a body with its shadow reaches at most about so far
_TALLEST_M = 2.5
_ROUND = np.linspace(0, np.pi, 7)
_SKYLIGHT = 0.45  # how bright a face is that the sun does not reach


class Outlines(NamedTuple):
    """Convex outlines of many bodies in the order to draw them, one row each.

    body: (M,) int, which of the bodies, ascending. points_px: (M, C, 2). colour: (M, 3). up_m: (M,) above ground.
    """

    body: np.ndarray
    points_px: np.ndarray
    colour: np.ndarray
    up_m: np.ndarray


class Painter:
    """Paints the bodies of a moment."""

    def __init__(self, world: World, shutter: Shutter, seed: int) -> None:
        self._world, self._shutter, self._seed = world, shutter, seed
        self._dress: dict[int, np.ndarray] = {}

    def paint(self, moment: Moment, picture: np.ndarray, targets: np.ndarray, numbers: np.ndarray) -> None:
        """Paint all bodies into a picture (H, W, 3) uint8 and their numbers into the masks (H, W)."""
        seen = self._in_view(moment)
        if not len(seen):
            return
        solids, shadows = self._outlines(moment, seen)
        _shade(picture, shadows, self._scale(moment, seen))
        size = self._scale(moment, seen)
        for start, end in _runs(solids.body):
            k = int(solids.body[start])
            patch = _drawn(solids, start, end, size[k], picture.shape[:2])
            if patch is None:
                continue
            rows, columns, canvas, step = patch
            cover = _averaged((canvas[..., 3] > 0).astype(np.uint8) * 255, step)
            colour = _averaged(canvas[..., :3], step)
            below = cv2.multiply(picture[rows, columns], cv2.merge([255 - cover] * 3), scale=1 / 255)
            cv2.add(below, colour, dst=below)
            picture[rows, columns] = below
            mine = cover >= 128
            targets[rows, columns][mine] = moment.bodies.target[seen[k]]
            numbers[rows, columns][mine] = moment.bodies.number[seen[k]]

    def _in_view(self, moment: Moment) -> np.ndarray:
        """The rows of the bodies that the picture may show, far ones first."""
        bodies = moment.bodies
        if not len(bodies):
            return np.zeros(0, np.int64)
        width, height = self._shutter.camera.size_px
        centre_px, depth = self._shutter.project(moment, bodies.place_m)
        focal = self._shutter.camera.focal_px[0] * moment.pose.focal
        margin = _REACH_M * focal / np.maximum(depth, 1.0)
        inside = (depth > 1.0) & (np.abs(centre_px[:, 0] - width / 2) < width / 2 + margin)
        inside &= np.abs(centre_px[:, 1] - height / 2) < height / 2 + margin
        rows = np.flatnonzero(inside)
        away = np.linalg.norm(bodies.place_m[rows] - moment.pose.place_m, axis=1)
        return rows[np.argsort(-away, kind="stable")]

    def _scale(self, moment: Moment, seen: np.ndarray) -> np.ndarray:
        """Pixels for each metre at bodies."""
        _, depth = self._shutter.project(moment, moment.bodies.place_m[seen])
        return self._shutter.camera.focal_px[0] * moment.pose.focal / depth

    def _outlines(self, moment: Moment, seen: np.ndarray) -> tuple[Outlines, Outlines]:
        """Outlines of bodies and of their shadows on the ground."""
        kind = moment.bodies.kind[seen]
        people, wheeled = np.flatnonzero(kind == "person"), np.flatnonzero(kind != "person")
        solids: list[Outlines] = []
        shadows: list[Outlines] = []
        if len(people):
            for outlines, kept in zip(self._people(moment, seen, people), (solids, shadows), strict=True):
                kept.append(outlines)
        for k in wheeled:
            for outlines, kept in zip(self._vehicle(moment, int(seen[k]), int(k)), (solids, shadows), strict=True):
                kept.append(outlines)
        return _together(solids), _together(shadows)

    def _colours(self, rows: np.ndarray, moment: Moment) -> np.ndarray:
        """(N, 4, 3): shirt, trousers, skin and hair of people."""
        bodies = moment.bodies
        for row in rows:
            number = int(bodies.number[row])
            if number not in self._dress:
                wears = dress(bodies.colour[row], self._seed, number)
                self._dress[number] = np.stack([wears.shirt, wears.trousers, wears.skin, wears.hair])
        return np.stack([self._dress[int(n)] for n in bodies.number[rows]])

    def _people(self, moment: Moment, seen: np.ndarray, which: np.ndarray) -> tuple[Outlines, Outlines]:
        bodies, rows = moment.bodies, seen[which]
        speed = np.linalg.norm(bodies.velocity_m_s[rows], axis=1)
        limbs = walkers.limbs(
            bodies.place_m[rows], bodies.facing_rad[rows], bodies.height_m[rows], speed, bodies.phase[rows],
            self._colours(rows, moment),
        )  # fmt: skip
        count, each = limbs.colour.shape[:2]
        ends = limbs.ends_m.reshape(-1, 3)
        velocity = np.c_[bodies.velocity_m_s[rows], np.zeros(count)].repeat(each * 2, axis=0)
        focal = self._shutter.camera.focal_px[0] * moment.pose.focal
        feet_up = bodies.place_m[rows, 2].repeat(each * 2)
        body = which.repeat(each)
        # Shadow first: the solids are drawn in another order.
        shade_px, shade_depth = self._shutter.project(moment, self._cast(ends, feet_up), velocity)
        radius = limbs.radius_m.reshape(-1, 2)
        shade = _capsules(shade_px.reshape(-1, 2, 2), radius * focal / shade_depth.reshape(-1, 2))
        shadows = Outlines(body, shade, np.zeros((len(body), 3)), np.zeros(len(body)))
        px, depth = self._shutter.project(moment, ends, velocity)
        px, radius_px = px.reshape(-1, 2, 2), radius * focal / depth.reshape(-1, 2)
        middle = depth.reshape(count, each, 2).mean(axis=2)
        order = (np.argsort(-middle, axis=1) + np.arange(count)[:, None] * each).ravel()
        aside, dark, bright = self._light(moment)
        whole, part = _capsules(px, radius_px), _capsules(px + radius_px[..., None] * aside, radius_px * 0.72)
        colour = limbs.colour.reshape(-1, 3)
        both = np.stack([whole[order], part[order]], axis=1).reshape(-1, *whole.shape[1:])
        tone = np.stack([colour[order] * dark, colour[order] * bright], axis=1).reshape(-1, 3)
        up = (ends[:, 2] - feet_up).reshape(-1, 2).mean(axis=1)[order].repeat(2)
        return Outlines(body.repeat(2), both, tone, up), shadows

    def _light(self, moment: Moment) -> tuple[np.ndarray, float, float]:
        """Where on a round limb the sun's light lies, as shares of its radius, and how bright its sides are."""
        sun = self._world.to_sun @ moment.pose.axes
        facing = max(-float(sun[2]), 0.0)
        return sun[:2] * 0.35, 0.5 + 0.2 * facing, 0.9 + 0.2 * facing

    def _vehicle(self, moment: Moment, row: int, which: int) -> tuple[Outlines, Outlines]:
        bodies = moment.bodies
        faces = vehicles.car() if bodies.kind[row] == "car" else vehicles.ugv()
        place = bodies.place_m[row]
        corners, normal = vehicles.placed(faces, place, float(bodies.facing_rad[row]))
        count, each = corners.shape[:2]
        velocity = np.append(bodies.velocity_m_s[row], 0.0)
        flat = corners.reshape(-1, 3)
        px, depth = self._shutter.project(moment, flat, velocity)
        middle = corners.mean(axis=1)
        towards = np.einsum("fk,fk->f", normal, moment.pose.place_m - middle) > 0
        light = np.where(faces.lit, _SKYLIGHT + (1.05 - _SKYLIGHT) * np.clip(normal @ self._world.to_sun, 0, None), 1)
        plate = bodies.plate[row]
        plate = vehicles.COVERED if bodies.hidden[row] or np.isnan(plate).any() else plate
        colour = faces.colour + faces.paint[:, None] * bodies.colour[row] + faces.plate[:, None] * plate
        order = np.arange(count)
        if bodies.kind[row] != "car":
            # Far faces first; the marker lies on top of all.
            order = np.lexsort((-depth.reshape(count, each).mean(axis=1), faces.plate))
        order = order[towards[order]]
        up = middle[:, 2] - place[2]
        body = np.full(count, which)
        solids = Outlines(body[order], px.reshape(count, each, 2)[order], (colour * light[:, None])[order], up[order])
        shade_px, _ = self._shutter.project(moment, self._cast(flat, np.full(len(flat), place[2])), velocity)
        shadows = Outlines(body, shade_px.reshape(count, each, 2), np.zeros((count, 3)), np.zeros(count))
        return solids, shadows

    def _cast(self, points_m: np.ndarray, feet_up_m: np.ndarray) -> np.ndarray:
        """Where the shadows of points (N, 3) fall on the ground."""
        sun = self._world.to_sun
        reach = np.maximum(points_m[:, 2] - feet_up_m, 0) / sun[2]
        place = points_m[:, :2] - reach[:, None] * sun[:2]
        # Where the ground rises it is met earlier: once more, from the height that was found.
        up = self._world.up_m(place)
        place = points_m[:, :2] - (np.maximum(points_m[:, 2] - up, 0) / sun[2])[:, None] * sun[:2]
        return np.c_[place, self._world.up_m(place)]


def _together(parts: list[Outlines]) -> Outlines:
    """All outlines in the order of the bodies."""
    most = max(part.points_px.shape[1] for part in parts)
    points = [
        np.concatenate([p.points_px, p.points_px[:, -1:].repeat(most - p.points_px.shape[1], axis=1)], 1) for p in parts
    ]
    body = np.concatenate([part.body for part in parts])
    order = np.argsort(body, kind="stable")
    colour, up = np.concatenate([p.colour for p in parts]), np.concatenate([p.up_m for p in parts])
    return Outlines(body[order], np.concatenate(points)[order], colour[order], up[order])


def _runs(body: np.ndarray) -> list[tuple[int, int]]:
    edges = [0, *(np.flatnonzero(np.diff(body)) + 1).tolist(), len(body)]
    return list(zip(edges[:-1], edges[1:], strict=True))


def _capsules(ends_px: np.ndarray, radius_px: np.ndarray) -> np.ndarray:
    """(N, C, 2) outlines of thick lines (N, 2, 2) with round ends of these radii (N, 2)."""
    way = ends_px[:, 1] - ends_px[:, 0]
    angle = np.arctan2(way[:, 1], way[:, 0])[:, None]
    turns = np.stack([angle + np.pi / 2 + _ROUND, angle - np.pi / 2 + _ROUND], axis=1)
    circles = radius_px[:, :, None, None] * np.stack([np.cos(turns), np.sin(turns)], axis=-1)
    return (ends_px[:, :, None] + circles).reshape(len(ends_px), -1, 2)


def _drawn(
    outlines: Outlines, start: int, end: int, scale: float, size: tuple[int, ...]
) -> tuple[slice, slice, np.ndarray, int] | None:
    """Some outlines on an enlarged canvas (h * step, w * step, 4), the last the height above ground, from 1; 0: none.

    With the rows and columns of the picture that it covers; None where that is nothing.
    """
    points = outlines.points_px[start:end]
    low = np.floor(points.min(axis=(0, 1))).astype(int) - 1
    high = np.ceil(points.max(axis=(0, 1))).astype(int) + 2
    low, high = np.maximum(low, 0), np.minimum(high, size[::-1])
    if (high <= low).any():
        return None
    step = 8 if scale < 8 else 4 if scale < 32 else 2
    canvas = np.zeros(((high[1] - low[1]) * step, (high[0] - low[0]) * step, 4), np.uint8)
    fixed = np.round(((points - low + 0.5) * step - 0.5) * 2**_BITS).astype(np.int32)
    code = np.clip(1 + outlines.up_m[start:end] * (254 / _TALLEST_M), 1, 255)
    colours = np.c_[np.clip(outlines.colour[start:end], 0, 255), code].tolist()
    for outline, colour in zip(fixed, colours, strict=True):
        cv2.fillConvexPoly(canvas, outline, colour, cv2.LINE_8, _BITS)
    return slice(low[1], high[1]), slice(low[0], high[0]), canvas, step


def _averaged(canvas: np.ndarray, step: int) -> np.ndarray:
    """An enlarged canvas at the picture's own size."""
    return cv2.resize(canvas, (canvas.shape[1] // step, canvas.shape[0] // step), interpolation=cv2.INTER_AREA)


def _shade(picture: np.ndarray, shadows: Outlines, scale: np.ndarray) -> None:
    """Darken a picture (H, W, 3) uint8 where shadows lie; where two lie on each other it is as dark as under one."""
    layer = np.zeros(picture.shape[:2], np.uint8)
    boxes = []
    for start, end in _runs(shadows.body):
        patch = _drawn(shadows, start, end, scale[int(shadows.body[start])], layer.shape)
        if patch is not None:
            rows, columns, canvas, step = patch
            cover = _averaged((canvas[..., 3] > 0).astype(np.uint8) * 255, step)
            np.maximum(layer[rows, columns], cover, out=layer[rows, columns])
            boxes.append((rows, columns))
    for rows, columns in boxes:
        # Taken off the layer when done, so that neighbours whose boxes overlap do not darken it twice.
        dark = layer[rows, columns, None].astype(np.float32) / 255 * (1 - SHADE_BGR)
        picture[rows, columns] = np.round(picture[rows, columns] * (1 - dark))
        layer[rows, columns] = 0
