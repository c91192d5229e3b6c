"""What stands on the ground: bushes, trees and buildings, where they are and how high and coloured they look from above."""

from dataclasses import dataclass

import cv2
import numpy as np

_BUSH, _TREE, _ROOFS = (
    np.array([[70, 104, 98], [62, 92, 92], [86, 112, 112], [58, 96, 84]], float),
    np.array([[56, 92, 82], [48, 82, 76], [70, 108, 100]], float),
    np.array([[176, 182, 186], [92, 104, 150], [128, 138, 146], [120, 150, 178]], float),
)
_TRIES = 20


@dataclass(frozen=True)
class Things:
    """What stands in the world. kind: (K,) bush, tree or building. east_north_m: (K, 2) middles.

    radius_m: (K,) of the circle about all of it. height_m: (K,). colour: (K, 3) BGR. Buildings are boxes: half_m (K, 2)
    half their length and width, heading_rad (K,) of the length, clockwise from north; crowns are as long as wide.
    """

    kind: np.ndarray
    east_north_m: np.ndarray
    radius_m: np.ndarray
    height_m: np.ndarray
    colour: np.ndarray
    half_m: np.ndarray
    heading_rad: np.ndarray

    def __len__(self) -> int:
        return len(self.kind)


def scatter(
    counts: tuple[int, int, int],
    side_m: float,
    wished: np.ndarray,
    built: np.ndarray,
    clear: tuple[np.ndarray, float],
    rng: np.random.Generator,
) -> Things:
    """So many bushes, trees and buildings on free places.

    wished, built: (h, w) pictures of the world, row 0 the north edge: how well plants and buildings stand there, 0 to 1.
    clear: places (N, 2) and how near to them nothing stands. Nothing overlaps a building. What finds no place is left
    out.
    """
    kind = np.repeat(["building", "tree", "bush"], counts[::-1])
    total = len(kind)
    half = np.zeros((total, 2))
    of = {name: kind == name for name in ("building", "tree", "bush")}
    half[of["building"]] = rng.uniform((3.5, 2.5), (7.5, 4.5), (counts[2], 2))
    half[of["tree"]] = rng.uniform(1.6, 3.4, (counts[1], 1))
    half[of["bush"]] = np.clip(rng.lognormal(-0.35, 0.4, (counts[0], 1)), 0.3, 1.8)
    radius = np.where(of["building"], np.hypot(*half.T), half[:, 0])
    height = np.where(of["building"], rng.uniform(2.8, 4.5, total), radius * rng.uniform(1.0, 1.5, total))
    heading = rng.uniform(0, np.pi, total)
    places, stands = np.zeros((total, 2)), np.zeros(total, bool)
    for k in range(total):
        ground = built if of["building"][k] else wished
        for east, north, chance in rng.uniform((-0.5, -0.5, 0), (0.5, 0.5, 1), (_TRIES, 3)):
            place = side_m * np.array([east, north])
            row, column = int((0.5 - north) * ground.shape[0]), int((east + 0.5) * ground.shape[1])
            if chance > ground[min(row, ground.shape[0] - 1), min(column, ground.shape[1] - 1)]:
                continue
            if np.abs(place).max() + radius[k] > side_m / 2:
                continue
            if len(clear[0]) and np.hypot(*(clear[0] - place).T).min() < clear[1] + radius[k]:
                continue
            walls = stands & of["building"]
            if (np.hypot(*(places[walls] - place).T) < radius[walls] + radius[k] + 0.5).any():
                continue
            places[k], stands[k] = place, True
            break
    tints = {"bush": _BUSH, "tree": _TREE, "building": _ROOFS}
    colour = np.array([tints[name][rng.integers(len(tints[name]))] for name in kind]).reshape(-1, 3)
    colour = np.clip(colour * rng.uniform(0.85, 1.15, (total, 1)), 0, 255)
    return Things(*(field[stands] for field in (kind, places, radius, height, colour, half, heading)))


class Crowns:
    """Shapes of things as seen from above, on any grid."""

    def __init__(self, things: Things, side_m: float, seed: int) -> None:
        self.things, self.side_m, self.seed = things, side_m, seed
        rng = np.random.default_rng([seed, 21])
        self._moulds = [_mould(rng) for _ in range(12)]
        self._which = rng.integers(0, (len(self._moulds), 8), (len(things), 2))

    def surface(self, cells: int) -> np.ndarray:
        """(cells, cells) float32 metres above the ground, row 0 the north edge."""
        heights = np.zeros((cells, cells), np.float32)
        texel = self.side_m / cells
        for k in range(len(self.things)):
            shape, (row, column) = self._shape(k, texel)
            part, cut = _overlap(heights, shape, row, column)
            if part.size:
                np.maximum(part, shape[cut], out=part)
        return heights

    def paint(self, image: np.ndarray, first_row: int, texel_m: float, to_sun: np.ndarray) -> None:
        """Draw the crowns and roofs, in the sun, into rows of a picture (n, W, 3) float32, from first_row on."""
        things = self.things
        middle_row = (self.side_m / 2 - things.east_north_m[:, 1]) / texel_m
        reach = things.radius_m / texel_m + 2
        near = (middle_row + reach > first_row) & (middle_row - reach < first_row + len(image))
        # The highest last: a crown hides the lower ones under it.
        for k in np.flatnonzero(near)[np.argsort(things.height_m[near])]:
            shape, (row, column) = self._shape(int(k), texel_m)
            part, cut = _overlap(image, shape, row - first_row, column)
            if not part.size:
                continue
            look = self._look(int(k), shape, texel_m, to_sun)[cut]
            seen = np.clip(shape[cut] / (0.12 * things.height_m[k]), 0, 1)[..., None]
            part += seen * (look - part)

    def _shape(self, k: int, texel_m: float) -> tuple[np.ndarray, tuple[int, int]]:
        """(n, n) float32 heights of one thing, and the row and column of its first pixel."""
        things = self.things
        reach = int(np.ceil(things.radius_m[k] / texel_m)) + 1
        place = things.east_north_m[k]
        column = int(np.floor((place[0] + self.side_m / 2) / texel_m)) - reach
        row = int(np.floor((self.side_m / 2 - place[1]) / texel_m)) - reach
        size = 2 * reach + 1
        if things.kind[k] == "building":
            east, north = self._metres(k, row, column, size, texel_m)
            along, aside = self._own_axes(k, east, north)
            inside = np.minimum(things.half_m[k, 0] - np.abs(along), things.half_m[k, 1] - np.abs(aside))
            return (np.clip(inside / texel_m + 0.5, 0, 1) > 0.5).astype(np.float32) * np.float32(things.height_m[k]), (
                row,
                column,
            )
        mould, turn = self._which[k]
        shape = np.rot90(self._moulds[mould], turn % 4)
        shape = shape.T if turn >= 4 else shape
        shape = cv2.resize(np.ascontiguousarray(shape), (size, size), interpolation=cv2.INTER_AREA)
        return shape * np.float32(things.height_m[k]), (row, column)

    def _look(self, k: int, shape: np.ndarray, texel_m: float, to_sun: np.ndarray) -> np.ndarray:
        """(n, n, 3) colours of a thing in the sun."""
        things, rng = self.things, np.random.default_rng([self.seed, 22, k])
        colour = things.colour[k].astype(np.float32)
        spread = rng.standard_normal(shape.shape, np.float32)
        if things.kind[k] == "building":
            reach = shape.shape[0] // 2
            step = (np.arange(shape.shape[0]) - reach) * texel_m
            along, _ = self._own_axes(k, *np.meshgrid(step, -step))
            ribs = 0.05 * np.sign(np.sin(2 * np.pi * along / 0.9))
            return (1 + ribs + 0.02 * spread).astype(np.float32)[..., None] * colour
        leaves = 0.16 * spread + 0.14 * cv2.GaussianBlur(spread, (0, 0), 1.2) * 3
        slope_row, slope_column = np.gradient(shape, texel_m)
        slope = np.stack([-slope_column, slope_row], axis=-1).clip(-1.5, 1.5) @ to_sun[:2].astype(np.float32)
        light = (to_sun[2] + slope) / np.sqrt(1 + np.minimum(slope_row**2 + slope_column**2, 4)) / to_sun[2]
        return colour * ((0.35 + 0.65 * np.clip(light, 0, 1.5)) * (1 + leaves))[..., None].astype(np.float32)

    def _metres(self, k: int, row: int, column: int, size: int, texel_m: float) -> tuple[np.ndarray, np.ndarray]:
        """East and north of a patch's pixels from the thing's middle."""
        east = (column + np.arange(size) + 0.5) * texel_m - self.side_m / 2 - self.things.east_north_m[k, 0]
        north = self.side_m / 2 - (row + np.arange(size) + 0.5) * texel_m - self.things.east_north_m[k, 1]
        grid = np.meshgrid(east, north)
        return grid[0], grid[1]

    def _own_axes(self, k: int, east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        sine, cosine = np.sin(self.things.heading_rad[k]), np.cos(self.things.heading_rad[k])
        return east * sine + north * cosine, east * cosine - north * sine


def _overlap(image: np.ndarray, shape: np.ndarray, row: int, column: int) -> tuple[np.ndarray, tuple[slice, slice]]:
    """The part of a picture that a patch laid at (row, column) covers, and which part of the patch that is."""
    top, left = max(row, 0), max(column, 0)
    bottom, right = min(row + shape.shape[0], image.shape[0]), min(column + shape.shape[1], image.shape[1])
    bottom, right = max(bottom, top), max(right, left)
    return image[top:bottom, left:right], (slice(top - row, bottom - row), slice(left - column, right - column))


def _mould(rng: np.random.Generator, size: int = 96) -> np.ndarray:
    """(size, size) float32 in [0, 1]: a rough crown of a few overlapping domes."""
    axis = (np.arange(size, dtype=np.float32) + 0.5) / size * 2 - 1
    u, v = np.meshgrid(axis, axis)
    noise = sum(
        (0.5**k) * cv2.resize(rng.standard_normal((n, n), np.float32), (size, size), interpolation=cv2.INTER_CUBIC)
        for k, n in enumerate((5, 10, 20, 40))
    )
    crown = np.zeros((size, size), np.float32)
    for _ in range(int(rng.integers(3, 8))):
        reach = rng.uniform(0.35, 0.75)
        turn, off = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.9 - reach)
        apart = np.hypot(u - off * np.cos(turn), v - off * np.sin(turn)) / reach
        dome = np.sqrt(np.clip(1 - apart**2, 0, 1)) * (0.55 + 0.6 * reach)
        crown = np.maximum(crown, dome)
    rough = crown * (1 + 0.22 * noise) - 0.12 * np.abs(noise)
    return np.clip(rough / rough.max(), 0, 1).astype(np.float32)
