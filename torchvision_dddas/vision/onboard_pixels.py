"""Pixel steps of the onboard back end, each in as few passes over 8-bit memory as it takes."""

import cv2
import numpy as np

from torchvision_dddas.targets.occupied import occupied
from torchvision_dddas.targets.projective import transfer

# An affine map may stand for a homography inside a tile where they differ by this much at most, px: OpenCV's own warps
# round places to 1/32 px.
_TILE_ERROR_PX = 1 / 32
# Distances between grey levels among which a median distance is sought; the first is that of the least trimming.
_DISTANCES = np.append(3 / 3.7 * 1.25 ** np.arange(19), 256.0)


def ellipse(side: int) -> np.ndarray:
    """A morphological kernel."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def warp(picture: np.ndarray, picture_from_reference: np.ndarray) -> np.ndarray:
    """The picture as the reference sees it, bilinear, (H, W) uint8; border pixels are repeated outside.

    `cv2.warpPerspective` divides for every pixel; one affine map a tile takes half its time and stays within the
    1/32 px to which both round places.
    """
    height, width = picture.shape
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    for tiles in (1, 2, 3, 4, 6):
        across, down = np.linspace(0, width, tiles + 1).astype(int), np.linspace(0, height, tiles + 1).astype(int)
        corners = _tile_corners(across, down)
        affine, error = _affine_maps(picture_from_reference, corners)
        if error <= _TILE_ERROR_PX:
            break
    else:
        return cv2.warpPerspective(
            picture, picture_from_reference, (width, height), flags=flags, borderMode=cv2.BORDER_REPLICATE
        )
    warped = np.empty_like(picture)
    for (left, top, right, bottom), tile_map in zip((corners + np.array([0, 0, 1, 1])).tolist(), affine, strict=True):
        tile, size = warped[top:bottom, left:right], (right - left, bottom - top)
        cv2.warpAffine(picture, tile_map, size, dst=tile, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return warped


def _tile_corners(across: np.ndarray, down: np.ndarray) -> np.ndarray:
    """(N, 4) first column, first row, last column, last row of every tile."""
    top, left = (a.ravel() for a in np.meshgrid(down[:-1], across[:-1], indexing="ij"))
    bottom, right = (a.ravel() for a in np.meshgrid(down[1:], across[1:], indexing="ij"))
    return np.stack([left, top, right - 1, bottom - 1], axis=1)


def _affine_maps(to_from: np.ndarray, tiles: np.ndarray) -> tuple[np.ndarray, float]:
    """The tiles' affine maps, (N, 2, 3), fitted to their four corners, and the largest error there in pixels.

    They map pixels counted within the tile.
    """
    left, top, right, bottom = tiles.T.astype(float)
    corners = np.stack([[left, right, left, right], [top, top, bottom, bottom]], axis=-1)
    first, second, third, fourth = transfer(to_from, corners.reshape(-1, 2)).reshape(4, -1, 2)
    # Over a rectangle's corners the least-squares plane has the mean of opposite sides as slopes, and misses all four
    # corners by the same amount.
    wide, tall = np.maximum(right - left, 1)[:, None], np.maximum(bottom - top, 1)[:, None]
    by_u, by_v = (second + fourth - first - third) / (2 * wide), (third + fourth - first - second) / (2 * tall)
    miss = (first + fourth - second - third) / 4
    return np.stack([by_u, by_v, first - miss], axis=2), float(np.linalg.norm(miss, axis=1).max())


def inside(picture_from_reference: np.ndarray, size: tuple[int, int], border: int) -> np.ndarray:
    """255 where the reference's pixels see the picture, a strip inside its border left out; (H, W) uint8.

    size: (width, height) of both.
    """
    width, height = size
    first, last = (border, border), (width - 1 - border, height - 1 - border)
    mask = np.zeros((height, width), np.uint8)
    if first[0] > last[0] or first[1] > last[1]:
        return mask
    corners = np.array([first, (last[0], first[1]), last, (first[0], last[1])], float)
    reference_from_picture = np.linalg.inv(picture_from_reference)
    depth = np.c_[corners, np.ones(4)] @ (reference_from_picture / reference_from_picture[2, 2])[2]
    if (depth > 0.1).all():
        outline = transfer(reference_from_picture, corners)
        cv2.fillConvexPoly(mask, np.round(16 * outline).astype(np.int32), 255, shift=4)
        return mask
    mask[first[1] : last[1] + 1, first[0] : last[0] + 1] = 255
    return cv2.warpPerspective(mask, picture_from_reference, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)


def texture_of(grey: np.ndarray) -> np.ndarray:
    """Mean gradient magnitude over 5x5 px, 4 x grey levels a pixel, uint8."""
    across = cv2.Sobel(grey, cv2.CV_32F, 1, 0, scale=0.5)
    down = cv2.Sobel(grey, cv2.CV_32F, 0, 1, scale=0.5)
    return cv2.blur(cv2.convertScaleAbs(cv2.magnitude(across, down)), (5, 5))


def exposed(reference: np.ndarray, warped: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """The warped picture in the reference's exposure: gain and offset by trimmed least squares on every 4th pixel.

    seen: 255 where the warped picture may be compared. All are (H, W) uint8.
    """
    samples = [warped[::4, ::4], reference[::4, ::4]]
    # The fit needs no more than how often each pair of grey levels occurs.
    pairs = _GreyPairs(cv2.calcHist(samples, [0, 1], seen[::4, ::4], [256, 256], [0, 256, 0, 256]))
    if pairs.count < 100:
        return warped
    x = np.arange(256.0)
    gain, offset = 1.0, pairs.median_offset()
    for _ in range(4):
        middle = gain * x + offset
        reach = pairs.trimming(middle)
        n, y = pairs.near(middle, reach)
        total = n.sum()
        mean_x, mean_y = n @ x / total, y.sum() / total
        spread = n @ (x - mean_x) ** 2 / total
        gain = float((x - mean_x) @ y / total / spread) if spread > 1e-3 else 1.0
        offset = float(mean_y - gain * mean_x)
    table = np.clip(np.round(gain * x + offset), 0, 255).astype(np.uint8)
    return cv2.LUT(warped, table)


class _GreyPairs:
    """How often grey level y meets grey level x in two pictures; summed along y: a band of y takes two looks."""

    def __init__(self, times: np.ndarray) -> None:
        """times: (256, 256), x down, y across."""
        self.below = _sums_along(times)
        self.sum_below = _sums_along(times * np.arange(256, dtype=np.float32))
        self.count = float(self.below[:, -1].sum())

    def near(self, middle: np.ndarray, reach: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(..., 256) for each x: how many y lie within `reach` of `middle`, and their sum."""
        x = np.arange(256)
        low = np.clip(np.ceil(middle - reach), 0, 256).astype(int)
        high = np.clip(np.floor(middle + reach) + 1, low, 256).astype(int)
        return self.below[x, high] - self.below[x, low], self.sum_below[x, high] - self.sum_below[x, low]

    def median_offset(self) -> float:
        """The median of y - x."""
        x, low, high = np.arange(256), -255, 255
        while low < high:
            middle = (low + high) // 2
            if 2 * self.below[x, np.clip(x + middle + 1, 0, 256)].sum() >= self.count:
                high = middle
            else:
                low = middle + 1
        return float(low)

    def trimming(self, middle: np.ndarray) -> float:
        """How far y may lie from `middle`: 3.7 times the median distance, at least 3 levels."""
        if 2 * self.near(middle, _DISTANCES[0])[0].sum() >= self.count:
            return 3.0
        held = self.near(middle, _DISTANCES[:, None])[0].sum(axis=1)
        return 3.7 * float(np.interp(self.count / 2, held, _DISTANCES))


def _sums_along(values: np.ndarray) -> np.ndarray:
    """(H, W + 1) float64 sums of all values to the left: five times as quick as `np.cumsum`."""
    return np.diff(cv2.integral(values, sdepth=cv2.CV_64F), axis=0)


def median_above(values: np.ndarray, mask: np.ndarray, least: float, enough: int = 500) -> float:
    """The larger of `least` and the median of uint8 values where a mask is set; `least` if that is hardly anywhere."""
    count = cv2.countNonZero(mask)
    if count <= enough:
        return least
    above = cv2.threshold(values, int(least), 255, cv2.THRESH_BINARY)[1]
    if 2 * cv2.countNonZero(cv2.bitwise_and(above, mask, dst=above)) < count:
        return least  # the usual case, at a fraction of a histogram's cost
    so_far = np.cumsum(cv2.calcHist([values], [0], mask, [256], [0, 256]).ravel())
    low, high = np.searchsorted(so_far, [(count + 1) // 2, count // 2 + 1])
    return max(least, (int(low) + int(high)) / 2)


def closed(mask: np.ndarray, side: int) -> np.ndarray:
    """The mask closed with an ellipse, to the bit as OpenCV closes it, but only where it is set at all."""
    if side <= 1:
        return mask
    kernel = ellipse(side)
    # A pixel's closing depends on what lies less than 2 x side away.
    boxes = occupied(mask, 2 * side)
    out = np.zeros_like(mask)
    for x, y, w, h in boxes:
        part = np.s_[y : y + h, x : x + w]
        cv2.morphologyEx(mask[part], cv2.MORPH_CLOSE, kernel, dst=out[part])
    return out
