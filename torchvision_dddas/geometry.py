"""Small geometry that all fields share: boxes, plane maps, rotations, matching, places on the Earth. NumPy only."""

import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from math import atan2, cos, sin, sqrt
from typing import Any

import cv2
import numpy as np

from torchvision_dddas.errors import InputError
from torchvision_dddas.types import Camera, Float, Int, Poses, PoseTable

Box = tuple[int, int, int, int]
# Masks are searched in blocks of this side, px.
_BLOCK_PX = 16
# Length of a degree of latitude to the source, everywhere. On the ellipsoid it is 110 574 m to 111 694 m.
DEGREE_M = 111_320.0
# So many points at once: the intermediate results stay in the cache, which halves the time of a million points.
_PART = 1 << 14
# The detection interval that distances to near frames are meant for.
_NEAR_INTERVAL = 3

Degrees = Float[np.ndarray, "*n 2"] | tuple[float, float]
"""Longitude and latitude."""


# Boxes and masks.


def shared_px(box_px: np.ndarray, other_px: np.ndarray) -> np.ndarray:
    """(...) area in both of two boxes (..., 4), broadcast against each other; 0 where they lie apart."""
    low = np.maximum(box_px[..., :2], other_px[..., :2])
    high = np.minimum(box_px[..., :2] + box_px[..., 2:], other_px[..., :2] + other_px[..., 2:])
    across, down = np.moveaxis(high - low, -1, 0)
    return np.maximum(across, 0) * np.maximum(down, 0)


def inside(points: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """(P, N) bool: which points lie in which boxes."""
    offset = points[:, None] - boxes[None, :, :2] + 0.5
    return ((offset >= 0) & (offset <= boxes[None, :, 2:])).all(axis=2)


def window_of(box: np.ndarray, shape: tuple[int, ...]) -> tuple[slice, slice]:
    """The rows and columns of a box in a picture (H, W, ...), as far as it is inside."""
    left, top, right, bottom = (round(v) for v in (*box[:2], *(box[:2] + box[2:])))
    return slice(max(top, 0), min(bottom, shape[0])), slice(max(left, 0), min(right, shape[1]))


def middles_of(boxes: np.ndarray, foreground: np.ndarray, core: np.ndarray | None = None) -> np.ndarray:
    """(N, 2) u, v of the mean of each blob's pixels, i + 1 in the (H, W) foreground; NaN for one without any.

    core: (H, W) bool, the pixels that count, without what lies between the people of a crowd. None: all.
    """
    middles = np.full((len(boxes), 2), np.nan)
    for row, box in enumerate(boxes):
        rows, columns = window_of(box, foreground.shape)
        mine = foreground[rows, columns] == row + 1
        v, u = np.nonzero(mine if core is None else mine & core[rows, columns])
        if len(u):
            middles[row] = columns.start + u.mean(), rows.start + v.mean()
    return middles


def occupied(mask: np.ndarray, apart: int) -> list[Box]:
    """Disjoint boxes, x, y, width, height, that hold all pixels set in a (H, W) uint8 mask.

    Set pixels lie at least `apart` / 2 px inside their box, save at the picture's border, and more than `apart` px from
    those in other boxes.
    """
    height, width = mask.shape
    block = _BLOCK_PX
    padded = cv2.copyMakeBorder(mask, 0, -height % block, 0, -width % block, cv2.BORDER_CONSTANT, value=0)
    blocks = cv2.resize(padded, (padded.shape[1] // block, padded.shape[0] // block), interpolation=cv2.INTER_AREA)
    reach = -(-apart // (2 * block))
    blocks = cv2.dilate(blocks, np.ones((2 * reach + 1,) * 2, np.uint8))
    count, _, stats, _ = cv2.connectedComponentsWithStats(cv2.threshold(blocks, 0, 255, cv2.THRESH_BINARY)[1])
    waiting: list[Box] = [(x, y, x + w, y + h) for x, y, w, h, _ in stats[1:count].tolist()]
    # Boxes (left, top, right, bottom) that overlap are joined until none do.
    apart_boxes: list[Box] = []
    while waiting:
        box = waiting.pop()
        over = [b for b in apart_boxes if b[0] < box[2] and box[0] < b[2] and b[1] < box[3] and box[1] < b[3]]
        if over:
            apart_boxes = [b for b in apart_boxes if b not in over]
            left, top, right, bottom = zip(box, *over, strict=True)
            waiting.append((min(left), min(top), max(right), max(bottom)))
        else:
            apart_boxes.append(box)
    return [
        (block * x0, block * y0, min(block * x1, width) - block * x0, min(block * y1, height) - block * y0)
        for x0, y0, x1, y1 in apart_boxes
    ]


def connected_parts(mask: np.ndarray, box: Box, min_area_px: float) -> list[tuple[Box, np.ndarray]]:
    """The connected parts (8 neighbours) of a (height, width) bool mask in a box, (box, mask) each.

    box: x, y, width, height in the picture. Parts of less than min_area_px pixels are left out.
    """
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), ltype=cv2.CV_32S)
    parts = []
    for label, (left, top, width, height, area) in enumerate(stats[1:count].tolist(), 1):
        if area >= min_area_px:
            part = labels[top : top + height, left : left + width] == label
            parts.append(((box[0] + left, box[1] + top, width, height), part))
    return parts


# Plane maps.


def transfer(to_from: np.ndarray, points_px: np.ndarray) -> np.ndarray:
    """(N, 2) points through a (3, 3) homography. A point on the horizon goes to infinity, not to an error."""
    points = np.asarray(points_px, np.float64).reshape(-1, 2)
    homogeneous = np.ones((len(points), 3))
    homogeneous[:, :2] = points
    mapped = homogeneous @ to_from.T
    with np.errstate(divide="ignore", invalid="ignore"):
        return mapped[:, :2] / mapped[:, 2:]


def chain(steps: Sequence[np.ndarray]) -> np.ndarray:
    """The homography from the first frame to the last, from those of successive frames; scaled so that [2, 2] is 1."""
    total = np.eye(3)
    for later_from_earlier in steps:
        total = later_from_earlier @ total
        total = total / total[2, 2]
    return total


def background_flow(later_from_earlier: np.ndarray, size: tuple[int, int], samples: int = 9) -> float:
    """Median displacement in pixels of a grid of points over a (width, height) image."""
    grid = _grid(size, samples)
    return float(np.median(np.linalg.norm(transfer(later_from_earlier, grid) - grid, axis=1)))


@lru_cache(maxsize=4)
def _grid(size: tuple[int, int], samples: int) -> np.ndarray:
    u, v = np.meshgrid(np.linspace(0, size[0] - 1, samples), np.linspace(0, size[1] - 1, samples))
    return np.c_[u.ravel(), v.ravel()]


def corner_error(a: np.ndarray, b: np.ndarray, size: tuple[int, int]) -> float:
    """How far two homographies differ, at most, at the corners of a (width, height) image, in pixels."""
    corners = _grid(size, 2)
    return float(np.linalg.norm(transfer(a, corners) - transfer(b, corners), axis=1).max())


# Rotations.


def cross(vector: np.ndarray) -> np.ndarray:
    """(..., 3, 3) matrices that multiply like the cross product with (..., 3) vectors."""
    matrices = np.zeros((*np.shape(vector), 3))
    x, y, z = vector[..., 0], vector[..., 1], vector[..., 2]
    matrices[..., 2, 1], matrices[..., 0, 2], matrices[..., 1, 0] = x, y, z
    matrices[..., 1, 2], matrices[..., 2, 0], matrices[..., 0, 1] = -x, -y, -z
    return matrices


def _polynomial(vector: np.ndarray, first: float, second: float) -> np.ndarray:
    """I + first K + second K², with K the matrix of the cross product with a vector."""
    x, y, z = vector.tolist()
    fx, fy, fz, sx, sy, sz = first * x, first * y, first * z, second * x, second * y, second * z
    return np.array(
        [
            [1 - sy * y - sz * z, sx * y - fz, sx * z + fy],
            [sx * y + fz, 1 - sx * x - sz * z, sy * z - fx],
            [sx * z - fy, sy * z + fx, 1 - sx * x - sy * y],
        ]
    )


def turned(vector: np.ndarray) -> np.ndarray:
    """(3, 3) rotation about a vector by its length in radians (Rodrigues)."""
    angle = sqrt(vector @ vector)
    if angle < 1e-6:
        return _polynomial(vector, 1.0, 0.5)
    return _polynomial(vector, sin(angle) / angle, (1 - cos(angle)) / angle**2)


def turn_of(rotation: np.ndarray) -> np.ndarray:
    """(3,) the vector about which a rotation turns, by its length in radians: the inverse of `turned`."""
    (a, b, c), (d, e, f), (g, h, i) = rotation.tolist()
    x, y, z = h - f, c - g, d - b
    sine, cosine = sqrt(x * x + y * y + z * z) / 2, (a + e + i - 1) / 2
    angle = atan2(sine, cosine)
    if sine > 1e-7:
        return np.array([x, y, z]) * (angle / (2 * sine))
    if cosine > 0:
        return np.array([x, y, z]) / 2
    # Half a turn: the axis is what the symmetric part leaves in place, its sign is free.
    symmetric = (rotation + np.eye(3)) / 2
    axis = symmetric[:, int(np.argmax(np.diag(symmetric)))]
    return angle * axis / np.linalg.norm(axis)


def slope_of_turn(vector: np.ndarray) -> np.ndarray:
    """(3, 3) how `turn_of(turned(small) @ turned(vector))` grows with the small rotation."""
    angle = sqrt(vector @ vector)
    if angle < 1e-3:
        return _polynomial(vector, -0.5, 1 / 12)
    # Bounded below half a turn, where the vector changes its sign.
    return _polynomial(vector, -0.5, 1 / angle**2 - (1 + cos(angle)) / (2 * angle * max(sin(angle), 1e-6)))


def about_up(rotation: np.ndarray) -> np.ndarray:
    """(3, 3) the rotation about up that leaves, undone first, only a tilt: rotation = tilt @ about_up."""
    angle = atan2(rotation[1, 0] - rotation[0, 1], rotation[0, 0] + rotation[1, 1])
    return turned(np.array([0.0, 0.0, angle]))


# Matching.


def cheapest(cost: Float[np.ndarray, "N M"]) -> tuple[Int[np.ndarray, "K"], Int[np.ndarray, "K"]]:
    """Rows, ascending, and the column of each: min(N, M) pairs of the least sum of finite costs."""
    cost = np.asarray(cost, float)
    # Where all rows have different best columns, no sum is less. SciPy's `optimize` takes 0.5 s and 45 MB to load, as
    # much as the rest of a run onboard: it is loaded when two rows have the same best column.
    tall = cost.shape[0] > cost.shape[1]
    best = (cost.T if tall else cost).argmin(axis=1) if cost.size else np.zeros(0, np.int64)
    if len(set(best.tolist())) == len(best):
        if not tall:
            return np.arange(len(best)), best
        order = np.argsort(best)
        return best[order], order
    from scipy.optimize import linear_sum_assignment

    return linear_sum_assignment(cost)


def best_pairs(score: Float[np.ndarray, "N M"], least: float = 0.0) -> Int[np.ndarray, "K 2"]:
    """One-to-one pairs (row, column) with the largest sum of scores, sorted by row.

    An unpaired row or column scores 0, so only scores above 0, and above `least`, are used; -inf forbids a pair.
    Raises InputError if the score is no matrix or holds NaN or +inf.
    """
    score = np.asarray(score, float)
    if score.ndim != 2:
        raise InputError(f"best_pairs needs a matrix of scores (N, M); got shape {score.shape}. Give one row a target.")
    if score.size and not score.max() < np.inf:  # a NaN is not either
        raise InputError("best_pairs needs scores below infinity; got NaN or +inf. Forbid a pair with -inf.")
    # A forbidden pair counts as unpaired, so that a full matching always exists.
    fits = score > max(least, 0.0)
    gain = np.where(fits, score, 0.0)
    # Rows and columns that fit nothing are left out: this spares SciPy in most calls.
    rows, columns = np.flatnonzero(fits.any(axis=1)), np.flatnonzero(fits.any(axis=0))
    row, column = cheapest(-gain[np.ix_(rows, columns)])
    row, column = rows[row], columns[column]
    used = gain[row, column] > 0
    return np.stack([row[used], column[used]], axis=1).astype(np.int64)


def namespace(x: Any) -> Any:
    """NumPy for an array, torch for a tensor; nothing is imported: who has a tensor has torch."""
    return np if isinstance(x, np.ndarray) else sys.modules["torch"]


# Places on the Earth.


def east_north(lonlat_deg: Float[np.ndarray, "N 2"], origin_deg: tuple[float, float]) -> Float[np.ndarray, "N 2"]:
    """Metres east and north of an origin, both as (longitude, latitude)."""
    import pymap3d  # here, as most runs have places in metres, or none

    def convert(longitude: np.ndarray, latitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return pymap3d.geodetic2enu(latitude, longitude, 0.0, origin_deg[1], origin_deg[0], 0.0)[:2]

    return _by_parts(convert, lonlat_deg)


def lonlat(east_north_m: Float[np.ndarray, "N 2"], origin_deg: tuple[float, float]) -> Float[np.ndarray, "N 2"]:
    """(longitude, latitude) of local metres."""
    import pymap3d

    def convert(east: np.ndarray, north: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return pymap3d.enu2geodetic(east, north, 0.0, origin_deg[1], origin_deg[0], 0.0)[1::-1]

    return _by_parts(convert, east_north_m)


def _by_parts(
    convert: Callable[[np.ndarray, np.ndarray], tuple[np.ndarray, np.ndarray]], pairs: np.ndarray
) -> np.ndarray:
    given = np.asarray(pairs, float).reshape(-1, 2)
    converted = np.empty_like(given)
    for begin in range(0, len(given), _PART):
        part = slice(begin, begin + _PART)
        converted[part, 0], converted[part, 1] = convert(given[part, 0], given[part, 1])
    return converted


def plain_lonlat(east_north_m: Float[np.ndarray, "N 2"], origin_deg: Degrees) -> np.ndarray:
    """(longitude, latitude) as the source has them, eq. (14): K = 111 320 m a degree, K cos(latitude) of longitude.

    0.3 m off in 150 m. Longitudes go on over 180 degrees at -180.
    """
    origin = np.asarray(origin_deg, float)
    return _wrap_longitude(origin + np.asarray(east_north_m, float) / _degree_m(origin))


def plain_east_north(lonlat_deg: Float[np.ndarray, "N 2"], origin_deg: Degrees) -> np.ndarray:
    """Metres east and north, the other way round."""
    origin = np.asarray(origin_deg, float)
    return _wrap_longitude(np.asarray(lonlat_deg, float) - origin) * _degree_m(origin)


def _degree_m(origin_deg: np.ndarray) -> np.ndarray:
    """(..., 2) metres a degree of longitude and of latitude."""
    latitude = origin_deg[..., 1]
    return np.stack([DEGREE_M * np.cos(np.radians(latitude)), np.full_like(latitude, DEGREE_M)], axis=-1)


def _wrap_longitude(lonlat_deg: np.ndarray) -> np.ndarray:
    longitude = lonlat_deg[..., 0]
    longitude = np.where(np.abs(longitude) > 180, (longitude + 180) % 360 - 180, longitude)
    return np.stack([longitude, lonlat_deg[..., 1]], axis=-1)


def great_circle_m(lonlat_deg: np.ndarray, from_deg: np.ndarray) -> np.ndarray:
    """(N,) great-circle distances on a sphere, good to half a percent: enough to see a mistake."""
    longitude, latitude = np.radians(lonlat_deg).T
    longitude_0, latitude_0 = np.radians(from_deg)
    across = np.cos(latitude) * np.cos(latitude_0) * np.sin((longitude - longitude_0) / 2) ** 2
    half = np.sin((latitude - latitude_0) / 2) ** 2 + across
    return 2 * 6_371_000.0 * np.arcsin(np.sqrt(np.clip(half, 0, 1)))


def poses_at(
    camera: Camera, table: PoseTable | None, frame: np.ndarray, rate_hz: float | None = None
) -> tuple[Camera, Poses]:
    """The camera, with the kind of place that its poses have, and where it stood in each frame.

    Between samples place and pitch go straight on, heading and longitude by the shorter way round.
    Raises InputError where the poses do not cover the frames, or are timed and there is no rate.
    """
    n = len(frame)
    place = np.tile(camera.place, (n, 1)).astype(float)
    heading, pitch = np.full(n, float(camera.heading_rad)), np.full(n, float(camera.pitch_rad))
    if table is None:
        return camera, Poses(place, heading, pitch)
    if table.timed and rate_hz is None:
        raise InputError(f"poses {table.path} are by time_s; say with --rate how many frames a second there are")
    at, values = table.at, table.values
    when = (np.asarray(frame) - 1) / rate_hz if table.timed and rate_hz else np.asarray(frame, float)
    outside = (when < at[0] - 1e-6) | (when > at[-1] + 1e-6)
    if outside.any():
        unit = "seconds" if table.timed else "frames"
        first = int(outside.argmax())
        raise InputError(
            f"poses {table.path} cover {unit} {at[0]:g} to {at[-1]:g}; {int(outside.sum())} of {n} rows of "
            f"the table lie outside, the first at frame {frame[first]}. Give poses for all of them"
        )
    if "longitude_deg" in values:
        # A longitude goes on over 180 degrees, not back through 0.
        longitude = np.interp(when, at, np.unwrap(values["longitude_deg"], period=360))
        place = _wrap_longitude(np.stack([longitude, np.interp(when, at, values["latitude_deg"])], axis=1))
        camera = replace(camera, geographic=True)
    elif "east_m" in values:
        place = np.stack([np.interp(when, at, values[key]) for key in ("east_m", "north_m")], axis=1)
        camera = replace(camera, geographic=False)
    if "heading_deg" in values:
        heading = np.interp(when, at, np.unwrap(np.radians(values["heading_deg"])))
    if "pitch_deg" in values:
        pitch = np.interp(when, at, np.radians(values["pitch_deg"]))
    return camera, Poses(place, heading, pitch)


# -- frames about a frame ----------------------------------------------------------------------------------------------


def pair_about(at: int, gap: int, first: int, last: int) -> tuple[int, int] | None:
    """Two frames of first..last a gap apart from frame `at` on both sides, else two on one side, else None."""
    return _first_within([(at - gap, at + gap), (at + gap, at + 2 * gap), (at - gap, at - 2 * gap)], first, last)


def near_gaps(near_frames: Sequence[int], wide_frames: int, interval: int) -> list[int]:
    """Distances to the frames that a frame is compared with at a detection interval.

    Without a wide pair the longest, which is meant for 3 frames, follows the interval in proportion, up to its length.
    """
    if wide_frames:
        return list(near_frames)
    longest = max(near_frames)
    far = min(max(round(longest * interval / _NEAR_INTERVAL), 1), max(longest, interval))
    return [far if gap == longest else gap for gap in near_frames]


def near_pairs(at: int, gaps: Sequence[int], first: int, last: int) -> list[tuple[int, int]]:
    """The pairs of frames that a frame is compared with, within first..last; may be empty."""
    # Near an end gaps shrink, so that pairs look both ways. At the end itself one looks one way only, to the closest
    # frames: it shows a target's next places too, the more of them the longer its gap.
    if room := min(at - first, last - at):
        return list(dict.fromkeys((at - min(gap, room), at + min(gap, room)) for gap in gaps))
    pair = pair_about(at, 1, first, last)
    return [] if pair is None else [pair]


def later_pair(at: int, interval: int, first: int, last: int) -> list[tuple[int, int]]:
    """The source's pair: one and two intervals later, else earlier, at the shortest one frame; may be empty."""
    later = [(at + side * gap, at + 2 * side * gap) for gap in range(interval, 0, -1) for side in (1, -1)]
    # The middle one of three frames has a neighbour on either side only.
    pair = _first_within([*later, (at - 1, at + 1)], first, last)
    return [] if pair is None else [pair]


def next_pair(at: int, interval: int, first: int, last: int) -> list[tuple[int, int]]:
    """The one frame that a two-frame difference looks at, as a pair of itself: later, else earlier; may be empty."""
    single = [(at + side * gap, at + side * gap) for gap in range(interval, 0, -1) for side in (1, -1)]
    pair = _first_within(single, first, last)
    return [] if pair is None else [pair]


def _first_within(pairs: Iterable[tuple[int, int]], first: int, last: int) -> tuple[int, int] | None:
    return next((pair for pair in pairs if first <= min(pair) and max(pair) <= last), None)
