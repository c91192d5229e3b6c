"""Objects that stand on the ground: bushes, trees, buildings. Their places, heights and views from above."""

from dataclasses import dataclass

import cv2
import numpy as np

# BGR colours in a photo in full sun. Bushes: creosote, saltbush, burroweed, dry. Trees: mesquite, palo verde, juniper.
_TINTS = {
    "bush": np.array([[78, 112, 108], [108, 126, 124], [80, 116, 120], [100, 122, 134]], float),
    "tree": np.array([[72, 110, 106], [84, 126, 120], [62, 94, 88]], float),
    "building": np.array([[196, 200, 204], [92, 104, 150], [140, 150, 158], [124, 156, 184]], float),
}
_TRIES = 20
_POLE_M = 0.25  # thickness of a pole


@dataclass(frozen=True)
class StandingObjects:
    """Objects of the world. kind: (K,) bush, tree or building. east_north_m: (K, 2) middles.

    radius_m: (K,) of the enclosing circle. height_m: (K,). colour: (K, 3) BGR. Buildings are boxes: half_m (K, 2) is
    half their length and width, heading_rad (K,) the direction of the length, clockwise from north. Crowns are round.
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


def scatter_objects(
    counts: tuple[int, int, int, int],
    side_m: float,
    wished: np.ndarray,
    built: np.ndarray,
    clear: tuple[np.ndarray, float],
    rng: np.random.Generator,
) -> StandingObjects:
    """Place `counts` bushes, trees, buildings and poles on free ground. A pole is a thin, high building.

    wished, built: (h, w) maps of the world, row 0 at the north edge: probability from 0 to 1 that the ground accepts a
    plant or a building. clear: places (N, 2), and the distance from them within which no object stands. No object
    overlaps a building. Objects that find no place are left out.
    """
    kind = np.repeat(["building", "building", "tree", "bush"], [counts[2], counts[3], counts[1], counts[0]])
    total, half = len(kind), np.zeros((len(kind), 2))
    is_building = kind == "building"
    half[: counts[2]] = rng.uniform((3.5, 2.5), (7.5, 4.5), (counts[2], 2))
    half[counts[2] : counts[2] + counts[3]] = _POLE_M / 2
    half[kind == "tree"] = rng.uniform(1.6, 3.4, (counts[1], 1))
    half[kind == "bush"] = np.clip(rng.lognormal(-0.35, 0.4, (counts[0], 1)), 0.3, 1.8)
    radius = np.where(is_building, np.hypot(*half.T), half[:, 0])
    height = np.where(is_building, rng.uniform(2.8, 4.5, total), radius * rng.uniform(1.0, 1.5, total))
    height[counts[2] : counts[2] + counts[3]] *= 1.8
    heading = rng.uniform(0, np.pi, total)
    tries = rng.uniform((-0.5, -0.5, 0), (0.5, 0.5, 1), (total, _TRIES, 3))
    places, good = side_m * tries[..., :2], np.empty((total, _TRIES), bool)
    for some, ground in ((~is_building, wished), (is_building, built)):
        row = np.minimum((0.5 - tries[some, :, 1]) * ground.shape[0], ground.shape[0] - 1).astype(int)
        column = np.minimum((0.5 + tries[some, :, 0]) * ground.shape[1], ground.shape[1] - 1).astype(int)
        good[some] = tries[some, :, 2] <= ground[row, column]
    good &= np.abs(places).max(axis=2) + radius[:, None] < side_m / 2
    for place in clear[0]:
        good &= np.hypot(*(places - place).transpose(2, 0, 1)) >= clear[1] + radius[:, None]
    # Buildings come first. Later objects keep away from them.
    for k in range(counts[2] + counts[3]):
        if good[k].any():
            off = np.hypot(*(places - places[k, np.argmax(good[k])]).transpose(2, 0, 1))
            good[k + 1 :] &= off[k + 1 :] > radius[k] + radius[k + 1 :, None] + 0.5
    stands = good.any(axis=1)
    chosen = places[np.arange(total), np.argmax(good, axis=1)]
    colour = np.array([_TINTS[name][rng.integers(len(_TINTS[name]))] for name in kind]).reshape(-1, 3)
    colour = np.clip(colour * rng.uniform(0.85, 1.15, (total, 1)), 0, 255)
    return StandingObjects(*(field[stands] for field in (kind, chosen, radius, height, colour, half, heading)))


class Crowns:
    """Shapes of objects as seen from above, on any grid."""

    def __init__(self, things: StandingObjects, side_m: float, seed: int) -> None:
        self._things, self._side_m, self._seed = things, side_m, seed
        rng = np.random.default_rng([seed, 21])
        self._moulds = [_mould(rng) for _ in range(16)]
        self._which = rng.integers(0, (len(self._moulds), 8), (len(things), 2))

    def surface(self, cells: int) -> np.ndarray:
        """Return (cells, cells) float32 heights above the ground in metres, row 0 at the north edge."""
        heights = np.zeros((cells, cells), np.float32)
        for k in range(len(self._things)):
            shape, row, column = self._shape(k, self._side_m / cells)
            part, cut = _overlap(heights, shape.shape[0], row, column)
            np.maximum(part, shape[cut], out=part)
        return heights

    def paint(self, image: np.ndarray, first_row: int, texel_m: float, to_sun: np.ndarray) -> None:
        """Draw sunlit crowns and roofs into a picture (3, n, W) float32 of the world's rows from first_row on."""
        things, rows = self._things, image.shape[1]
        middle_row = (self._side_m / 2 - things.east_north_m[:, 1]) / texel_m
        reach = things.radius_m / texel_m + 2
        near = np.flatnonzero((middle_row + reach > first_row) & (middle_row - reach < first_row + rows))
        # Draw the highest objects last, because a crown hides lower crowns.
        for k in near[np.argsort(things.height_m[near], kind="stable")].tolist():
            shape, row, column = self._shape(k, texel_m)
            part, cut = _overlap(image, shape.shape[0], row - first_row, column)
            if part.size:
                colour, seen = self._colour(k, shape, row, column, texel_m, to_sun)
                part += seen[cut] * (colour[:, *cut] - part)

    def _shape(self, k: int, texel_m: float) -> tuple[np.ndarray, int, int]:
        """Return (n, n) float32 heights of one object, and the row and column of its first pixel."""
        things, half = self._things, self._side_m / 2
        east, north = things.east_north_m[k]
        reach = int(np.ceil(things.radius_m[k] / texel_m))
        row = int(np.floor((half - north) / texel_m)) - reach
        column = int(np.floor((east + half) / texel_m)) - reach
        size, height = 2 * reach + 1, np.float32(things.height_m[k])
        if things.kind[k] == "building":
            along, aside = self._own_metres(k, row, column, size, texel_m)
            walls = (np.abs(along) < things.half_m[k, 0]) & (np.abs(aside) < things.half_m[k, 1])
            return walls * height, row, column
        mould, turn = self._which[k]
        shape = np.rot90(self._moulds[mould], turn % 4)
        shape = np.ascontiguousarray(shape.T if turn >= 4 else shape)
        wide = 2 * things.radius_m[k] / texel_m
        if wide < len(shape):
            shape = cv2.resize(shape, (max(round(wide), 3),) * 2, interpolation=cv2.INTER_AREA)
        # Warp to the exact place and size, which are fractions of pixels.
        scale = len(shape) / wide
        middle = np.array([(east + half) / texel_m - column, (half - north) / texel_m - row])
        matrix = np.c_[scale * np.eye(2), scale * (0.5 - middle) + (len(shape) - 1) / 2]
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        return cv2.warpAffine(shape, matrix, (size, size), flags=flags) * height, row, column

    def _colour(
        self, k: int, shape: np.ndarray, row: int, column: int, texel_m: float, to_sun: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return the sunlit colours (3, n, n) of an object, and the share (n, n) of each pixel that it covers."""
        things, rng = self._things, np.random.default_rng([self._seed, 22, k])
        colour = things.colour[k].astype(np.float32)[:, None, None]
        spread = rng.standard_normal(shape.shape, np.float32)
        if things.kind[k] == "building":
            along, _ = self._own_metres(k, row, column, shape.shape[0], texel_m)
            ribs = 0.04 * np.sign(np.sin(2 * np.pi * along / 0.9))
            stains = cv2.GaussianBlur(spread, (0, 0), 0.8 / texel_m) * np.float32(0.1 / texel_m)
            return colour * (1 + ribs + 0.025 * spread + stains).astype(np.float32), np.sign(shape)
        # Twigs fill half of a pixel at the rim. Clusters of leaves lie higher and are brighter than the gaps.
        leaves = 0.1 * spread + 0.12 * cv2.GaussianBlur(spread, (0, 0), 1.2) * 4
        down, right = np.gradient(shape, texel_m)
        facing = np.clip(down * to_sun[1] - right * to_sun[0], -0.6, 0.6)
        deep = shape / cv2.GaussianBlur(shape, (0, 0), max(0.35 / texel_m, 0.5)).clip(1e-3)
        light = np.clip(1 + 0.45 * facing + leaves, 0.35, 1.45) * np.clip(deep, 0.4, 1.15)
        seen = np.clip(shape / (0.22 * things.height_m[k]) + 0.5 * leaves, 0, 1)
        return colour * light.astype(np.float32), np.where(shape > 0, seen, 0).astype(np.float32)

    def _own_metres(self, k: int, row: int, column: int, size: int, texel_m: float) -> tuple[np.ndarray, np.ndarray]:
        """Return metres along and across an object's heading from its middle, (n, n) each, for a patch's pixels."""
        east = (column + np.arange(size) + 0.5) * texel_m - self._side_m / 2 - self._things.east_north_m[k, 0]
        north = self._side_m / 2 - (row + np.arange(size)[:, None] + 0.5) * texel_m - self._things.east_north_m[k, 1]
        sine, cosine = np.sin(self._things.heading_rad[k]), np.cos(self._things.heading_rad[k])
        return east * sine + north * cosine, east * cosine - north * sine


def _overlap(image: np.ndarray, size: int, row: int, column: int) -> tuple[np.ndarray, tuple[slice, slice]]:
    """Return the part of a picture (..., H, W) that a patch at (row, column) covers, and the covering patch slices."""
    top, bottom = np.clip((row, row + size), 0, image.shape[-2]).tolist()
    left, right = np.clip((column, column + size), 0, image.shape[-1]).tolist()
    cut = slice(top - row, bottom - row), slice(left - column, right - column)
    return image[..., top:bottom, left:right], cut


def _mould(rng: np.random.Generator, size: int = 96) -> np.ndarray:
    """Draw a crown of overlapping domes with gaps and a ragged rim, (size, size) float32 in [0, 1]."""
    axis = (np.arange(size, dtype=np.float32) + 0.5) / size * 2 - 1
    u, v = np.meshgrid(axis, axis)
    noise = np.zeros((size, size), np.float32)
    for k, cells in enumerate((5, 10, 20, 40)):
        small = rng.standard_normal((cells, cells), np.float32)
        noise += np.float32(0.65**k) * cv2.resize(small, (size, size), interpolation=cv2.INTER_CUBIC)
    crown = np.zeros((size, size), np.float32)
    for _ in range(int(rng.integers(5, 12))):
        reach = rng.uniform(0.25, 0.6)
        turn, off = rng.uniform(0, 2 * np.pi), rng.uniform(0, 0.95 - reach)
        apart = np.hypot(u - off * np.cos(turn), v - off * np.sin(turn)) / reach + 0.12 * noise
        dome = np.sqrt(np.clip(1 - apart**2, 0, 1)) * np.float32(0.5 + 0.7 * reach)
        crown = np.maximum(crown, dome)
    rough = (crown * (1 + 0.2 * noise) - 0.05) * (np.hypot(u, v) < 1)
    return np.clip(rough / rough.max(), 0, 1).astype(np.float32)
