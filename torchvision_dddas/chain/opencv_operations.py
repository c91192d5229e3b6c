"""The operations of the detection chain in OpenCV, on 8-bit arrays with as few passes over memory as possible."""

from itertools import pairwise

import cv2
import numpy as np

from torchvision_dddas.chain.exposure import View, exposure_between
from torchvision_dddas.chain.operations import Operations
from torchvision_dddas.config import WHITE, exposure_step
from torchvision_dddas.geometry import occupied

# Inside a tile an affine map may replace a homography if they differ by at most this, px. OpenCV's own warps round
# positions to 1/32 px.
_TILE_ERROR_PX = 1 / 32
_MOST_TILES = 8
_STRIP_ROWS = 64
# The fit of an exposure has converged when no grey level changes by more than this. It needs at least _LEAST_PIXELS.
_SETTLED_LEVELS = 0.1
_LEAST_PIXELS = 100
_LEVELS = np.arange(256)
# Noise is measured in square regions with sides of REGION_PX, on every SAMPLED-th row and column.
REGION_PX, SAMPLED = 64, 4

Light = tuple[float, float]


class OpenCVOperations(Operations[View, np.ndarray, np.ndarray]):
    """Implements `Operations` on one picture at a time; masks are 0 and 255."""

    def grey(self, view: View) -> np.ndarray:
        """See `Operations`, also for all other methods."""
        return view.grey

    def texture(self, view: View) -> np.ndarray:
        return measure_texture(view.grey)

    def no_texture(self, view: View) -> np.ndarray:
        return no_texture(view.grey.shape)

    def warp(self, view: View, reference: View, view_from_reference: np.ndarray) -> np.ndarray:
        return warp(view.grey, view_from_reference)

    def seen(self, view: View, reference: View, view_from_reference: np.ndarray, border_px: int) -> np.ndarray:
        return find_seen(view_from_reference, reference.size, border_px)

    def seen_by_both(self, one: np.ndarray, other: np.ndarray, reference: View) -> np.ndarray:
        return cv2.bitwise_and(one, other)

    def fit_light(self, reference: View, warped: np.ndarray, seen: np.ndarray) -> Light:
        return fit_light(reference.grey, warped, seen)

    def fit_level_shares(self, reference: View, neighbour: View) -> Light:
        return exposure_between(reference, neighbour)

    def apply_light(self, reference: View, warped: np.ndarray, light: Light) -> np.ndarray:
        return apply_light(reference.grey, warped, *light)

    def difference(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return cv2.absdiff(one, other)

    def smaller(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return cv2.min(one, other)

    def larger(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        return cv2.max(one, other)

    def inside(self, picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
        return cv2.bitwise_and(picture, mask)

    def outside(self, picture: np.ndarray, mask: np.ndarray) -> np.ndarray:
        return cv2.bitwise_and(picture, cv2.bitwise_not(mask))

    def exceeds(self, picture: np.ndarray, level: float) -> np.ndarray:
        return cv2.threshold(picture, int(level), 255, cv2.THRESH_BINARY)[1]

    def stands_out(self, picture: np.ndarray, least: float, ratio: float) -> np.ndarray:
        return self.exceeds(picture, max(least, ratio * cv2.mean(picture)[0]))

    def noise_weight(self, texture: np.ndarray, noise_levels: float, gradient_share: float, scale: float) -> np.ndarray:
        noise = np.sqrt((_LEVELS * gradient_share / 4) ** 2 + noise_levels**2)
        return cv2.LUT(texture, (scale / noise).astype(np.float32))

    def weigh(self, picture: np.ndarray, weight: np.ndarray, most: float) -> np.ndarray:
        z = cv2.multiply(picture, weight, dtype=cv2.CV_8U)
        return cv2.threshold(z, most, most, cv2.THRESH_TRUNC)[1]

    def blur(self, picture: np.ndarray, side: int) -> np.ndarray:
        return picture if side == 1 else cv2.GaussianBlur(picture, (side, side), 0)

    def in_units_of_median(self, picture: np.ndarray, mask: np.ndarray, least: float) -> np.ndarray:
        most = median_above(picture, mask, least)
        if most == least:
            return picture
        height, width = picture.shape
        cells = regional_medians(picture[::SAMPLED, ::SAMPLED], mask[::SAMPLED, ::SAMPLED], least, most) / least
        size = cells.shape[1] * REGION_PX, cells.shape[0] * REGION_PX
        unit = cv2.resize(cells, size, interpolation=cv2.INTER_LINEAR)[:height, :width]
        return cv2.divide(picture, unit, dtype=cv2.CV_8U)

    def above(self, evidence: np.ndarray, limit: float) -> np.ndarray:
        return self.exceeds(evidence, limit)

    def erode(self, mask: np.ndarray, side: int) -> np.ndarray:
        return cv2.erode(mask, ellipse(side))

    def dilate(self, mask: np.ndarray, side: int) -> np.ndarray:
        return mask if side == 1 else cv2.dilate(mask, ellipse(side))

    def close(self, mask: np.ndarray, side: int) -> np.ndarray:
        return close_mask(mask, side)

    def halve(self, picture: np.ndarray) -> np.ndarray:
        height, width = (side // 2 for side in picture.shape)
        return cv2.resize(picture[: 2 * height, : 2 * width], (width, height), interpolation=cv2.INTER_AREA)


def no_texture(shape: tuple[int, ...]) -> np.ndarray:
    """Return a texture map of zeros that takes no memory."""
    return np.broadcast_to(np.uint8(0), shape)


def warp(picture: np.ndarray, picture_from_reference: np.ndarray) -> np.ndarray:
    """Warp a picture to the reference's coordinates, bilinear, (H, W) uint8. Border pixels are repeated outside.

    One affine map per tile takes half the time of `cv2.warpPerspective`, and stays within the 1/32 px to which both
    round positions. If that needs too many tiles, use a map of all pixel positions, which is as fast.
    """
    height, width = picture.shape
    # The error falls with the square of the number of tiles along a side, so that the error of one tile tells how many
    # are needed.
    tiles = np.array([[0, 0, width - 1, height - 1]])
    maps, error = _affine_maps(picture_from_reference, tiles)
    count = np.ceil(np.sqrt(error / _TILE_ERROR_PX))
    if not 0 <= count <= _MOST_TILES:
        return _warp_by_maps(picture, picture_from_reference)
    if count > 1:
        ends = (sorted({i * side // int(count) for i in range(int(count) + 1)}) for side in (width, height))
        columns, rows = ([(low, high - 1) for low, high in pairwise(side)] for side in ends)
        tiles = np.array([(left, top, right, bottom) for top, bottom in rows for left, right in columns])
        maps, _ = _affine_maps(picture_from_reference, tiles)
    warped = np.empty_like(picture)
    for (left, top, right, bottom), affine in zip(tiles.tolist(), maps, strict=True):
        tile, size = warped[top : bottom + 1, left : right + 1], (right - left + 1, bottom - top + 1)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        cv2.warpAffine(picture, affine, size, dst=tile, flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return warped


def _warp_by_maps(picture: np.ndarray, picture_from_reference: np.ndarray) -> np.ndarray:
    """Warp like `warp`, by the position of every pixel, in strips whose maps fit into the cache."""
    height, width = picture.shape
    by_column = np.outer(picture_from_reference[:, 0], np.arange(width))
    by_row = np.outer(picture_from_reference[:, 1], np.arange(height)) + picture_from_reference[:, 2:]
    across, down = by_column.astype(np.float32)[:, None], by_row.astype(np.float32)[:, :, None]
    warped = np.empty_like(picture)
    for top in range(0, height, _STRIP_ROWS):
        strip = slice(top, top + _STRIP_ROWS)
        u, v, depth = (a + b for a, b in zip(across, down[:, strip], strict=True))
        with np.errstate(divide="ignore", invalid="ignore"):
            u /= depth
            v /= depth
        cv2.remap(picture, u, v, cv2.INTER_LINEAR, dst=warped[strip], borderMode=cv2.BORDER_REPLICATE)
    return warped


def _affine_maps(to_from: np.ndarray, tiles: np.ndarray) -> tuple[np.ndarray, float]:
    """Return affine maps of tiles, (N, 2, 3), from pixel coordinates within the tile, and their largest error, px.

    The slopes are the means over opposite sides. The offset balances the errors at the corners and at the centre.
    """
    left, top, right, bottom = tiles.T.astype(float)
    from_places = np.empty((3, 5, len(tiles)))
    from_places[0] = left, right, left, right, (left + right) / 2
    from_places[1] = top, top, bottom, bottom, (top + bottom) / 2
    from_places[2] = 1
    away = to_from @ from_places.reshape(3, -1)
    with np.errstate(divide="ignore", invalid="ignore"):
        places = (away[:2] / away[2]).reshape(2, 5, -1)
    first, second, third, fourth, middle = places.transpose(1, 2, 0)
    wide, tall = np.maximum(right - left, 1)[:, None], np.maximum(bottom - top, 1)[:, None]
    by_u, by_v = (second + fourth - first - third) / (2 * wide), (third + fourth - first - second) / (2 * tall)
    twist = (first + fourth - second - third) / 4
    bulge = (middle - (first + second + third + fourth) / 4) / 2
    error = (np.abs(twist) + np.abs(bulge)).max() if (away[2] > 0).all() else np.inf
    maps = np.empty((len(tiles), 2, 3))
    maps[:, :, 0], maps[:, :, 1], maps[:, :, 2] = by_u, by_v, first - twist + bulge
    return maps, float(error)


def find_seen(picture_from_reference: np.ndarray, size: tuple[int, int], border: int) -> np.ndarray:
    """Return a (H, W) uint8 mask, 255 at the reference's pixels that the picture shows, without a strip at its border.

    border: width of the strip, px. size: (width, height) of both frames.
    """
    width, height = size
    right, bottom = width - 1 - border, height - 1 - border
    mask = np.zeros((height, width), np.uint8)
    if border > min(right, bottom):
        return mask
    corners = np.array([(border, right, right, border), (border, border, bottom, bottom), (1, 1, 1, 1)], float)
    reference_from_picture = np.linalg.inv(picture_from_reference)
    away = reference_from_picture @ corners
    if (away[2] / reference_from_picture[2, 2] > 0.1).all():
        outline = away[:2].T / away[2, :, None]
        cv2.fillConvexPoly(mask, np.round(16 * outline).astype(np.int32), 255, shift=4)
        return mask
    mask[border : bottom + 1, border : right + 1] = 255
    return cv2.warpPerspective(mask, picture_from_reference, size, flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)


def measure_texture(grey: np.ndarray) -> np.ndarray:
    """Return the mean gradient magnitude over 5x5 px, in 4 x grey levels a pixel, uint8."""
    steep = np.empty_like(grey)
    # Work in strips with an extra row on each side: float pictures of the whole frame would take 11 MB at 1280x720.
    for top in range(0, len(grey), _STRIP_ROWS):
        above, bottom = min(top, 1), top + _STRIP_ROWS
        strip = grey[top - above : bottom + 1]
        across = cv2.Sobel(strip, cv2.CV_32F, 1, 0, scale=0.5)
        down = cv2.Sobel(strip, cv2.CV_32F, 0, 1, scale=0.5)
        slope = cv2.convertScaleAbs(cv2.magnitude(across, down, across))
        steep[top:bottom] = slope[above : above + _STRIP_ROWS]
    return cv2.blur(steep, (5, 5))


def fit_light(reference: np.ndarray, warped: np.ndarray, seen: np.ndarray) -> tuple[float, float]:
    """Fit gain and offset from the warped picture to the reference by trimmed least squares on a sparse grid.

    seen: 255 where the pictures may be compared. All arrays are (H, W) uint8.
    """
    step = exposure_step(reference.shape)
    inside = seen[::step, ::step] > 0
    x, y = (picture[::step, ::step][inside].astype(np.float32) for picture in (warped, reference))
    if len(x) < _LEAST_PIXELS:
        return 1.0, 0.0
    gain, offset = 1.0, _lower_median(y - x)
    for _ in range(4):
        before = gain, offset
        away = np.abs(y - (np.float32(gain) * x + np.float32(offset)))
        kept = away <= max(3.7 * _lower_median(away), 3.0)
        given, wanted = x[kept], y[kept]
        mean = float(given.mean())
        deviation = given - np.float32(mean)
        spread = float(deviation @ deviation)
        gain = float(deviation @ wanted) / spread if spread > 1e-3 * len(given) else 1.0
        offset = float(wanted.mean()) - gain * mean
        if 255 * abs(gain - before[0]) + abs(offset - before[1]) < _SETTLED_LEVELS:
            break
    return gain, offset


def _lower_median(values: np.ndarray) -> float:
    middle = (len(values) - 1) // 2
    return float(np.partition(values, middle)[middle])


def apply_light(reference: np.ndarray, warped: np.ndarray, gain: float, offset: float) -> np.ndarray:
    """Apply gain and offset to the warped picture. A pixel clipped at white takes the reference's value if brighter."""
    table = np.clip(np.round(gain * _LEVELS + offset), 0, 255).astype(np.uint8)
    if (table == _LEVELS).all():
        return warped
    through = cv2.addWeighted(warped, gain, warped, 0, offset)  # the same result as the table, in less time
    if table[255] < WHITE:
        # The true brightness of a clipped pixel is unknown; it is only at least as high.
        cut = cv2.threshold(warped, WHITE - 1, 255, cv2.THRESH_BINARY)[1]
        cv2.copyTo(cv2.max(through, reference), cut, through)
    return through


def median_above(values: np.ndarray, mask: np.ndarray, least: float, enough: int = 500) -> float:
    """Return the median of values under a mask, at least `least`; `least` if at most `enough` pixels are set."""
    count = cv2.countNonZero(mask)
    if count <= enough:
        return least
    above = cv2.threshold(values, int(least), 255, cv2.THRESH_BINARY)[1]
    if 2 * cv2.countNonZero(cv2.bitwise_and(above, mask, dst=above)) < count:
        return least  # this is the usual case, and far cheaper than a histogram
    so_far = np.cumsum(cv2.calcHist([values], [0], mask, [256], [0, 256]).ravel())
    low, high = np.searchsorted(so_far, [(count + 1) // 2, count // 2 + 1])
    return max(least, (int(low) + int(high)) / 2)


def regional_medians(values: np.ndarray, mask: np.ndarray, least: float, most: float) -> np.ndarray:
    """Return the (R, C) float32 medians of values in regions of REGION_PX, clipped to least..most.

    values, mask: (h, w), every SAMPLED-th row and column. most: median of the whole picture. If the mask covers at
    most 10 % of a region, the region has the value `least`. The noise of other regions then does not hide targets in
    it. A median filter removes outliers among the regions.
    """
    side = REGION_PX // SAMPLED
    rows, columns = (-(-length // side) for length in values.shape)
    cells: np.ndarray = np.full((rows * side, columns * side), 999, np.int16)  # above all levels
    cells[: values.shape[0], : values.shape[1]] = np.where(mask > 0, values.astype(np.int16), 999)
    cells = np.sort(cells.reshape(rows, side, columns, side).swapaxes(1, 2).reshape(rows, columns, -1))
    count = (cells < 999).sum(axis=2)
    middle = np.take_along_axis(cells, (np.maximum(count - 1, 0) // 2)[..., None], axis=2)[..., 0]
    medians = np.where(count > 0.1 * side**2, middle, least).astype(np.float32)
    return np.clip(cv2.medianBlur(medians, 3), least, most)


def ellipse(side: int) -> np.ndarray:
    """Return the elliptical structuring element with this side."""
    return cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (side, side))


def close_mask(mask: np.ndarray, side: int) -> np.ndarray:
    """Close a mask with an ellipse. The result equals OpenCV's, but is computed only around set pixels."""
    if side <= 1:
        return mask
    out = np.zeros_like(mask)
    # The boxes are so far apart that the dilation reaches neither a box's edge nor the pixels of another box.
    for box in occupied(mask, side + 2):
        x, y, width, height = box
        part = np.s_[y : y + height, x : x + width]
        cv2.morphologyEx(mask[part], cv2.MORPH_CLOSE, ellipse(side), dst=out[part])
    return out
