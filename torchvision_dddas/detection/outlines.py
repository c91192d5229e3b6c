"""Refine the outlines of blobs, and remove cast shadows.

Each pixel is compared with two predictions. Pixels that only the target's motion explains are foreground, and pixels
that the background explains are background. All other pixels (flat interiors, areas visible in only one picture) are
assigned by their colours.
"""

from collections.abc import Sequence

import cv2
import numpy as np

from torchvision_dddas.chain import View, ellipse
from torchvision_dddas.config import EVIDENCE_SCALE, Settings
from torchvision_dddas.detection.blobs import Blob, Box, box_slices, widen_box
from torchvision_dddas.detection.engine import Foreground

_MAX_MISFIT = 15.0  # noise units
# Physical values of the levels of a texture map (grey levels a pixel) and of an evidence map (noise units).
_SLOPES, _UNITS = np.arange(256) / 4, np.arange(256) / EVIDENCE_SCALE
_DIFFERS = np.clip((_UNITS - 2) / 2, 0, 1)
# Margin around a blob that is smoothed together with it, px.
_PAD = 24
WARP_FLAGS = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP

# The ground in a shadow has this share of its usual brightness.
_LIGHT_LEFT = (0.25, 0.85)
# That share may differ between the colour channels by this part of its mean, because the blue sky lights a shadow, so
# that more blue than red is left.
_COLOURS_ALIKE = 0.2
# Two pictures show the same bare ground if they differ by fewer grey levels.
GROUNDS_ALIKE = 12
# If less than this share of the mask would be left, the target itself is dark, and the mask is kept.
_LEAST_LEFT = 0.35
# Together with a shadow, parts of the mask smaller than this share of its largest part are removed.
_CRUMB = 0.15


def refine_outlines(
    blobs: Sequence[Blob], velocities_px: Sequence[np.ndarray], view: View, foreground: Foreground, settings: Settings
) -> list[np.ndarray]:
    """Return the refined masks inside the blobs' boxes, (height, width) bool. They are subsets of the blobs' masks.

    velocities_px: (2,) pixels a frame over the background for each blob; unknown (NaN) velocities count as 0. view: the
    reference frame. foreground: its maps.
    """
    seeds, guides = [], []
    for blob, velocity_px in zip(blobs, velocities_px, strict=True):
        left, top, width, height = widen_box(blob.box, _PAD, view.size)
        here: np.ndarray = np.zeros((height, width, 2), np.float32)
        here[..., 1] = 1
        here[box_slices(blob.box, left, top)] = np.dstack(
            _explain_pixels(blob, velocity_px, view, foreground, settings)
        )
        half = max(width // 2, 1), max(height // 2, 1)
        image = view.image[box_slices((left, top, width, height))]
        guides.append(cv2.resize(image, half, interpolation=cv2.INTER_AREA))
        seeds.append(cv2.resize(here, half, interpolation=cv2.INTER_AREA))
    weights = smooth_along_edges(seeds, guides, settings.refine.spatial_px / 2, settings.refine.colour_levels)
    masks = []
    for blob, weight in zip(blobs, weights, strict=True):
        left, top, width, height = widen_box(blob.box, _PAD, view.size)
        share = cv2.resize(weight[..., 0] / (weight[..., 0] + weight[..., 1] + 1e-6), (width, height))
        masks.append((share[box_slices(blob.box, left, top)] > settings.refine.share) & blob.mask)
    return masks


def _explain_pixels(
    blob: Blob, velocity_px: np.ndarray, view: View, foreground: Foreground, settings: Settings
) -> tuple[np.ndarray, np.ndarray]:
    """Return how certainly each pixel of a blob's box is target, and background: (height, width) float32 each."""
    x, y, width, height = blob.box
    box, own = box_slices(blob.box), view.grey[box_slices(blob.box)]
    near, far, texture = (picture[box] for picture in (foreground.evidence, foreground.wide, foreground.texture))
    noise = np.hypot(settings.difference.noise_levels, settings.difference.gradient_share * _SLOPES)
    weight = _look_up(texture, 1 / noise)

    def misfit(pictures: Sequence[np.ndarray]) -> np.ndarray:
        """Return the smaller difference of the frame to two pictures of the box, noise units."""
        least = cv2.min(*(cv2.absdiff(own, picture) for picture in pictures))
        miss = cv2.multiply(least, weight, dtype=cv2.CV_32F)
        return cv2.blur(cv2.threshold(miss, _MAX_MISFIT, 0, cv2.THRESH_TRUNC)[1], (3, 3))

    still = misfit([picture[box] for picture in foreground.warped])
    # Shift the neighbours into the blob's box by the target's motion.
    moved = []
    for picture, offset in zip(foreground.warped, foreground.offsets, strict=True):
        matrix = np.c_[np.eye(2), (x, y) + offset * np.nan_to_num(velocity_px)]
        moved.append(
            cv2.warpAffine(picture, matrix, (width, height), flags=WARP_FLAGS, borderMode=cv2.BORDER_REPLICATE)
        )
    moving = misfit(moved)
    certain = _look_up(near, _DIFFERS) * np.clip(1.5 - moving / np.maximum(still, 1), 0, 1)
    filled = _look_up(far, _DIFFERS) * np.clip(1.5 - moving / 2, 0, 1)
    certain = np.where(certain < 0.2, np.maximum(certain, filled), certain) * blob.mask
    background = _look_up(texture, np.clip(_SLOPES / 8, 0, 1)) * np.clip(0.5 + (moving - still) / 2, 0, 1)
    background *= _look_up(near, np.clip(1 - _UNITS / 2, 0, 1))
    background *= _look_up(far, np.clip(1 - _UNITS / 3, 0, 1))
    background[~blob.mask] = 1
    return certain, background


def _look_up(picture: np.ndarray, table: np.ndarray) -> np.ndarray:
    """Map the levels of a (H, W) uint8 picture to float32 values by a table of 256 entries."""
    return cv2.LUT(picture, table.astype(np.float32))


def smooth_along_edges(
    values: Sequence[np.ndarray],
    guides: Sequence[np.ndarray],
    spatial_px: float,
    colour_levels: float,
    rounds: int = 2,
) -> list[np.ndarray]:
    """Smooth (H, W, K) values along the flat regions of pictures, without crossing their edges.

    guides: (H, W, 3) or (H, W) uint8. spatial_px: smoothing length where the colour is constant. colour_levels: change
    of colour, summed over the channels, that counts as a distance of spatial_px.
    Source: the recursive domain transform, Gastal and Oliveira 2011.
    """
    if not values:
        return []
    distances: list[list[np.ndarray]] = [[], []]  # along columns, along rows
    for guide in guides:
        colours = np.atleast_3d(guide)
        # Weight a grey picture like a colour picture with three equal channels.
        weight = np.full(colours.shape[2], 3 / colours.shape[2] * spatial_px / colour_levels, np.float32)
        for axis, lines in enumerate((colours, colours.swapaxes(0, 1))):
            change = np.maximum(lines[1:], lines[:-1]) - np.minimum(lines[1:], lines[:-1])
            distances[axis].append(1 + change.astype(np.float32) @ weight)
    # Put all pictures side by side, so that one step smooths a line of each. Beyond a picture's last line the distance
    # is infinite, so that no value comes from there.
    packed = [_pack(apart, np.inf) for apart in distances]
    for i in range(rounds):
        sigma = spatial_px * np.sqrt(3) * 2 ** (rounds - i - 1) / np.sqrt(4**rounds - 1)
        decay = np.float32(-np.sqrt(2) / sigma)
        for axis in (1, 0):
            lines = _pack([value.swapaxes(0, axis).swapaxes(1, 2) for value in values])
            _smooth_lines(lines, np.exp(decay * packed[axis]))
            ends = np.cumsum([value.shape[1 - axis] for value in values])
            parts = np.split(lines, ends[:-1], axis=2)
            values = [
                part[: value.shape[axis]].swapaxes(1, 2).swapaxes(0, axis)
                for part, value in zip(parts, values, strict=True)
            ]
    return list(values)


def _pack(pictures: Sequence[np.ndarray], beyond: float = 0.0) -> np.ndarray:
    """Put pictures (H, ..., W) of different sizes side by side, float32; fill missing lines with `beyond`."""
    height, width = max(map(len, pictures)), sum(picture.shape[-1] for picture in pictures)
    packed = np.full((height, *pictures[0].shape[1:-1], width), beyond, np.float32)
    left = 0
    for picture in pictures:
        packed[: len(picture), ..., left : left + picture.shape[-1]] = picture
        left += picture.shape[-1]
    return packed


def _smooth_lines(lines: np.ndarray, shares: np.ndarray) -> None:
    """Smooth lines (H, K, W) in place, downwards and then upwards. shares: (H - 1, W) weights of the previous line."""
    change = np.empty_like(lines[0])
    steps = [*zip(lines, lines[1:], shares, strict=False)]
    for before, after, kept in steps:
        np.subtract(before, after, out=change)
        change *= kept
        after += change
    for before, after, kept in reversed(steps):
        np.subtract(after, before, out=change)
        change *= kept
        before += change


def remove_shadow(
    mask: np.ndarray,
    box: Box,
    image: np.ndarray,
    grounds: Sequence[np.ndarray],
    ground_from_image: Sequence[np.ndarray],
) -> np.ndarray:
    """Return the target's mask without its cast shadow, which is darker ground of unchanged colour.

    mask: (height, width) bool inside box = x, y, width, height of image, (H, W, 3) uint8. It is returned unchanged if
    there is no shadow, and for grey pictures. grounds: two other frames, (H, W, 3), far enough in time that the target
    is elsewhere in them. ground_from_image: their (3, 3) registrations.
    """
    if len(grounds) != 2 or any(picture.ndim != 3 for picture in [image, *grounds]):
        return mask
    pictures = [image[box_slices(box)]]
    for ground, matrix in zip(grounds, ground_from_image, strict=True):
        ground_from_box = matrix @ np.array([[1, 0, box[0]], [0, 1, box[1]], [0, 0, 1]], float)
        pictures.append(
            cv2.warpPerspective(ground, ground_from_box, box[2:], flags=WARP_FLAGS, borderMode=cv2.BORDER_REPLICATE)
        )
    own, first, second = (
        np.stack(cv2.split(cv2.blur(picture, (3, 3)))).astype(np.float32)
        for picture in pictures  # (3, height, width) each
    )
    bare = np.abs(first - second).max(axis=0) < GROUNDS_ALIKE
    light = (own + 2) / ((first + second) / 2 + 2)
    mean = light.mean(axis=0)
    alike = np.abs(light - mean).max(axis=0) < _COLOURS_ALIKE * mean
    low, high = _LIGHT_LEFT
    is_shadow = bare & alike & (mean > low) & (mean < high)
    shadow = cv2.morphologyEx(is_shadow.astype(np.uint8), cv2.MORPH_OPEN, ellipse(5))
    body = cv2.morphologyEx((mask & (shadow == 0)).astype(np.uint8), cv2.MORPH_OPEN, ellipse(3))
    count, labels, stats, _ = cv2.connectedComponentsWithStats(body)
    if count < 2:
        return mask
    kept = stats[:, cv2.CC_STAT_AREA] >= _CRUMB * stats[1:, cv2.CC_STAT_AREA].max()
    kept[0] = False
    left = kept[labels]
    return left if left.sum() >= _LEAST_LEFT * mask.sum() else mask
