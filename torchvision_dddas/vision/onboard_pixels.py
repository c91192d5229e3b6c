"""Pixel steps of the onboard back end, each in as few passes over 8-bit memory as it takes."""

import cv2
import numpy as np

from torchvision_dddas.targets.occupied import occupied
from torchvision_dddas.targets.projective import transfer

# An affine map may stand for a homography inside a tile where they differ by this much at most, px: OpenCV's own warps
# round places to 1/32 px.
_TILE_ERROR_PX = 1 / 32
_MOST_TILES = 6


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
    # The fit needs no more than how often each pair of grey levels occurs.
    pairs = cv2.calcHist([warped[::4, ::4], reference[::4, ::4]], [0, 1], seen[::4, ::4], [256, 256], [0, 256, 0, 256])
    x, y = np.nonzero(pairs)
    times = pairs[x, y].astype(np.float64)
    if times.sum() < 100:
        return warped
    x, y = x.astype(np.float64), y.astype(np.float64)
    gain, offset = 1.0, _weighted_median(y - x, times)
    for _ in range(4):
        miss = np.abs(gain * x + offset - y)
        weight = np.where(miss <= max(3.0, 3.7 * _weighted_median(miss, times)), times, 0.0)
        total = weight.sum()
        mean_x, mean_y = weight @ x / total, weight @ y / total
        spread = weight @ (x - mean_x) ** 2 / total
        gain = float(weight @ ((x - mean_x) * (y - mean_y)) / total / spread) if spread > 1e-3 else 1.0
        offset = float(mean_y - gain * mean_x)
    table = np.clip(np.round(gain * np.arange(256) + offset), 0, 255).astype(np.uint8)
    return cv2.LUT(warped, table)


def _weighted_median(values: np.ndarray, times: np.ndarray) -> float:
    """The median of values that occur so many times, to 1/64."""
    bins = np.floor(64 * values).astype(np.int64)
    lowest = bins.min()
    so_far = np.cumsum(np.bincount(bins - lowest, times))
    return float((np.searchsorted(so_far, so_far[-1] / 2) + lowest) / 64)


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
