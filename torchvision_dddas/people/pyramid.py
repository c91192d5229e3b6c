"""The image pyramid of the person detector: its levels, the parts of levels to search, and the windows in the parts.

Levels and windows are those of OpenCV's `HOGDescriptor::detectMultiScale`. A search of parts of the pyramid therefore
gives the same scores as a search of the whole pyramid.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from torchvision_dddas.config import PeopleParameters
from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Float, Part

# Time to resize a pixel of a level divided by the time to search it (5 ms and 140 ms for 1634 x 919).
_RESIZED = 0.04
_FEWEST_ALONG = 16  # fewest windows along a side of a tile; smaller tiles would mostly overlap their neighbours

# A rectangle of windows of a level: (first column, first row, last column, last row).
_Span = tuple[int, int, int, int]


@dataclass(frozen=True)
class Level:
    """A level of the pyramid. size: (width, height) in level pixels. scale: picture pixels in one level pixel."""

    size: tuple[int, int]
    scale: float


def levels(size: tuple[int, int], parameters: PeopleParameters) -> list[Level]:
    """Return the pyramid levels of a picture of (width, height) px, largest first.

    The levels end where the window no longer fits. The picture at its own size is one of them, as in OpenCV; levels
    before it are enlarged. A level with the same rounded size as the level before is left out.
    Raises InputError if the first level is smaller than the window.
    """
    width, height = parameters.window_width_px, parameters.window_height_px
    found: list[Level] = []
    scale = first = 1 / enlarged(parameters)
    for _ in range(parameters.max_levels):
        level = round(size[0] / scale), round(size[1] / scale)
        if level[0] < width or level[1] < height:
            break
        if not found or found[-1].size != level:
            found.append(Level(level, scale))
        scale *= parameters.scale_step
    if not found:
        raise InputError(
            f"a picture of {size[0]} x {size[1]} px, enlarged {1 / first:.3g} times, is smaller than the window of "
            f"{width} x {height} px; give a larger picture, or raise people.enlarge"
        )
    return found


def enlarged(parameters: PeopleParameters) -> float:
    """Return the scale of the first level: the largest power of the scale step that is at most `people.enlarge`."""
    return float(parameters.scale_step ** np.floor(np.log(parameters.enlarge) / np.log(parameters.scale_step) + 1e-9))


def smallest_body_px(parameters: PeopleParameters) -> float:
    """Return the height, in picture pixels, of the smallest body that the detector can find."""
    return parameters.height_share * parameters.window_height_px / enlarged(parameters)


def _padding(parameters: PeopleParameters) -> int:
    """Return the padding of each level, px, rounded up to the common grid of windows and blocks as in OpenCV."""
    grid = math.gcd(parameters.window_stride_px, parameters.block_stride_px)
    return -(-parameters.padding_px // grid) * grid


def everywhere(size: tuple[int, int], parameters: PeopleParameters) -> list[Part]:
    """Return every level as one part, with its padding."""
    pad = _padding(parameters)
    return [
        Part(level.size, -pad, -pad, level.size[0] + 2 * pad, level.size[1] + 2 * pad)
        for level in levels(size, parameters)
    ]


def count_windows(part: Part, parameters: PeopleParameters) -> tuple[int, int]:
    """Return how many windows a part contains, across and down."""
    stride = parameters.window_stride_px
    across = max((part.width - parameters.window_width_px) // stride + 1, 0)
    return across, max((part.height - parameters.window_height_px) // stride + 1, 0)


def cost(parts: Sequence[Part], parameters: PeopleParameters) -> int:
    """Return how many windows the parts contain."""
    return sum(math.prod(count_windows(part, parameters)) for part in parts)


def pixels(parts: Sequence[Part]) -> float:
    """Return the cost of searching parts, in pixels: their own pixels, and a share of all pixels of their levels."""
    made = sum(width * height for width, height in {part.level for part in parts})
    return sum(part.width * part.height for part in parts) + _RESIZED * made


def tiles(parts: Sequence[Part], most_px: float, parameters: PeopleParameters) -> list[Part]:
    """Cut parts into tiles of at most `most_px` pixels, but of at least _FEWEST_ALONG windows along each side."""
    stride, width, height = parameters.window_stride_px, parameters.window_width_px, parameters.window_height_px

    def along(room_px: float, window_px: int, most: int) -> int:
        """Return how many windows in a row fit into `room_px`, within _FEWEST_ALONG and `most`."""
        return min(max(int((room_px - window_px) // stride) + 1, _FEWEST_ALONG), most)

    cut = []
    for part in parts:
        across, down = count_windows(part, parameters)
        high = along(most_px / part.width, height, down)
        wide = along(most_px / (height + (high - 1) * stride), width, across)
        for top, bottom in split_evenly(down, high):
            for left, right in split_evenly(across, wide):
                size = (right - left - 1) * stride + width, (bottom - top - 1) * stride + height
                cut.append(Part(part.level, part.x + left * stride, part.y + top * stride, *size))
    return cut


def split_evenly(length: int, most: int) -> list[tuple[int, int]]:
    """Split a length into the fewest intervals (begin, end) of nearly equal length, each at most `most` long."""
    count = -(-length // most)
    return [(length * i // count, length * (i + 1) // count) for i in range(count)]


def within(
    regions_px: Float[np.ndarray, "R 4"],
    heights_px: Float[np.ndarray, "R 2"],
    size: tuple[int, int],
    parameters: PeopleParameters,
) -> list[Part]:
    """Return the parts whose windows can contain a body inside a region. Parts are merged if that saves pixels.

    regions_px: x, y, width, height in the picture. heights_px: smallest and largest height of a body in the region;
    NaN: any height that fits into the region. The heights are extended by half a scale step, so that at least one level
    fits a body. Windows have the same positions as in a search of the whole picture.
    """
    regions_px, heights_px = np.asarray(regions_px, float).reshape(-1, 4), np.asarray(heights_px, float).reshape(-1, 2)
    slack = parameters.scale_step**0.5
    least = np.where(np.isnan(heights_px[:, 0]), 0.0, heights_px[:, 0]) / slack
    largest = np.where(np.isnan(heights_px[:, 1]), regions_px[:, 3], heights_px[:, 1]) * slack
    stride, pad = parameters.window_stride_px, _padding(parameters)
    width, height = parameters.window_width_px, parameters.window_height_px

    def sides(span: _Span) -> tuple[int, int]:
        """Return the width and height in px that the windows of a span cover."""
        return (span[2] - span[0]) * stride + width, (span[3] - span[1]) * stride + height

    parts: list[Part] = []
    for level in levels(size, parameters):
        body = parameters.height_share * height * level.scale
        wanted = regions_px[(least <= body) & (body <= largest)]
        spans = sorted({span for region in wanted if (span := _span(region, level, parameters)) is not None})
        join = True
        while join:  # merge two spans while their common rectangle has no more pixels than both
            join = False
            for one, other in combinations(spans, 2):
                both = min(one[0], other[0]), min(one[1], other[1]), max(one[2], other[2]), max(one[3], other[3])
                if math.prod(sides(both)) <= math.prod(sides(one)) + math.prod(sides(other)):
                    spans = sorted({*(span for span in spans if span not in (one, other)), both})
                    join = True
                    break
        parts += [Part(level.size, span[0] * stride - pad, span[1] * stride - pad, *sides(span)) for span in spans]
    return parts


def _span(region: np.ndarray, level: Level, parameters: PeopleParameters) -> _Span | None:
    """Return the span of windows whose body lies in the region, rounded outwards; None outside the level."""
    width, height, stride = parameters.window_width_px, parameters.window_height_px, parameters.window_stride_px
    side = (1 - parameters.width_share) / 2 * width
    above, below = (parameters.feet_share - parameters.height_share) * height, (1 - parameters.feet_share) * height
    low = region[:2] / level.scale - (side, above)
    high = (region[:2] + region[2:]) / level.scale + (side, below) - (width, height)
    high = np.maximum(low, high)  # a region smaller than the body still has the window at its start
    pad = _padding(parameters)
    last = (np.array(level.size) + 2 * pad - (width, height)) // stride
    begin = np.floor((low + pad) / stride).astype(int)
    end = np.ceil((high + pad) / stride).astype(int)
    if (end < 0).any() or (begin > last).any():
        return None
    (left, top), (right, bottom) = np.maximum(begin, 0).tolist(), np.minimum(end, last).tolist()
    return left, top, right, bottom


def windows(
    parts: Sequence[Part], maps: Sequence[np.ndarray], size: tuple[int, int], parameters: PeopleParameters
) -> tuple[np.ndarray, np.ndarray]:
    """Return the windows with a score of at least the threshold, (N, 4) x, y, width, height in the picture, and scores.

    maps: (ny, nx) scores of each part. Windows that lie in several parts are returned once. With
    `suppression = "opencv"` windows are rounded to whole pixels, as in OpenCV.
    """
    scale_of = {level.size: level.scale for level in levels(size, parameters)}
    stride, window = parameters.window_stride_px, np.array([parameters.window_width_px, parameters.window_height_px])
    boxes, scores, seen = [np.zeros((0, 4))], [np.zeros(0)], [np.zeros((0, 4), int)]
    for part, scored in zip(parts, maps, strict=True):
        row, column = np.nonzero(scored >= parameters.threshold)
        place = np.stack([part.x + column * stride, part.y + row * stride], axis=1)
        box = np.concatenate([place, np.broadcast_to(window, place.shape)], axis=1)
        if parameters.suppression == "opencv":
            boxes.append(np.rint(box * scale_of[part.level]))
        else:  # the level's size was rounded, so its exact scale differs from `scale`
            across, down = size[0] / part.level[0], size[1] / part.level[1]
            boxes.append(box * (across, down, across, down))
        scores.append(scored[row, column].astype(np.float64))
        seen.append(np.concatenate([np.broadcast_to(part.level, place.shape), place], axis=1))
    _, first = np.unique(np.concatenate(seen), axis=0, return_index=True)
    first.sort()
    return np.concatenate(boxes)[first], np.concatenate(scores)[first]
